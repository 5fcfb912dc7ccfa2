"""Features and matches on a GPU are those of a CPU, however many photos are extracted at once."""

import os
import subprocess
import sys
from collections.abc import Callable, Iterable
from pathlib import Path

import conftest
import cv2
import h5py
import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

PHOTOS = ("0.png", "1.png", "2.png")
# what differs does so by rounding: of keypoints and matches that are nearly equal
SAME = 0.99


def run(gpus: str, *arguments: object, cores: int | None = None) -> int:
    """Run Python with values of CUDA_VISIBLE_DEVICES and, if given, OMP_NUM_THREADS."""
    command = [sys.executable, *map(str, arguments)]
    environment = os.environ | {"CUDA_VISIBLE_DEVICES": gpus}
    if cores:
        environment["OMP_NUM_THREADS"] = str(cores)
    return subprocess.run(command, env=environment, cwd=Path(__file__).parents[1]).returncode


@pytest.fixture(scope="module", autouse=True)
def gpu() -> None:
    asked = "import torch; raise SystemExit(not torch.cuda.is_available())"
    if not torch.backends.cuda.is_built() or run(conftest.GPUS, "-c", asked):
        pytest.skip("this machine has no GPU")


@pytest.fixture
def photos(tmp_path, textured) -> Path:
    folder = tmp_path / "photos"
    folder.mkdir()
    for i, name in enumerate(PHOTOS):
        turn = cv2.getRotationMatrix2D((160, 120), 4 * i, 1 + 0.05 * i)
        cv2.imwrite(str(folder / name), cv2.warpAffine(textured, turn, (320, 240)))
    return folder


def places(image: h5py.Group) -> np.ndarray:
    """Return what tells keypoints apart, with their scales and orientations if they have them."""
    keys = [key for key in ("keypoints", "scales", "oris") if key in image]
    return np.column_stack([image[key][()] for key in keys])


def assert_same(ours: Path, theirs: Path, names: Iterable[str]) -> None:
    """Assert that images have the same features in two files, up to rounding."""
    with h5py.File(ours) as one, h5py.File(theirs) as other:
        for name in names:
            distance, nearest = cKDTree(places(other[name])).query(places(one[name]))
            found = distance < 0.1
            assert found.mean() > SAME
            assert len(np.unique(nearest[found])) > SAME * len(other[name]["keypoints"])
            a, b = (file[name]["descriptors"][()].T.astype(float) for file in (one, other))
            cosines = (a[found] * b[nearest[found]]).sum(axis=1)
            assert np.quantile(cosines, 1 - SAME) > 0.999


@pytest.mark.parametrize(
    ("feature", "matcher"),
    [
        ("colmap_sift_sv64", "NN-ratio"),
        ("sift_sv32", "NN-ratio"),
        ("mini32", "NN-mutual"),
        ("xfeat_sv32", "NN-mutual"),
        ("edgepoint2_m64_sv32", "NN-mutual"),
        ("aliked_sv32", "NN-mutual"),
    ],
)
def test_a_gpu_finds_what_a_cpu_finds(
    photos: Path, tmp_path: Path, base_weights: Callable[[str], None], feature: str, matcher: str
) -> None:
    base_weights(feature)
    pairs = tmp_path / "pairs.txt"
    pairs.write_text("0.png 1.png\n0.png 2.png\n1.png 2.png\n")
    features, matches = {}, {}
    for device, gpus in (("cpu", ""), ("gpu", conftest.GPUS)):
        features[device] = tmp_path / f"{device}.h5"
        matches[device] = tmp_path / f"{device}-matches.h5"
        stage = ("-m", "hloc_reduce.extract_features", "--image_dir", photos, "--conf", feature)
        assert run(gpus, *stage, "--feature_path", features[device]) == 0
        # of the same features
        stage = ("-m", "hloc_reduce.match_features", "--pairs", pairs, "--conf", matcher)
        files = ("--features", features["cpu"], "--matches", matches[device])
        assert run(gpus, *stage, *files, "--export_dir", tmp_path) == 0
    assert_same(features["gpu"], features["cpu"], PHOTOS)
    with h5py.File(matches["cpu"]) as cpu, h5py.File(matches["gpu"]) as gpu:
        for name0, name1 in (line.split() for line in pairs.read_text().splitlines()):
            ours, theirs = (file[name0][name1]["matches0"][()] for file in (gpu, cpu))
            assert (theirs >= 0).sum() > 100
            assert (ours == theirs).mean() > SAME


@pytest.mark.parametrize("feature", ["mini32", "xfeat_sv32", "aliked_sv32"])
def test_photos_at_once_are_those_one_by_one(
    tmp_path: Path, textured: np.ndarray, base_weights: Callable[[str], None], feature: str
) -> None:
    """Of several sizes, every third one with so much noise that it is reduced."""
    base_weights(feature)
    generator, names = np.random.default_rng(0), [f"{i}.png" for i in range(12)]
    photos, files = tmp_path / "photos", [tmp_path / f"{cores}.h5" for cores in (1, 4)]
    photos.mkdir()
    for i, name in enumerate(names):
        photo = cv2.resize(textured, (320 + 64 * (i % 5), 240 + 32 * (i % 4)))
        noise = generator.normal(0, 20 if i % 3 == 0 else 0, photo.shape)
        cv2.imwrite(str(photos / name), (photo + noise).clip(0, 255))
    for cores, file in zip((1, 4), files, strict=True):
        stage = ("-m", "hloc_reduce.extract_features", "--image_dir", photos, "--conf", feature)
        assert run(conftest.GPUS, *stage, "--feature_path", file, cores=cores) == 0
    assert_same(*files, names)
    with h5py.File(files[0]) as file:
        blurred = [file[name]["keypoints"].attrs["blur"] > 0 for name in names]
    assert blurred == [i % 3 == 0 for i in range(12)]
