"""The map of a scene whose points are known."""

import json

import h5py
import numpy as np
import pycolmap
import pytest
from small_map import all_pairs

from hloc_reduce import triangulation
from hloc_reduce.utils import cli, colmap
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.h5 import list_h5_names


def test_map_is_where_the_points_are(built):
    assert built.map.num_points3D() == 300
    for point in built.map.points3D.values():
        element = point.track.elements[0]
        name = built.map.images[element.image_id].name
        true = built.points[built.seen[name][element.point2D_idx]]
        np.testing.assert_allclose(point.xyz, true, atol=1e-4)


def test_half_a_pixel_would_be_seen(built):
    """The map's keypoints are COLMAP's: the projections themselves, not half a pixel off."""
    image = built.map.find_image_with_name("db/3.jpg")
    errors = [
        np.linalg.norm(p.xy - image.project_point(built.map.points3D[p.point3D_id].xyz))
        for p in image.points2D
        if p.has_point3D()
    ]
    assert len(errors) == 300 and max(errors) < 1e-2


def test_map_is_built_once_and_again_when_its_inputs_change(built, caplog, monkeypatch):
    monkeypatch.setattr(cli.logger, "propagate", True)
    written = (built.sfm / "points3D.bin").stat().st_mtime_ns
    assert built.triangulate().num_points3D() == 300
    assert (built.sfm / "points3D.bin").stat().st_mtime_ns == written
    all_pairs(built.pairs, skip=[5])
    assert built.triangulate().find_image_with_name("db/5.jpg").num_points3D == 0
    assert "1 of 6 photos have no point in the map" in caplog.text and "db/5.jpg." in caplog.text


@pytest.mark.fault(7)
@pytest.mark.parametrize(("length", "stale"), [(1.002, True), (1 + 1e-6, False)])
def test_a_map_of_rotations_that_were_not_normalized_is_stale(length, stale, built):
    reference = pycolmap.Reconstruction(built.model)
    for frame in reference.frames.values():
        pose = frame.rig_from_world
        rotation = pycolmap.Rotation3d(length * pose.rotation.quat)
        frame.rig_from_world = pycolmap.Rigid3d(rotation, pose.translation)
    reference.write_binary(built.model)
    assert built.triangulate().num_points3D() == 300
    written = [(built.sfm / "points3D.bin").stat().st_mtime_ns]
    made_from = json.loads((built.sfm / "made_from.json").read_text())
    made_from["options"].pop("normalized", None)  # which an earlier version did not say
    (built.sfm / "made_from.json").write_text(json.dumps(made_from))
    for _ in range(2):
        built.triangulate()
        written.append((built.sfm / "points3D.bin").stat().st_mtime_ns)
    assert (written[0] != written[1]) == stale and written[1] == written[2]


def test_an_empty_map_is_loud_and_keeps_the_old_one(built):
    with h5py.File(built.matches, "a") as file:
        for pair in list_h5_names(built.matches):
            file[f"{pair}/matches0"][:] = -1
    before = (built.sfm / "points3D.bin").read_bytes()
    with pytest.raises(InputError, match="The map is empty"):
        built.triangulate()
    assert (built.sfm / "points3D.bin").read_bytes() == before


def test_matches_off_their_epipolar_lines_are_left_out(built):
    """Matches shifted by one keypoint are wrong; with true poses hardly any passes."""
    with h5py.File(built.matches, "a") as file:
        for pair in list_h5_names(built.matches):
            matches = file[f"{pair}/matches0"]
            matches[:] = np.roll(matches[:], 1)
    try:
        wrong = built.triangulate(built.root / "wrong")
        assert wrong.num_points3D() < 10
    except InputError as error:
        assert "empty" in str(error)


def test_matches_of_low_score_are_left_out(built):
    """Those of the first point, which is then in no track."""
    with h5py.File(built.matches, "a") as file:
        for pair in list_h5_names(built.matches):
            seen = built.seen[f"db/{pair[3:4]}.jpg"]
            file[f"{pair}/matching_scores0"][seen == 0] = 0.5
    for score, points in ((0.6, 299), (0.4, 300), (None, 300)):
        sfm = built.root / f"sfm_{score}"
        assert built.triangulate(sfm, min_match_score=score).num_points3D() == points


@pytest.mark.parametrize("how", ["skip_geometric_verification", "estimate_two_view_geometries"])
def test_matches_are_verified_otherwise(built, how):
    """A tenth of the matches is wrong: taken as they are, or found out without the known poses."""
    with h5py.File(built.matches, "a") as file:
        for pair in list_h5_names(built.matches):
            matches = file[f"{pair}/matches0"][:]
            matches[:30] = np.roll(matches[:30], 1)
            file[f"{pair}/matches0"][:] = matches
    built.triangulate(built.root / "other", **{how: True})
    with pycolmap.Database.open(built.root / "other/database.db") as database:
        verified = database.num_inlier_matches() / database.num_matches()
    if how == "skip_geometric_verification":
        assert verified == 1
    else:
        assert 0.85 < verified < 0.95


def test_old_model_without_rigs(built):
    for name in ("rigs.bin", "frames.bin"):
        (built.model / name).unlink()
    again = built.triangulate(built.root / "sfm2")
    assert again.num_points3D() == 300


def test_what_is_no_map_is_not_replaced(built, tmp_path):
    folder = tmp_path / "precious"
    folder.mkdir()
    (folder / "thesis.txt").write_text("years of work")
    for target in (folder, built.model):
        with pytest.raises(InputError, match="not a map that this program"):
            built.triangulate(target)
    assert (folder / "thesis.txt").exists()


