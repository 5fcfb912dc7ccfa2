"""Queries that are stored turned against the photos of a map."""

import h5py
import numpy as np
import pycolmap
import pytest
from command import outcome, write
from PIL import Image

from hloc_reduce import Localizer, compact, extract_features, extractors
from hloc_reduce.confs import features
from hloc_reduce.confs import matchers as matchers_confs
from hloc_reduce.evaluation.poses import pose_error
from hloc_reduce.localization import turned
from hloc_reduce.localization.intrinsics import MapCameras, merged, of_map
from hloc_reduce.utils import colmap
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.feature_files import get_features, get_turns
from hloc_reduce.utils.images import ORIENTATION
from hloc_reduce.utils.parsers import parse_query_list
from pipelines import localize

PIPELINE = localize
LANDSCAPE, PORTRAIT = (40, 30), (30, 40)
SAID = "it is stored turned against the map's photos"
PERHAPS = "it may be stored turned against the map's photos"


def save(path, pixels, orientation=None):
    """Write a photo as it is, with an EXIF orientation."""
    exif = Image.Exif()
    if orientation is not None:
        exif[ORIENTATION] = orientation
    Image.fromarray(pixels).save(path, exif=exif)


@pytest.mark.fault(11)
@pytest.mark.parametrize(
    ("size", "orientation", "sizes", "orientations", "said"),
    [
        (LANDSCAPE, None, {LANDSCAPE}, {1}, None),
        (LANDSCAPE, 1, {LANDSCAPE}, {1}, None),
        (LANDSCAPE, 99, {LANDSCAPE}, {1}, None),
        (LANDSCAPE, 3, {LANDSCAPE}, {1}, f"{SAID} (EXIF orientation 3, theirs 1)"),
        (LANDSCAPE, None, {PORTRAIT}, {8}, f"{PERHAPS} (landscape, theirs portrait)"),
        (LANDSCAPE, None, {LANDSCAPE}, {6}, None),  # perhaps as theirs
        (PORTRAIT, 1, {LANDSCAPE}, {1}, None),  # the camera was upright
        (LANDSCAPE, 8, {PORTRAIT}, {6, 8}, None),
        (PORTRAIT, 99, {LANDSCAPE}, {1}, f"{PERHAPS} (portrait, theirs landscape)"),
        (LANDSCAPE, 6, {LANDSCAPE}, {1, 8}, f"{SAID} (EXIF orientation 6, theirs 1, 8)"),
        (PORTRAIT, 8, {LANDSCAPE, PORTRAIT}, {1, 8}, None),
        (PORTRAIT, None, {LANDSCAPE}, {1}, f"{PERHAPS} (portrait, theirs landscape)"),
        (LANDSCAPE, None, {PORTRAIT}, set(), f"{PERHAPS} (landscape, theirs portrait)"),
        (PORTRAIT, 6, {LANDSCAPE}, set(), f"{PERHAPS} (portrait, theirs landscape)"),  # an old map
        (LANDSCAPE, 6, {LANDSCAPE}, set(), None),
        ((30, 30), None, {LANDSCAPE}, {1}, None),
        (LANDSCAPE, None, {(30, 30)}, {1}, None),
        (LANDSCAPE, None, set(), {1}, None),
    ],
)
def test_which_photos_are_turned(size, orientation, sizes, orientations, said, tmp_path):
    save(tmp_path / "a.jpg", np.zeros(size[::-1], np.uint8), orientation)
    found = turned.reason(tmp_path / "a.jpg", MapCameras({}, sizes, orientations=orientations))
    assert found is None if said is None else found.startswith(f"{said}, which this feature")


@pytest.mark.fault(11)
@pytest.mark.parametrize(
    ("found", "known"),
    [([1, 1], {1}), ([1, 6], {1, 6}), ([1, None], set()), ([None, None], set()), ([6, 99], set())],
)
def test_orientations_of_a_map_are_known_if_all_photos_have_them(found, known, tmp_path):
    model, pixels = pycolmap.Reconstruction(), np.zeros((30, 40), np.uint8)
    camera = pycolmap.Camera(
        model="SIMPLE_PINHOLE", width=40, height=30, params=[50, 20, 15], camera_id=1
    )
    for number, orientation in enumerate(found, start=1):
        save(tmp_path / f"{number}.jpg", pixels, orientation)
        image = pycolmap.Image(name=f"{number}.jpg", camera_id=1, image_id=number)
        colmap.add_image(model, camera, image, pycolmap.Rigid3d())
    assert of_map(model, tmp_path).orientations == known
    parts = [of_map(model, tmp_path, [f"{number}.jpg"]) for number in (1, 2)]
    assert merged(*parts).orientations == known  # a map to which a photo was added
    assert merged(parts[0], of_map(model, tmp_path, [])).orientations == parts[0].orientations


