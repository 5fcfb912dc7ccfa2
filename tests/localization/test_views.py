"""Queries that are stored turned, or of another size than the photos of a map."""

import cv2
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
from hloc_reduce.localization import views
from hloc_reduce.localization.intrinsics import MapCameras, merged, of_map
from hloc_reduce.localization.records import log_file, pose_of, read_records
from hloc_reduce.report import pictures
from hloc_reduce.report.runs import Run
from hloc_reduce.utils import colmap
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.feature_files import get_features, get_turns
from hloc_reduce.utils.images import ORIENTATION
from hloc_reduce.utils.parsers import parse_query_list, to_line
from pipelines import localize

PIPELINE = localize


def save(path, pixels, orientation=None):
    """Write a photo as it is, with an EXIF orientation."""
    exif = Image.Exif()
    if orientation is not None:
        exif[ORIENTATION] = orientation
    Image.fromarray(pixels).save(path, exif=exif)


@pytest.mark.fault(11)
@pytest.mark.parametrize(
    ("orientation", "orientations", "upright", "expected"),
    [
        (1, {1}, True, ()),
        (6, {1, 8}, True, ()),  # both are shown upright
        (6, {1}, False, views.TURNED),  # a map whose photos are shown as they are stored
        (None, {1}, True, views.TURNED),
        (99, {1}, True, views.TURNED),
        (1, set(), True, views.TURNED),
    ],
)
def test_photos_are_turned_unless_exif_data_tell(
    orientation, orientations, upright, expected, tmp_path
):
    save(tmp_path / "a.jpg", np.zeros((30, 40), np.uint8), orientation)
    of_map, preprocessing = MapCameras({}, {}, orientations=orientations), {"upright": upright}
    given = of_map, preprocessing
    assert views.others(tmp_path / "a.jpg", *given) == [*expected]
    assert views.others(np.zeros((30, 40), np.uint8), *given) == []  # taken to be upright
    found = views.of_folder(tmp_path, ["a.jpg", "absent.jpg"], *given)
    names = ["a.jpg", "absent.jpg"] if expected else ["absent.jpg"]
    assert found == dict.fromkeys(views.TURNED, names)


@pytest.mark.parametrize(("size", "others"), [(39, [views.OWN_SIZE]), (40, []), (41, [])])
def test_enlarged_photos_are_shown_as_they_are_too(size, others, tmp_path):
    """A small photo may be a part of a larger one."""
    pixels, preprocessing = np.zeros((30, size), np.uint8), {"resize_min": 40, "upright": True}
    of_map = MapCameras({}, {}, orientations={1})
    save(tmp_path / "a.png", pixels, 1)
    for image in (tmp_path / "a.png", pixels):
        assert views.others(image, of_map, preprocessing) == others


@pytest.mark.parametrize(
    ("sizes", "preprocessing", "expected"),
    [
        ([(1600, 1200)], {"resize_max": 1600}, (1600, 1600)),
        ([(640, 480), (300, 900)], {"resize_max": 1600}, (640, 900)),
        ([(4000, 3000), (3000, 4000)], {"resize_max": 1600}, (1600, 1600)),
        ([(4000, 3000), (640, 480)], {"resize_max": 1024}, (640, 1024)),
        ([(4000, 3000), (640, 480)], {"resize_max": 1600}, (1600, 1600)),  # too far apart
        ([(4000, 3000), (640, 480), (700, 100)], {"resize_max": 1600}, (700, 700)),
        ([(4000, 3000)], {"resize_max": None}, (None, None)),
        ([], {"resize_max": 1600}, (None, 1600)),
        ([(640, 480)], {"resize_max": 1024, "resize_force": True}, (None, 1024)),
        ([(640, 480)], {"resize_max": 1024, "resize_min": 800}, (800, 1024)),
    ],
)
def test_photos_are_shown_at_the_size_of_those_of_the_map(sizes, preprocessing, expected):
    found = views.at_one_size(preprocessing, sizes)
    assert (found.get("resize_min"), found["resize_max"]) == expected


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


