"""Files of RGB-D scans, and points between their pixels."""

import h5py
import numpy as np
import pytest
from scipy.io import savemat

from hloc_reduce.datasets import scans
from hloc_reduce.datasets.inloc import by_iphone7
from hloc_reduce.utils.cli import InputError


def test_points_between_pixels_by_hand():
    """The point of pixel (x, y) is (x, y, x * y), but for two pixels without depth."""
    y, x = np.mgrid[:4, :5].astype(float)
    scan = np.stack([x, y, x * y], -1)
    scan[1, 3] = scan[3, 4] = np.nan
    for keypoint, expected in (
        ((0.5, 0.25), (0.5, 0.25, 0.125)),
        ((1, 2), (1, 2, 2)),
        ((2.25, 1.75), (2, 2, 4)),  # its neighbour (3, 1) has no depth, the nearest has
        ((2.8, 1.3), (3, 2, 6)),  # the nearest has none, (3, 2) is nearer than (2, 1)
        ((-0.4, 0), (0, 0, 0)),  # outside: on the border
        ((4.3, 2.6), (4, 2, 8)),  # (4, 3) has no depth
        ((1.5, 3), (1.5, 3, 4.5)),
    ):
        np.testing.assert_allclose(scans.interpolate(scan, np.array([keypoint])), [expected])
    # where one pixel itself has no depth, one beside it is taken
    assert np.abs(scans.interpolate(scan, np.array([[3, 1]]))[0, :2] - [3, 1]).sum() == 1
    some = np.random.default_rng(0).uniform(-1, 5, (20, 2))
    assert np.isnan(scans.interpolate(np.full((2, 2, 3), np.nan), some)).all()
    assert scans.interpolate(scan[:1, :1], some).tolist() == [[0, 0, 0]] * 20
    assert scans.interpolate(scan, np.zeros((0, 2))).shape == (0, 3)


def test_files_of_scans_are_checked(tmp_path):
    name = "database/cutouts/DUC1/024/DUC_cutout_024_0_-30.jpg"
    path = tmp_path / "database/alignments/DUC1/transformations/DUC_trans_024.txt"
    assert scans.transformation_file(tmp_path, name) == path and scans.floor_of(name) == "DUC1"
    with pytest.raises(InputError, match="not the name of a cutout"):
        scans.floor_of("query/a.jpg")
    for row in ("", "1 2 3", "1 2 x 4", "1 2 3 nan"):
        path = tmp_path / "trans.txt"
        path.write_text("\n" * 7 + f"{row}\n" * 4)
        with pytest.raises(InputError, match="trans.txt"):
            scans.read_transformation(path)
    mat = tmp_path / "a.mat"
    for content in ({"other": np.zeros(3)}, {"XYZcut": np.zeros((4, 4))}, {"XYZcut": "text"}):
        savemat(mat, content)
        with pytest.raises(InputError, match="a.mat"):
            scans.read_scan(mat)
    savemat(mat, {"XYZcut": np.zeros((4, 4, 3))})
    content = mat.read_bytes()
    for broken in (b"", b"no matlab", content[:200], content[:-50]):
        mat.write_bytes(broken)
        with pytest.raises(InputError, match="a.mat"):
            scans.read_scan(mat)
    with pytest.raises(InputError, match="absent.mat"):
        scans.read_scan(tmp_path / "absent.mat")


def test_intrinsics_of_the_benchmark(tmp_path):
    with h5py.File(tmp_path / "f.h5", "w") as file:
        file["a/image_size"] = np.array([4032, 3024])
        file["b/image_size"] = np.array([3024, 4032])
    (_, wide), (_, high) = by_iphone7(tmp_path / "f.h5", ["a", "b"])
    assert wide.params.tolist() == [3136, 2016, 1512]
    assert high.params.tolist() == [3136, 1512, 2016] and (high.width, high.height) == (3024, 4032)