def test_a_photo_that_cannot_be_read_is_not_turned(tmp_path):
    of_map = MapCameras({}, {LANDSCAPE}, orientations={8})
    assert turned.reason(write(tmp_path / "a.jpg", "broken"), of_map) is None
    assert turned.reason(tmp_path / "absent.jpg", of_map) is None
    assert turned.reason(np.zeros((30, 40, 3), np.uint8), of_map) is None  # no EXIF data
    assert turned.reason(np.zeros((40, 30), np.uint8), of_map).startswith(PERHAPS)


@pytest.mark.fault(11)
@pytest.mark.parametrize(
    ("model", "invariant"),
    [
        (features.confs["colmap_sift_sv64"]["model"], True),
        (features.confs["hardnet"]["model"], True),
        ({"name": "dog", "options": {"upright": True}, "descriptor": "colmap_sift"}, False),
        (features.confs["mini32"]["model"], False),
    ],
)
def test_features_are_invariant_if_their_keypoints_have_orientations(model, invariant, monkeypatch):
    monkeypatch.setattr("hloc_reduce.extractors.dog.Descriptor", lambda name: None)
    assert extractors.load(model).rotation_invariant == invariant
    assert extractors.is_rotation_invariant(model) == invariant


@pytest.mark.fault(11)
@pytest.mark.parametrize("known", [lambda conf: conf, lambda conf: {"name": "hloc", "conf": conf}])
@pytest.mark.parametrize(("name", "invariant"), [("dog", True), ("disk", False)])
def test_a_feature_of_hloc_is_known_where_hloc_is_not_installed(
    known, name, invariant, monkeypatch
):
    """Queries that were localized need not be described again."""
    monkeypatch.setattr("hloc_reduce.utils.hloc.find_spec", lambda name: None)
    model = {"name": "reduced", "base": known({"name": f"hloc.{name}"})}
    with pytest.raises(InputError, match="hloc is not installed"):
        extractors.load(model)
    assert extractors.is_rotation_invariant(model) == invariant


@pytest.mark.parametrize(
    ("size", "orientation", "sizes", "orientations", "said"),
    [
        (LANDSCAPE, 6, {LANDSCAPE}, {1}, None),  # both upright, by EXIF data
        (LANDSCAPE, 6, {LANDSCAPE}, {6, 8}, None),
        (LANDSCAPE, None, {LANDSCAPE}, {6, 8}, f"{PERHAPS} (landscape, theirs portrait)"),
        (PORTRAIT, None, {LANDSCAPE}, {6, 8}, None),
        (PORTRAIT, None, {LANDSCAPE}, {1, 6}, None),  # there may be both
        (LANDSCAPE, None, {LANDSCAPE}, {1, 6}, None),
        (PORTRAIT, None, {LANDSCAPE}, {1, 3}, f"{PERHAPS} (portrait, theirs landscape)"),
        (LANDSCAPE, 6, {LANDSCAPE}, set(), f"{PERHAPS} (portrait, theirs landscape)"),
        (PORTRAIT, 6, {LANDSCAPE}, set(), None),
    ],
)
def test_which_upright_photos_are_turned(size, orientation, sizes, orientations, said, tmp_path):
    save(tmp_path / "a.jpg", np.zeros(size[::-1], np.uint8), orientation)
    of_map = MapCameras({}, sizes, orientations=orientations)
    found = turned.reason(tmp_path / "a.jpg", of_map, upright=True)
    assert found is None if said is None else found.startswith(f"{said}, which this feature")