def test_a_map_of_hlocs_is_replaced(built):
    """Such as its empty one with pycolmap 4.2.1, but not one of other files."""
    sfm = built.root / "hlocs"
    sfm.mkdir()
    for name in ("database.db", "cameras.bin", "images.bin", "points3D.bin"):
        (sfm / name).write_bytes(b"")
    (sfm / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match="not replaced. Choose another folder"):
        built.triangulate(sfm)
    (sfm / "notes.txt").unlink()
    assert built.triangulate(sfm).num_points3D() == 300
    with pytest.raises(InputError, match="not replaced"):
        built.triangulate(built.model, overwrite=True)


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({}, (10.0, 10.0, 10.0)),
        ({"mapper": {"filter_max_reproj_error": 3.0}}, (3.0, 10.0, 10.0)),
        ({"triangulation": {"merge_max_reproj_error": 3.0}}, (10.0, 10.0, 3.0)),
    ],
)
def test_given_reprojection_errors_are_not_scaled(given, expected):
    options = colmap.mapper_options(given, 2.5)
    complete = options.triangulation.complete_max_reproj_error
    merge = options.triangulation.merge_max_reproj_error
    assert (options.mapper.filter_max_reproj_error, complete, merge) == expected


def test_wrong_mapper_options_are_refused_first(built):
    with pytest.raises(InputError, match="mapper options .*no_such"):
        built.triangulate(built.root / "new", mapper_options={"no_such": 1})
    assert not (built.root / ".new.tmp").exists()


def test_overflowed_matches_are_refused(built):
    """hloc's int16, which wraps to negative numbers."""
    with h5py.File(built.matches, "a") as file:
        file["db-0.jpg/db-1.jpg/matches0"][:5] = -200
    with pytest.raises(InputError, match="negative, as happens to hloc"):
        built.triangulate(built.root / "new")


def resize(features, ratio, names):
    """Move the keypoints of photos as if these were of another size."""
    with h5py.File(features, "a") as file:
        for name in names:
            keypoints = file[f"{name}/keypoints"]
            keypoints[:] = (keypoints[:] + 0.5) * ratio - 0.5
            file[f"{name}/image_size"] = np.round([640 * ratio, 480 * ratio]).astype(int)


@pytest.mark.fault(11)
@pytest.mark.parametrize("ratio", [0.5, 0.33, 2, 1])
def test_cameras_are_scaled_to_their_photos(ratio, built):
    """Points are where they were, and seen in the pixels of the photos."""
    resize(built.features, ratio, list_h5_names(built.features))
    found = built.triangulate(built.root / "resized")
    assert found.num_points3D() == 300
    for point in found.points3D.values():
        element = point.track.elements[0]
        name = found.images[element.image_id].name
        true = built.points[built.seen[name][element.point2D_idx]]
        np.testing.assert_allclose(point.xyz, true, atol=1e-2)
    (camera,) = found.cameras.values()
    assert [camera.width, camera.height] == [round(640 * ratio), round(480 * ratio)]
    assert camera.params[0] == pytest.approx(500 * ratio, rel=2e-3)


@pytest.mark.fault(11)
@pytest.mark.parametrize("corner", [(64, 48), (0, 0), (128, 40)])
def test_cropped_photos_of_the_same_shape_are_refused(corner, built):
    """Of 640x480 pixels, 512x384 are left: by their size, they could have been resized."""
    with h5py.File(built.features, "a") as file:
        for name in list_h5_names(built.features):
            file[f"{name}/keypoints"][:] -= np.array(corner, np.float32)
            file[f"{name}/image_size"] = np.array([512, 384])
    with pytest.raises(InputError, match="They were cropped rather than resized"):
        built.triangulate(built.root / "cropped")
    assert not (built.root / "cropped").exists()


@pytest.mark.fault(11)
def test_a_map_of_resized_photos_is_read_again(built, caplog, monkeypatch):
    monkeypatch.setattr(cli.logger, "propagate", True)
    resize(built.features, 0.5, list_h5_names(built.features))
    for _ in range(2):
        assert built.triangulate(built.root / "resized").num_points3D() == 300
    assert caplog.text.count("Cameras of the model are scaled") == 1
    assert caplog.text.count("is up to date") == 1


@pytest.mark.fault(11)
@pytest.mark.parametrize("odd", [False, True])
def test_maps_of_versions_that_did_not_compare_sizes(odd, built, monkeypatch):
    """One with unscaled cameras is made again; photos that do not fit cannot be."""
    with monkeypatch.context() as earlier:
        earlier.setattr(triangulation.sizes, "compare", lambda model, sizes: ({}, {}))
        names = list_h5_names(built.features)
        resize(built.features, 0.5, names[:1] if odd else names)
        resize(built.features, 1, names[1:] if odd else [])
        before = built.triangulate()
    after = built.triangulate()
    widths = [{camera.width for camera in sfm.cameras.values()} for sfm in (before, after)]
    assert widths == [{640}, {640} if odd else {320}]


@pytest.mark.fault(11)
def test_a_camera_does_not_fit_photos_of_two_sizes(built):
    resize(built.features, 0.5, ["db/0.jpg"])
    resize(built.features, 1, ["db/1.jpg"])
    said = "1 of 2 .*db/0.jpg .320x240, its camera 640x480: resized or cropped, unlike others"
    with pytest.raises(InputError, match=said):
        built.triangulate()
