"""Photos localized one at a time in memory, as by files."""

import shutil
import sys

import cv2
import h5py
import numpy as np
import pycolmap
import pytest
import torch
from command import outcome

from hloc_reduce import Localizer, compact, maps, projections
from hloc_reduce.evaluation.poses import pose_error
from hloc_reduce.localization import query
from hloc_reduce.localization.records import read_records
from hloc_reduce.maps import contents, torch_engine
from hloc_reduce.matchers.nearest_neighbor import NearestNeighbor
from hloc_reduce.utils import cli, parsers
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.h5 import list_h5_names
from hloc_reduce.utils.images import UnreadableImage
from pipelines import aachen, localize

PIPELINE = localize


def test_the_same_as_the_pipeline_of_aachen(
    place, aachen_layout, tmp_path, monkeypatch, capsys, run
):
    """And the same one photo at a time."""
    build, images, outputs = place
    queries = aachen_layout / "queries/*_time_queries_with_intrinsics.txt"
    truth = aachen_layout / "queries/ground_truth_poses.txt"
    new = ("--queries", queries, "--query_images", images, "--ground_truth", truth)
    run(*build, *new, "--feature", "sift_sv24")
    summary, rows = outcome(outputs / "queries-time_queries_with_intrinsics")
    assert summary["intrinsics"] == {"list": 3} and summary["feature"] == "sift_sv24"
    assert "100.0 / 100.0 / 100.0" in capsys.readouterr().out

    place = ("--dataset", aachen_layout, "--outputs", tmp_path / "aachen")
    monkeypatch.setattr(sys, "argv", ["aachen", *map(str, place), "--feature", "sift_sv24"])
    cli.run(aachen._main)
    expected = outcome(tmp_path / "aachen")[1]
    assert rows == expected and rows["query/day/a.png"]["status"] == "localized"

    localizer = Localizer(outputs / "map")
    poses = parsers.parse_poses(outputs / "queries-time_queries_with_intrinsics" / summary["poses"])
    for name, camera in [q for part in parsers.parse_query_lists(queries).values() for q in part]:
        pose, info = localizer.localize(images / name, camera)
        row = rows[name]
        for key in ("num_matches", "num_correspondences", "num_inliers"):
            assert info[key] == int(row[key])
        assert info["confidence"] == float(row["confidence"])
        assert (info["reason"] or "") == row["reason"]
        assert info["retrieved"][0] == row["retrieved"] and info["intrinsics"] == "given"
        if row["status"] == "localized":
            assert max(pose_error(pose, poses[name])) < 1e-9
            assert len(info["points2D"]) == len(info["points3D"]) == info["num_correspondences"]
            assert info["inliers"].sum() == info["num_inliers"]
            projected = camera.img_from_cam(
                info["points3D"] @ pose.rotation.matrix().T + pose.translation
            )
            errors = np.linalg.norm(projected - info["points2D"], axis=1)
            assert errors[info["inliers"]].max() < 12
        else:
            assert pose is None and info["num_inliers"] == 0


def test_queries_called_as_map_photos(place, tmp_path, run):
    """They are other photos: every pair is matched, also one that looks like another's reverse.

    Here as codes, in files and in memory.
    """
    build, images, outputs = place
    new = tmp_path / "new/db"
    new.mkdir(parents=True)
    for name in ("0.png", "1.png", "3.png"):
        shutil.copy(images / "query/day/a.png", new / name)
    run(*build, "--query_images", new.parent, "--storage", "uint8")
    summary, rows = outcome(outputs / "queries-new")
    assert set(rows) == {"db/0.png", "db/1.png", "db/3.png"}
    assert len({tuple(row.values())[2:] for row in rows.values()}) == 1
    localizer = Localizer(outputs / "map")
    if not torch.cuda.is_available():
        features = {"descriptors": np.zeros((64, 3), np.float32)}
        matching = localizer.engine.matching({"name": "nearest_neighbor"})
        assert matching.prepare(features).dtype == np.int16
    pose, info = localizer.localize(new / "1.png")
    assert (
        info["num_matches"] == int(rows["db/1.png"]["num_matches"]) and len(info["retrieved"]) == 4
    )
    poses = parsers.parse_poses(outputs / "queries-new" / summary["poses"])
    assert max(pose_error(pose, poses["db/1.png"])) < 1e-9