def on_its_side(camera):
    """Return the intrinsics of a photo that is turned by 90 degrees."""
    params = [camera.focal_length, camera.height / 2, camera.width / 2]
    size = {"width": camera.height, "height": camera.width}
    return pycolmap.Camera(model="SIMPLE_PINHOLE", **size, params=params)


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
    other = on_its_side(camera)
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
        for one in ("left", "down", "right", "untold"):
            pose, info = found[one]
            assert info["num_matches"] == told["num_matches"]
            assert info["turned"] == (270 if one == "untold" else 0)
            number = turns[one][0]
            about_axis = pycolmap.Rotation3d(np.array([0, 0, -number * np.pi / 2]))
            back = pycolmap.Rigid3d(about_axis, np.zeros(3)) * expected
            distance, degrees = pose_error(pose, back)
            assert distance < 1e-3 and degrees < 0.05
        with_pixels = np.array(Image.open(tmp_path / "untold.png"))
        assert localizer.localize(with_pixels, other)[0] is None  # are taken to be upright
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
def test_a_folder_of_turned_queries(place, aachen_layout, tmp_path, run):
    """EXIF data tell nothing; the pipeline and the Localizer find the same, and the report."""
    build, images, outputs = place
    name = "query/day/a.png"
    queries = tmp_path / "turned"
    queries.mkdir()
    pixels = np.array(Image.open(images / name))
    noise = np.random.default_rng(0).integers(0, 255, pixels.shape, np.uint8)
    listed = aachen_layout / "queries/day_time_queries_with_intrinsics.txt"
    cameras = dict(parse_query_list(listed))
    camera, lines = cameras[name], []
    for number in range(4):
        save(queries / f"{90 * number}.png", np.rot90(pixels, -number))
    for other, content in (("noise", noise), ("grey", np.full_like(pixels, 128))):
        save(queries / f"{other}.png", content)
    taken = {}
    for photo in sorted(queries.iterdir()):
        taken[photo.name] = (
            camera if photo.stem in ("0", "180", "noise", "grey") else on_its_side(camera)
        )
        one = taken[photo.name]
        lines.append(to_line(photo.name, one.model.name, one.width, one.height, *one.params))
    write(tmp_path / "turned.txt", "".join(lines))
    given = "--query_images", queries, "--queries", tmp_path / "turned.txt"
    run(*build, "--feature", "mini32", *given)
    folder = outputs / "queries-turned"
    summary, rows = outcome(folder)
    localizer = Localizer(outputs / "map")
    for number in range(4):
        row = rows[f"{90 * number}.png"]
        assert row["status"] == "localized" and int(row["turned"]) == 90 * number
        pose, info = localizer.localize(queries / f"{90 * number}.png", taken[f"{90 * number}.png"])
        assert info["turned"] == 90 * number
        record = read_records(log_file(folder / summary["poses"]))[f"{90 * number}.png"]
        assert pose_error(pose, pose_of(record))[0] < 1e-6
    assert summary["queries_turned"] == 3
    for other in ("noise.png", "grey.png"):
        pose, info = localizer.localize(queries / other, camera)
        assert pose is None and rows[other]["status"] == "fallback"
        told = {key: str(info[key]) for key in ("reason", "turned", "num_inliers")}
        assert told == {key: rows[other][key] for key in told}
    assert rows["grey.png"]["reason"] == "no keypoints"
    found = Run(folder)
    assert all(pictures.matched(found, f"{n}.png")["inliers"].sum() > 50 for n in (0, 90, 180, 270))
    assert pictures.matched(found, "noise.png") is not None
    before = {path: path.stat().st_mtime_ns for path in folder.glob("*.h5")}
    run("--map", outputs / "map", "--outputs", outputs, *given)
    again, same = outcome(folder)
    assert same == rows and again["tries"] == summary["tries"]
    assert pictures.matched(Run(folder), "noise.png") is not None
    assert {path: path.stat().st_mtime_ns for path in folder.glob("*.h5")} == before


