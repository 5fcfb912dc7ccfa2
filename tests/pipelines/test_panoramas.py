"""Panoramas, which are seen as rigs of perspective views."""

import json

import cv2
import numpy as np
import pycolmap
import pytest
from command import outcome, state, write

from benchmarks.metres import geotag
from hloc_reduce import Localizer
from hloc_reduce.evaluation.poses import pose_error
from hloc_reduce.localization import gps, panoramas
from hloc_reduce.localization.records import read_records
from hloc_reduce.localization.rigs import frames
from hloc_reduce.report import pictures, runs
from hloc_reduce.utils import parsers
from hloc_reduce.utils.cli import InputError
from pipelines import localize

PIPELINE = localize
WIDTH = 2048
LOBBY = {"image_prefix": "lobby/", "ref_sensor": True}


def rays(width):
    """Return the unit rays (W / 2, W, 3) of the pixels of a panorama: x right, y down, z ahead."""
    longitude = ((np.arange(width) + 0.5) / width - 0.5) * 2 * np.pi
    latitude = ((np.arange(width // 2) + 0.5) / width * 2 - 0.5) * np.pi
    longitude, latitude = np.meshgrid(longitude, latitude)
    x, z = np.sin(longitude) * np.cos(latitude), np.cos(longitude) * np.cos(latitude)
    return np.stack([x, np.sin(latitude), z], axis=-1)


def of_photo(path, camera, width=WIDTH):
    """Return a panorama (H, W, 3) of a place that is grey but for what a photo shows, ahead."""
    seen = rays(width)
    photo, z = cv2.imread(str(path))[..., ::-1], np.where(seen[..., 2] > 0.1, seen[..., 2], np.inf)
    pixels = camera.img_from_cam((seen / z[..., None]).reshape(-1, 3)) - 0.5
    pixels[~np.isfinite(z).ravel()] = -99
    maps = pixels.astype(np.float32).reshape(*z.shape, 2)
    image = cv2.remap(photo, maps, None, cv2.INTER_CUBIC, borderValue=(128, 128, 128))
    return np.ascontiguousarray(image)


@pytest.mark.parametrize("width", [1024, 8192])
def test_views_show_what_is_in_their_directions(width):
    """The colours of a panorama are its rays; large ones are made smaller."""
    colours = (127.5 + 127 * rays(width)).round().astype(np.uint8)
    views = panoramas.views_of((width, width // 2))
    assert len({view.name for view in views}) == len(views) == panoramas.NUM_VIEWS
    assert np.allclose(views[0].cam_from_rig.matrix(), np.eye(3, 4))
    for view, seen in zip(views, panoramas.render(colours, views), strict=True):
        camera = view.camera
        assert seen.shape == (camera.height, camera.width, 3)
        assert camera.width == min(1600, round(width / np.pi))
        assert not view.cam_from_rig.translation.any()
        grid = np.stack(np.meshgrid(*[np.arange(camera.width) + 0.5] * 2), axis=-1).reshape(-1, 2)
        directions = np.pad(camera.cam_from_img(grid), ((0, 0), (0, 1)), constant_values=1)
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        expected = directions @ view.cam_from_rig.rotation.matrix()  # in the panorama
        found = (seen.reshape(-1, 3) - 127.5) / 127
        assert np.abs(found - expected).max() < 0.02


def test_a_view_to_the_right():
    """Of a panorama whose left half is black."""
    image = np.zeros((512, 1024), np.uint8)
    image[:, 512:] = 255
    views = panoramas.views_of((1024, 512))
    shown = dict(zip([view.name for view in views], panoramas.render(image, views), strict=True))
    assert shown["view060-326/"].mean() > 200 > 55 > shown["view300-326/"].mean()


def test_views_are_where_their_panorama_is(tmp_path):
    place = np.array([47.375, 8.5, 408.5])
    cv2.imwrite(str(tmp_path / "untold.jpg"), np.zeros((512, 1024, 3), np.uint8))
    geotag(tmp_path / "untold.jpg", tmp_path / "a.jpg", place)
    cv2.imwrite(str(tmp_path / "b.png"), np.zeros((512, 1024, 3), np.uint8))
    sizes = dict.fromkeys(("a.jpg", "b.png"), (1024, 512))
    views = tmp_path / "views"
    assert panoramas.write_views(tmp_path, sizes, views) == {}
    names = sorted(path.relative_to(views).as_posix() for path in views.rglob("*.jpg"))
    of_views = panoramas.of_views([*names, "photo.jpg"])
    assert of_views["a.jpg"] == "view000-326/a.jpg"
    assert of_views["b.png"] == "view000-326/b.png.jpg" and "photo.jpg" not in of_views
    found = gps.of_photos(views, names)
    assert [*found] == [name for name in names if name.endswith("a.jpg")]
    assert all(np.allclose(one, place) for one in found.values())


@pytest.fixture
def panorama(place, build_map, plane, tmp_path):
    """A folder with a panorama of the place, its true pose, and the outputs with the map."""
    build_map()
    _, images, outputs = place
    model = pycolmap.Reconstruction(plane / "model")
    image = model.find_image_with_name("4.png")
    pixels = of_photo(images / "query/day/a.png", image.camera)
    folder = tmp_path / "panoramas"
    (folder / "lobby").mkdir(parents=True)
    cv2.imwrite(str(folder / "lobby/1.png"), pixels[..., ::-1])
    return folder, image.cam_from_world(), outputs


def test_panoramas_are_queries(panorama, run):
    folder, true, outputs = panorama
    given = "--map", outputs / "map", "--query_images", folder, "--outputs", outputs, "--panoramas"
    run(*given)
    results = outputs / "queries-panoramas"
    summary, rows = outcome(results)
    assert summary["queries"] == summary["queries_localized"] == 1
    assert rows["lobby/1.png"]["status"] == "localized"
    pose = parsers.parse_poses(results / summary["poses"])["lobby/1.png"]
    distance, degrees = pose_error(pose, true)
    assert distance < 0.02 and degrees < 0.3
    records = read_records(results / f"{summary['poses']}_logs.jsonl")
    of_views = read_records(results / f"views_{summary['poses']}_logs.jsonl")
    assert len(of_views) == panoramas.NUM_VIEWS and [*records] == ["lobby/1.png"]
    inliers = [one["num_inliers"] for one in of_views.values()]
    assert records["lobby/1.png"]["num_inliers"] == sum(inliers)
    assert (
        max(
            pose_error(
                pose,
                parsers.parse_poses(results / f"views_{summary['poses']}")[
                    "view000-652/lobby/1.png.jpg"
                ],
            )
        )
        < 1e-6
    )
    before = state(results / "views")
    run(*given)
    assert state(results / "views") == before
    # reports show the view with the most inliers
    shown = runs.Run(results)
    found = pictures.matched(shown, "lobby/1.png")
    assert 0.3 * max(inliers) < found["inliers"].sum() <= max(inliers)
    assert pictures.draw(shown, "lobby/1.png", found).ndim == 3
    # the panorama is turned: what is a quarter of a turn to the left is in its centre now
    path = folder / "lobby/1.png"
    cv2.imwrite(str(path), np.roll(cv2.imread(str(path)), WIDTH // 4, axis=1))
    run(*given)
    left = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0, np.pi / 2, 0])), np.zeros(3))
    pose = parsers.parse_poses(results / summary["poses"])["lobby/1.png"]
    distance, degrees = pose_error(pose, left * true)
    assert distance < 0.02 and degrees < 0.3


@pytest.mark.parametrize(
    ("kind", "why"),
    [("empty", "it is empty"), ("part", "it is not an image, or it is truncated")],
)
def test_a_panorama_that_cannot_be_read_does_not_stop_the_others(
    kind, why, panorama, run, refused, caplog
):
    """It is a query that is not localized, also if its head, with its size, can be read."""
    folder, _, outputs = panorama
    path, whole = folder / "lobby/2.png", (folder / "lobby/1.png").read_bytes()
    path.write_bytes(whole[:1000] if kind == "part" else b"")
    given = "--map", outputs / "map", "--query_images", folder, "--outputs", outputs, "--panoramas"
    assert f"Cannot read image {path}: " in refused(*given, "--strict")
    caplog.clear()
    results = outputs / "queries-panoramas"
    for _ in range(2):  # the second time, only it is read again
        run(*given)
        summary, rows = outcome(results)
        assert (summary["queries"], summary["queries_localized"]) == (2, 1)
        assert summary["queries_unreadable"] == 1 and rows["lobby/1.png"]["status"] == "localized"
        assert rows["lobby/2.png"]["status"] == "fallback"
        assert rows["lobby/2.png"]["reason"] == f"Cannot read image {path}: {why}."
        assert (
            f"1 of 2 queries are unreadable and not localized: lobby/2.png ({why})" in caplog.text
        )
        caplog.clear()
    of_views = read_records(results / f"views_{summary['poses']}_logs.jsonl")
    assert pictures.matched(runs.Run(results), "lobby/2.png") is None
    path.write_bytes(whole)
    run(*given)
    summary, rows = outcome(results)
    assert summary["queries_localized"] == 2 and summary["queries_unreadable"] == 0
    again = read_records(results / f"views_{summary['poses']}_logs.jsonl")
    ours = [name for name in again if "lobby/1.png" in name]
    assert ours and all(again[name] == of_views[name] for name in ours)


def test_maps_are_not_built_without_panoramas_that_cannot_be_read(tmp_path, refused):
    folder = tmp_path / "photos"
    folder.mkdir()
    for name in ("1.png", "2.png", "3.png"):
        cv2.imwrite(str(folder / name), np.zeros((512, 1024), np.uint8))
    (folder / "2.png").write_bytes(b"")
    given = "--map_images", folder, "--panoramas", "--outputs", tmp_path / "new"
    assert f"Cannot read image {folder / '2.png'}" in refused(*given)
    assert not (tmp_path / "new/map-views").exists()


def test_a_panorama_in_memory(panorama):
    folder, true, outputs = panorama
    localizer = Localizer(outputs / "map")
    pose, info = localizer.localize_panorama(folder / "lobby/1.png")
    distance, degrees = pose_error(pose, true)
    assert distance < 0.02 and degrees < 0.3
    assert len(info["cameras"]) == len(info["cams_from_rig"]) == panoramas.NUM_VIEWS
    for shape in ((500, 900, 3), (400, 800)):
        with pytest.raises(InputError, match="twice as wide as high and has 1024 pixels"):
            localizer.localize_panorama(np.zeros(shape, np.uint8))


def test_what_is_no_panorama(panorama, place, tmp_path, refused):
    folder, _, outputs = panorama
    _, images, _ = place
    given = "--map", outputs / "map", "--outputs", outputs, "--query_images"
    photos = images / "query/day"
    message = refused(*given, photos, "--panoramas")
    assert "is a panorama of all directions" in message and "leave out --panoramas" in message
    listed = tmp_path / "queries.txt"
    listed.write_text("lobby/1.png PINHOLE 9 9 9 9 9 9\n")
    message = refused(*given, folder, "--panoramas", "--queries", listed)
    assert "leave out --queries" in message
    cv2.imwrite(str(folder / "small.png"), np.zeros((400, 800), np.uint8))
    assert "too small, less than 1024 pixels wide: small.png" in refused(
        *given, folder, "--panoramas"
    )
    cv2.imwrite(str(folder / "small.png"), np.zeros((480, 640), np.uint8))
    message = refused(*given, folder, "--panoramas")
    assert "not twice as wide as high: small.png" in message
    assert not (outputs / "queries-panoramas").exists()


@pytest.mark.parametrize("xmp", [b'GPano:ProjectionType="equirectangular"', b"no"])
def test_xmp_data_tell_panoramas(xmp, tmp_path):
    _, encoded = cv2.imencode(".jpg", np.zeros((512, 1024), np.uint8))
    data = encoded.tobytes()
    payload = b"http://ns.adobe.com/xap/1.0/\0" + xmp
    marker = b"\xff\xe1" + (len(payload) + 2).to_bytes(2, "big") + payload
    (tmp_path / "1.jpg").write_bytes(data[:2] + marker + data[2:])
    found = panoramas.find(tmp_path, ["1.jpg"])
    is_told = xmp != b"no"
    assert found == ({"1.jpg": (1024, 512)} if is_told else {})
    cv2.imwrite(str(tmp_path / "2.jpg"), np.zeros((512, 1024), np.uint8))
    if is_told:
        with pytest.raises(InputError, match=r"1.jpg, and other photos, without .*: 2.jpg"):
            panoramas.find(tmp_path, ["1.jpg", "2.jpg"])
    assert len(panoramas.find(tmp_path, ["1.jpg", "2.jpg"], given=True)) == 2


@pytest.mark.parametrize(("full", "is_whole"), [(1024, True), (2048, False)])
def test_parts_of_panoramas_are_none(full, is_whole, tmp_path):
    """Though they are twice as wide as high, as those of 180 degrees are."""
    xmp = (
        b'<x GPano:ProjectionType="equirectangular" GPano:CroppedAreaImageWidthPixels="1024" '
        b'GPano:FullPanoWidthPixels="%d"/>'
    )
    _, encoded = cv2.imencode(".jpg", np.zeros((512, 1024), np.uint8))
    payload = b"http://ns.adobe.com/xap/1.0/\0" + xmp % full
    marker = b"\xff\xe1" + (len(payload) + 2).to_bytes(2, "big") + payload
    (tmp_path / "1.jpg").write_bytes(encoded.tobytes()[:2] + marker + encoded.tobytes()[2:])
    for given in (False, True):
        assert bool(panoramas.find(tmp_path, ["1.jpg"], given)) == is_whole


def test_records_of_panoramas(tmp_path):
    """The pose of a panorama is that of its place, from any of its views."""
    views = {view.name: view.cam_from_rig for view in panoramas.views_of((1024, 512))}
    true = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.1, 2, 0.3])), np.array([1, 2, 3.0]))

    def record(pose, inliers, reason):
        x, y, z, w = pose.rotation.quat
        numbers = dict.fromkeys(("num_matches", "num_without_point", "num_correspondences"), 7)
        said = {"frame": "a.jpg", "reason": reason, "tried": 0}
        pose = {"qvec": [w, x, y, z], "tvec": pose.translation.tolist()}
        told = {"num_inliers": inliers, "confidence": 9.0, "covariance": np.eye(6).tolist()}
        return numbers | pose | told | {"reason": None, "localized": True, "rig": said}

    for best, reason in (("view240-326/", None), ("view060-326/", "the rig contradicts")):
        records = {
            name: record(pose * true, 50 if name == best else 3, reason)
            for name, pose in views.items()
        }
        found = panoramas.write_records({"a.jpg": views}, records, tmp_path / "poses.txt")["a.jpg"]
        assert (found["localized"], found["reason"]) == (reason is None, reason)
        assert found["num_inliers"] == 50 + 3 * 5 and found["num_matches"] == 7 * 6
        assert (found["covariance"] is None) == (reason is not None)
        pose = parsers.parse_poses(tmp_path / "poses.txt")["a.jpg"]
        assert max(pose_error(pose, true)) < 1e-6
    lines = (tmp_path / "poses.txt_logs.jsonl").read_text().splitlines()
    assert json.loads(lines[1])[0] == "a.jpg" and len(lines) == 2