def with_exif(photo, path, focal_35mm):
    """Write a JPEG whose EXIF data give the focal length in 35 mm film."""
    ifd = b"\x01\x00" + b"\x05\xa4\x03\x00\x01\x00\x00\x00" + focal_35mm.to_bytes(4, "little")
    root = b"\x01\x00" + b"\x69\x87\x04\x00\x01\x00\x00\x00" + (26).to_bytes(4, "little")
    tiff = b"II*\x00\x08\x00\x00\x00" + root + b"\x00" * 4 + ifd + b"\x00" * 4
    segment = b"Exif\x00\x00" + tiff
    _, jpeg = cv2.imencode(".jpg", photo, [cv2.IMWRITE_JPEG_QUALITY, 100])
    length = (len(segment) + 2).to_bytes(2, "big")
    path.write_bytes(b"\xff\xd8\xff\xe1" + length + segment + jpeg.tobytes()[2:])


def test_intrinsics_of_exif_or_guessed(place, build_map, aachen_layout, tmp_path, caplog, run):
    """The camera has 375 pixels; 36 mm say 374 (of the diagonal), a guess is 432."""
    build, images, outputs = place
    photos = tmp_path / "photos"
    photos.mkdir()
    photo = cv2.imread(str(images / "query/day/a.png"))
    with_exif(photo, photos / "exif.jpg", 36)
    cv2.imwrite(str(photos / "guess.png"), photo)
    truth = parsers.parse_poses(aachen_layout / "queries/ground_truth_poses.txt")["query/day/a.png"]
    build_map()
    caplog.set_level("INFO")
    run(*build, "--query_images", photos)
    assert "1 queries are from EXIF data" in caplog.text and "1 queries are guessed" in caplog.text
    summary, rows = outcome(outputs / "queries-photos")
    assert summary["intrinsics"] == {"EXIF": 1, "guess": 1}
    listed = outputs / "queries-photos/queries_with_intrinsics.txt"
    cameras = dict(parsers.parse_query_list(listed))
    assert abs(cameras["exif.jpg"].params[0] - 374) < 1 and cameras["guess.png"].params[0] == 432
    poses = parsers.parse_poses(outputs / "queries-photos" / summary["poses"])
    localizer = Localizer(outputs / "map")
    for name in ("exif.jpg", "guess.png"):
        assert rows[name]["status"] == "localized"
        metres, degrees = pose_error(poses[name], truth)
        assert metres < 0.1 and degrees < 1, name  # 2.2 m away
        pose, info = localizer.localize(photos / name)
        assert max(pose_error(pose, poses[name])) < 1e-9
        assert abs(info["camera"].params[0] - 375) < 19
    # pixels are localized as files are, but have no EXIF data
    pixels = cv2.imread(str(photos / "guess.png"))[:, :, ::-1]
    pose, info = localizer.localize(np.ascontiguousarray(pixels))
    assert info["intrinsics"] == "guess" and max(pose_error(pose, poses["guess.png"])) < 0.1
    with pytest.raises(InputError, match="has 240x180 pixels, the photo has 360x270"):
        localizer.localize(
            photos / "guess.png",
            pycolmap.Camera(model="SIMPLE_PINHOLE", width=240, height=180, params=[250, 120, 90]),
        )
    small = tmp_path / "small.txt"
    small.write_text("guess.png SIMPLE_PINHOLE 240 180 250 120 90\n")
    run(*build, "--query_images", photos, "--queries", small)
    reason = "the intrinsics are for 240x180 pixels, the photo has 360x270"
    assert f"Not localized: guess.png ({reason})." in caplog.text
    for wrong in (pixels.astype(float), pixels[None], np.zeros((0, 3), np.uint8)):
        with pytest.raises(InputError, match="uint8"):
            localizer.localize(wrong)
    content = (photos / "guess.png").read_bytes()
    for name, left in (("cut.png", content[:2000]), ("text.png", b"text"), ("empty.png", b"")):
        (photos / name).write_bytes(left)
    for name in ("cut.png", "text.png", "empty.png", "absent.png"):
        with pytest.raises(UnreadableImage, match=f"Cannot read image .*{name}"):
            localizer.localize(photos / name)