@pytest.mark.parametrize("small", ["query", "map"])
def test_photos_of_another_size(small, place, aachen_layout, tmp_path, run):
    """A network finds photos of a third of the size, or in a map of half the size."""
    build, images, outputs = place
    listed = aachen_layout / "queries/day_time_queries_with_intrinsics.txt"
    name, camera = parse_query_list(listed)[0]

    def reduced(photo, size):
        (tmp_path / "small" / photo).parent.mkdir(parents=True, exist_ok=True)
        pixels = cv2.resize(np.array(Image.open(images / photo)), size, None, 0, 0, cv2.INTER_AREA)
        save(tmp_path / "small" / photo, pixels)

    run(*build, "--feature", "mini32")
    queries = images
    if small == "query":
        camera.rescale(1 / 3)
        reduced(name, (camera.width, camera.height))
        queries = tmp_path / "small"
    else:
        model = colmap.read_model(build[1])
        for one in model.cameras.values():
            one.rescale(1 / 2)
        for image in model.images.values():
            reduced(image.name, (image.camera.width, image.camera.height))
        (tmp_path / "sparse").mkdir()
        model.write(tmp_path / "sparse")
        outputs = tmp_path / "of small photos"
        given = "--map", tmp_path / "sparse", "--map_images", tmp_path / "small"
        run(*given, "--outputs", outputs, "--feature", "mini32")
    localizer = Localizer(outputs / "map")
    _, info = localizer.localize(queries / name, camera)
    localizer.preprocessing = features.confs["mini32"]["preprocessing"]
    _, as_stored = localizer.localize(queries / name, camera)
    assert info["num_inliers"] > 1.5 * as_stored["num_inliers"]
    line = to_line(name, camera.model.name, camera.width, camera.height, *camera.params)
    given = "--query_images", queries, "--queries", write(tmp_path / "one.txt", line)
    run("--map", outputs / "map", "--outputs", outputs, *given)
    _, rows = outcome(outputs / "queries-one")
    assert int(rows[name]["num_inliers"]) == info["num_inliers"]


@pytest.mark.parametrize("given", ["a part", "pairs"])
def test_other_views_in_a_pipeline(given, place, aachen_layout, tmp_path, run, monkeypatch):
    """A part of a photo is found as it is; with given pairs, a turned photo, by LightGlue, too."""
    model = {"name": "lightglue", "max_keypoints": 512}
    monkeypatch.setitem(matchers_confs.confs["lightglue"], "model", model)
    build, images, outputs = place
    listed = aachen_layout / "queries/day_time_queries_with_intrinsics.txt"
    name, camera = parse_query_list(listed)[0]
    pixels = np.array(Image.open(images / name))
    (tmp_path / "new").mkdir()
    run(*build, "--feature", "mini32")
    options: tuple = ()
    if given == "a part":
        width, height = camera.width // 2, camera.height // 2
        x, y = (camera.width - width) // 2, (camera.height - height) // 2
        pixels = pixels[y : y + height, x : x + width]
        params = [camera.focal_length, camera.principal_point_x - x, camera.principal_point_y - y]
    else:
        pixels = np.rot90(pixels, 3)
        width, height = camera.height, camera.width
        params = on_its_side(camera).params
        pairs = [f"a.png {path.relative_to(images)}\n" for path in sorted(images.glob("db/*"))]
        write(tmp_path / "pairs.txt", "".join(pairs))
        options = "--retrieval", tmp_path / "pairs.txt", "--matcher", "NN+lightglue"
    save(tmp_path / "new/a.png", pixels)
    write(tmp_path / "one.txt", to_line("a.png", "SIMPLE_PINHOLE", width, height, *params))
    query = "--query_images", tmp_path / "new", "--queries", tmp_path / "one.txt"
    run("--map", outputs / "map", "--outputs", outputs, *query, *options)
    folder = outputs / "queries-one"
    summary, rows = outcome(folder)
    assert rows["a.png"]["status"] == "localized"
    found = Run(folder)
    record = found.records["a.png"]
    assert record["turned"] == (0 if given == "a part" else 90) and not record["again"]
    assert found.file_of("a.png", "features").name.endswith(
        "-own-size.h5" if given == "a part" else "-turned90.h5"
    )
    assert pictures.matched(found, "a.png")["inliers"].sum() > 10
    if given == "pairs":
        assert [*folder.glob("*_matches-lightglue_*-again.h5")]
        assert summary["queries_turned"] == 1