def test_views_are_a_rig(tmp_path):
    """As COLMAP has it; those of panoramas that have changed, or are not there, are dropped."""
    images, folder = tmp_path / "images", tmp_path / "views"
    images.mkdir()
    sizes = {"a.jpg": (1024, 512), "b.jpg": (1024, 512), "c.jpg": (2048, 1024)}
    for name, (width, height) in sizes.items():
        cv2.imwrite(str(images / name), np.zeros((height, width), np.uint8))
    shown, rigs = panoramas.write_rigs(images, sizes, folder)
    names = sorted(path.relative_to(shown).as_posix() for path in shown.rglob("*.jpg"))
    assert len(names) == 3 * panoramas.NUM_VIEWS
    found = frames(rigs, names)
    assert sorted(found) == ["view000-326/a.jpg", "view000-326/b.jpg", "view000-652/c.jpg"]
    for frame, views in found.items():
        expected = panoramas.views_of(sizes[frame.partition("/")[2]])
        for view, pose in zip(expected, views.values(), strict=True):
            assert np.allclose(pose.matrix(), view.cam_from_rig.matrix())
    before = state(folder)
    panoramas.write_rigs(images, sizes, folder)
    assert state(folder) == before
    cv2.imwrite(str(images / "a.jpg"), np.full((512, 1024), 200, np.uint8))
    del sizes["c.jpg"]
    panoramas.write_rigs(images, sizes, folder)
    assert len([*shown.rglob("*.jpg")]) == 2 * panoramas.NUM_VIEWS
    assert cv2.imread(str(shown / "view060-326/a.jpg")).mean() > 190