def test_large_photos_have_larger_limits_in_files_and_in_memory(
    place, build_map, tmp_path, monkeypatch, run
):
    build, images, outputs = place
    build_map()
    small = cv2.imread(str(images / "query/day/a.png"))
    (tmp_path / "new").mkdir()
    large = tmp_path / "new/large.png"
    cv2.imwrite(str(large), cv2.resize(small, None, fx=6, fy=6))
    run(*build, "--query_images", large.parent)
    (log,) = (outputs / "queries-new").glob("*_logs.jsonl")
    expected = 12 * 6 * small.shape[1] / 1600
    assert read_records(log)["large.png"]["max_error"] == pytest.approx(expected)

    used, estimate = [], query.localize

    def spy(*given, config, **options):
        used.append(config["estimation"]["ransac"]["max_error"])
        return estimate(*given, config=config, **options)

    monkeypatch.setattr(query, "localize", spy)
    _, info = Localizer(outputs / "map").localize(large)
    assert used == [pytest.approx(expected)]
    assert info["num_inliers"] == read_records(log)["large.png"]["num_inliers"] > 8


@pytest.mark.parametrize("by_model", [True, False])
def test_names_with_spaces(by_model, plane, tmp_path, run):
    """Of photos and of folders; hloc's lists cannot hold them, ours have tabs."""
    images, new, outputs = tmp_path / "my photos", tmp_path / "new ones", tmp_path / "my outputs"
    for folder in (images / "a b", new):
        folder.mkdir(parents=True)
    model = pycolmap.Reconstruction(plane / "model")
    for image in model.images.values():
        image.name = f"a b/my {image.name}"
        shutil.copy(plane / "images" / image.name[-5:], images / image.name)
    shutil.move(images / "a b/my 4.png", new / "I am 4.png")
    query = model.find_image_with_name("a b/my 4.png")
    true = query.cam_from_world()
    model.deregister_frame(query.frame_id)
    (tmp_path / "my model").mkdir()
    model.write(tmp_path / "my model")
    given = ("--map_images", images, "--query_images", new, "--outputs", outputs)
    given += ("--feature", "sift_sv16")
    of_photos_alone = ("--camera_mode", "single")
    run(*given, *(("--map", tmp_path / "my model") if by_model else of_photos_alone))
    summary, rows = outcome(outputs / "queries-new_ones")
    row = rows["I am 4.png"]
    assert row["status"] == "localized" and row["retrieved"].startswith("a b/my ")
    assert maps.Map(outputs / "map").names() == [f"a b/my {i}.png" for i in range(4)]
    poses = parsers.parse_poses(outputs / "queries-new_ones" / summary["poses"])
    assert list(poses) == ["I am 4.png"]
    pose, info = Localizer(outputs / "map").localize(new / "I am 4.png")
    assert max(pose_error(pose, poses["I am 4.png"])) < 1e-9
    assert info["retrieved"][0] == row["retrieved"]
    if by_model:  # and with a list, of the right intrinsics
        assert pose_error(pose, true)[0] < 0.2
        camera = "SIMPLE_PINHOLE 360 270 375 180 135"
        (tmp_path / "my list.txt").write_text(f"I am 4.png\t{camera}\n")
        run(*given[2:], "--map", outputs / "map", "--queries", tmp_path / "my list.txt")
        summary, rows = outcome(outputs / "queries-my_list")
        poses = parsers.parse_poses(outputs / "queries-my_list" / summary["poses"])
        assert pose_error(poses["I am 4.png"], true)[0] < 0.02