@pytest.mark.parametrize("matcher", ["NN-mutual", "lightglue"])
def test_a_network_sees_photos_upright(matcher, place, aachen_layout, tmp_path, run, monkeypatch):
    """A query that is stored turned has the pose of the upright one, turned about its axis."""
    model = {"name": "lightglue", "max_keypoints": 512}
    monkeypatch.setitem(matchers_confs.confs["lightglue"], "model", model)
    build, images, outputs = place
    for photo in sorted(images.glob("db/*.png")):
        save(photo, np.array(Image.open(photo)), 1)
    run(*build, "--feature", "mini32", "--storage", "uint2", "--matcher", matcher)
    compact.main(tmp_path / "map.hlm", outputs / "map")
    listed = aachen_layout / "queries/day_time_queries_with_intrinsics.txt"
    name, camera = parse_query_list(listed)[0]
    pixels = np.array(Image.open(images / name))
    focal = camera.focal_length
    params = [focal, camera.height / 2, camera.width / 2]
    other = pycolmap.Camera(
        model="SIMPLE_PINHOLE", width=camera.height, height=camera.width, params=params
    )
    turns = {"upright": (0, 1), "left": (1, 6), "down": (2, 3), "right": (3, 8), "untold": (1, 99)}
    for one, (number, orientation) in turns.items():
        save(tmp_path / f"{one}.png", np.rot90(pixels, number), orientation)
    for path in (outputs / "map", tmp_path / "map.hlm"):
        localizer = Localizer(path)
        found = {
            one: localizer.localize(tmp_path / f"{one}.png", other if number % 2 else camera)
            for one, (number, _) in turns.items()
        }
        expected, told = found["upright"]
        for one in ("left", "down", "right"):
            pose, info = found[one]
            assert info["num_matches"] == told["num_matches"]
            number = turns[one][0]
            about_axis = pycolmap.Rotation3d(np.array([0, 0, -number * np.pi / 2]))
            back = pycolmap.Rigid3d(about_axis, np.zeros(3)) * expected
            distance, degrees = pose_error(pose, back)
            assert distance < 1e-3 and degrees < 0.05
        assert found["untold"][0] is None
    extract_features.main(
        features.confs["mini32"], tmp_path, feature_path=tmp_path / "f.h5", image_list=["left.png"]
    )
    with h5py.File(tmp_path / "f.h5") as file:
        assert get_turns(file, "left.png") == 3
        found = get_features(file, "left.png", ["keypoints", "image_size"])
        assert found["image_size"].tolist() == [camera.width, camera.height]
        assert found["keypoints"][:, 0].max() > camera.height  # of the upright photo
        assert file["left.png/keypoints"][:, 0].max() < camera.height


@pytest.mark.fault(11)
@pytest.mark.parametrize("invariant", [True, False])
def test_the_reason_says_that_a_query_is_turned(invariant, place, tmp_path, monkeypatch, run):
    monkeypatch.setattr("hloc_reduce.detectors.dog.is_rotation_invariant", lambda conf: invariant)
    build, images, outputs = place
    for photo in sorted(images.glob("db/*.png")):
        save(photo, np.array(Image.open(photo)), 1)
    noise = np.random.default_rng(0).integers(0, 255, (270, 360), np.uint8)
    queries = tmp_path / "turned"
    queries.mkdir()
    for name, pixels, orientation in (
        ("upright.png", noise, 1),
        ("left.png", np.rot90(noise), None),
        ("upside_down.png", np.rot90(noise, 2), 3),
        ("grey.png", np.full_like(noise, 128), 3),
    ):
        save(queries / name, pixels, orientation)
    run(*build, "--query_images", queries)
    _, rows = outcome(outputs / "queries-turned")
    said = {name: row["reason"] for name, row in rows.items()}
    assert said["grey.png"] == "no keypoints"
    assert said["upright.png"] and "stored" not in said["upright.png"]
    clauses = {"left.png": PERHAPS, "upside_down.png": SAID}
    for name, clause in clauses.items():
        assert said[name] and (clause in said[name]) != invariant
    compact.main(tmp_path / "map.hlm", outputs / "map")
    for path in (outputs / "map", tmp_path / "map.hlm"):
        localizer = Localizer(path)
        assert localizer.cameras.orientations == {1}
        for name, clause in clauses.items():
            assert (clause in localizer.localize(queries / name)[1]["reason"]) != invariant