def test_options_of_panoramas(panorama, place, plane, tmp_path, refused):
    """Which are for the map, the queries, or both."""
    folder, _, outputs = panorama
    new = tmp_path / "new"
    given = "--panoramas", "--outputs", new, "--map_images", plane / "images"
    assert "is a panorama of all directions" in refused(*given)
    assert "--panoramas is for queries and maps" in refused(*given, "--map", plane / "model")
    assert not (new / "map").exists()
    add = "--map", outputs / "map", "--add_images", folder, "--panoramas"
    assert "--panoramas cannot be added" in refused(*add)
    one = "--panoramas", "--outputs", new, "--map_images", folder
    rigs = write(tmp_path / "rigs.json", json.dumps([{"cameras": [LOBBY]}]))
    said = "Panoramas are rigs of their own views: leave out --rigs"
    assert said in refused(*one, "--rigs", rigs)
    of_queries = "--map", outputs / "map", "--query_images", folder, "--outputs", outputs
    assert said in refused(*of_queries, "--panoramas", "--rigs", rigs)
    assert "The lens of panoramas is known" in refused(*one, "--camera_model", "OPENCV")
    assert "leave out --camera_mode" in refused(*one, "--camera_mode", "single")
    assert "COLMAP could not reconstruct" in refused(*one)
    assert len([*(new / "map-views/images").rglob("*.jpg")]) == panoramas.NUM_VIEWS
    assert (new / "map-views/rig_config.json").exists()