@pytest.mark.parametrize("takes_codes", [True, False])
def test_only_matchers_that_take_codes_get_them(takes_codes, place, build_map, monkeypatch):
    """The others get unit descriptors, as in `match_features`."""
    _, images, outputs = place
    build_map("--feature", "colmap_sift_sv32", "--storage", "uint2")
    compact.main(outputs / "place.hlm", outputs / "map")
    monkeypatch.setattr(NearestNeighbor, "takes_codes", takes_codes)
    for module in (contents, torch_engine):
        monkeypatch.setattr(module, "is_integer_matcher", lambda _: False)
    longest, match_rows = [], NearestNeighbor.match_rows

    def measured(matcher, query, image, rows):
        longest.append(image["descriptors"].norm(dim=0).max())
        return match_rows(matcher, query, image, rows)

    monkeypatch.setattr(NearestNeighbor, "match_rows", measured)
    for path in (outputs / "map", outputs / "place.hlm"):
        longest.clear()
        pose, _ = Localizer(path).localize(images / "query/day/a.png")
        assert pose is not None
        assert (max(longest) > 1.01) == takes_codes


def test_codes_with_foreign_levels_are_refused(place, build_map):
    _, _, outputs = place
    build_map("--feature", "colmap_sift_sv32", "--storage", "uint2")
    features = next((outputs / "map").glob("feats-*.h5"))
    other = projections.levels("sift_sv32", "uint2")
    for names, said in ((slice(-1, None), "^The codes"), (slice(None), "is broken: The codes")):
        with h5py.File(features, "r+") as file:
            for name in list_h5_names(features)[names]:
                file[f"{name}/descriptors_uint2"].attrs["levels"] = other
        with pytest.raises(InputError, match=f"{said} of db/.* other levels than"):
            Localizer(outputs / "map")


def test_numbers_that_are_too_small(tmp_path):
    with pytest.raises(InputError, match="num_loc is 0: at least 1"):
        Localizer(tmp_path, num_loc=0)
    for wrong in (0.0, float("nan")):
        with pytest.raises(InputError, match="ransac_thresh is .*: it must be above 0"):
            Localizer(tmp_path, ransac_thresh=wrong)


@pytest.mark.parametrize("is_compact", [False, True])
def test_a_masked_photo(is_compact, place, build_map, tmp_path):
    """By an array or a file: what is black has no keypoint; a wrong mask is refused in a line."""
    _, images, outputs = place
    folder = build_map()
    if is_compact:
        compact.main(tmp_path / "map.hlm", folder)
    localizer = Localizer(tmp_path / "map.hlm" if is_compact else folder)
    photo = images / "query/day/a.png"
    pose, every = localizer.localize(photo)
    mask = np.ones((270, 360), np.uint8)
    mask[135:] = 0
    masked, info = localizer.localize(photo, mask=mask)
    assert info["reason"] is None and max(pose_error(masked, pose)) < 0.2
    assert 0 < info["num_correspondences"] < every["num_correspondences"]
    assert info["points2D"][:, 1].max() <= 135 < every["points2D"][:, 1].max()
    cv2.imwrite(str(tmp_path / "mask.png"), 255 * mask)
    for other in (mask > 0, np.dstack([mask] * 3), tmp_path / "mask.png"):
        assert localizer.localize(photo, mask=other)[0].translation == pytest.approx(
            masked.translation, abs=0
        )
    with pytest.raises(InputError, match="The mask has 360x135 pixels, the photo has 360x270"):
        localizer.localize(photo, mask=mask[:135])
    with pytest.raises(InputError, match="The mask is all black"):
        localizer.localize(photo, mask=mask * 0)
    with pytest.raises(InputError, match=r"Cannot read the mask .*gone.png: No such file"):
        localizer.localize(photo, mask=tmp_path / "gone.png")
    with pytest.raises(InputError, match="An image is a file or an array, not int: 3"):
        localizer.localize(photo, mask=3)
