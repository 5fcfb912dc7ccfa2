"""A map on disk: built once, kept, moved, stale, broken."""

import fcntl
import json
import os
import shutil

import cv2
import h5py
import pycolmap
import pytest
from command import outcome, state
from conftest import SIZE

from hloc_reduce import Localizer, compact, maps, projections
from hloc_reduce.localization.intrinsics import to_list
from hloc_reduce.training import tracks
from hloc_reduce.training.tracks import parse_maps
from hloc_reduce.utils import cli, colmap, parsers
from hloc_reduce.utils.cli import InputError
from pipelines import localize

PIPELINE = localize


def test_a_map_is_built_once(place, capsys, caplog, run, refused):
    build, images, outputs = place
    run(*build)
    assert "Localize photos in it with --query_images" in capsys.readouterr().out
    before = state(outputs / "map")
    with pytest.raises(InputError, match=f"Did you mean {outputs}/map?"):
        maps.Map(outputs)
    for folder in ("query/day", "query/night"):
        run(*build, "--query_images", images / folder)
    assert state(outputs / "map") == before
    summary, rows = outcome(outputs / "queries-day")
    assert set(rows) == {"a.png", "grey.png"} and summary["intrinsics"] == {"guess": 2}
    # a second run computes nothing, and writes no file anew
    day = state(outputs / "queries-day")
    run(*build, "--query_images", images / "query/day")
    assert state(outputs / "queries-day") == day

    # it may be moved, and used without what it was built from
    moved = outputs.parent / "moved"
    (outputs / "map").rename(moved)
    shutil.move(images / "db", outputs.parent / "db")
    given = ("--map", moved, "--outputs", outputs)
    run(*given, "--query_images", images / "query/day", "--feature", "colmap_sift_sv64")
    assert outcome(outputs / "queries-day")[0]["map"] == str(moved)
    message = refused(*given, "--feature", "sift_sv32")
    assert "is of --feature colmap_sift_sv64." in message
    message = refused(*given, "--storage", "uint8")
    assert "was built with --storage float16." in message
    message = refused(*given, "--matcher", "NN-mutual")
    assert "--matcher NN-mutual is for queries" in message
    message = refused("--map", moved, "--outputs", outputs, "--map_images", images)
    assert "leave out --map_images" in message

    # what was found when it was built is said again; older maps have a field for each kind
    content = json.loads((moved / "map.json").read_text())
    assert content.pop("findings") == [] and "may be cropped" not in caplog.text
    gain = {"gain_of_free_principal_points": 0.2}
    for more, said in (
        ({}, ""),
        ({"doubtful_focal_lengths": 1.36}, "lengths differ by a factor of 1.36"),
        ({"images_fitting_badly": ["db/3.png"]}, "worse than those of the others: db/3.png."),
        (gain, "may be cropped"),
        (gain | {"images_altered": ["db/2.png"]}, "than the others: db/2.png"),
        ({"images_of_uncertain_position": {"db/0.png": 0.07}}, "their distance: db/0.png (7 %)"),
        ({"images_contradicting_others": ["db/1.png"]}, "other photos place db/1.png elsewhere"),
        ({"images_cropped": ["db/1.png"]}, "EXIF data say: db/1.png. They were cropped"),
        ({"images_mirrored": ["x.png"]}, "Mirrored photos do not belong in the map: x.png."),
        ({"images_unlike_others": ["x.png"]}, "do not belong in the map, because their size"),
        ({"images": 9}, "Only 4 of 9 photos are in the map."),
    ):
        caplog.clear()
        (moved / "map.json").write_text(json.dumps(content | more))
        run(*given)
        assert said in caplog.text
        left_out = {"images_mirrored", "images_unlike_others"}
        assert len(maps.Map(moved).doubts) == bool(more.keys() - left_out)
    (moved / "map.json").write_text(json.dumps(content | gain))
    # and of poses in it
    run(*given, "--query_images", images / "query/day")
    assert outcome(outputs / "queries-day")[0]["map_doubts"] == [
        "photos that may be cropped or enlarged"
    ]
    assert "poses in it may be off by a tenth of the distance or more" in caplog.text


def test_what_has_changed_is_noticed(place, build_map, aachen_layout, run, refused):
    build, images, outputs = place
    build_map()
    new = ("--query_images", images / "query/day")
    run(*build, *new)
    before, results = state(outputs / "map"), state(outputs / "queries-day")
    message = refused(*build, "--feature", "sift_sv16")
    assert (
        "differs: feature (descriptor colmap_sift before, sift now, " in message
        and "--overwrite" in message
    )
    photo = images / "db/2.png"
    os.utime(photo, ns=(0, 0))  # copied, say: its content is what counts
    run(*build)
    content = photo.read_bytes()
    cv2.imwrite(str(photo), 255 - cv2.imread(str(photo)))
    assert "differs: images (db/2.png)" in refused(*build)
    photo.unlink()
    assert "1 of 4 images of the map are not in" in refused(*build)
    photo.write_bytes(content)
    model = aachen_layout / "3D-models/aachen_v_1_1"
    reference = pycolmap.Reconstruction(model)
    reference.deregister_frame(reference.find_image_with_name("db/3.png").frame_id)
    reference.write(model)
    message = refused(*build)
    assert "images (db/3.png) and model (" in message and "images.bin" in message
    assert state(outputs / "map") == before

    # rebuilt on purpose: the results of the map before are not kept for it
    run(*build, "--overwrite")
    assert maps.Map(outputs / "map").names() == ["db/0.png", "db/1.png", "db/2.png"]
    run(*build, *new)
    after = state(outputs / "queries-day")
    assert all(after[path] > results[path] for path in results if path.suffix in (".h5", ".csv"))
    assert outcome(outputs / "queries-day")[0]["map_images"] == 3


@pytest.mark.fault(7)
def test_a_map_of_rotations_that_were_not_normalized_is_stale(
    place, aachen_layout, monkeypatch, refused
):
    build, _, outputs = place
    model, folder = aachen_layout / "3D-models/aachen_v_1_1", outputs / "map"
    reference = pycolmap.Reconstruction(model)
    for frame in reference.frames.values():
        pose = frame.rig_from_world
        rotation = pycolmap.Rotation3d(1.002 * pose.rotation.quat)
        frame.rig_from_world = pycolmap.Rigid3d(rotation, pose.translation)
    reference.write(model)

    def stop(*_):
        raise InputError("stopped")

    monkeypatch.setattr(maps.build, "begin", stop)
    assert "stopped" in refused(*build)
    conf = json.loads((folder / "conf.json").read_text())
    del conf["normalized"]  # which an earlier version did not say
    (folder / "conf.json").write_text(json.dumps(conf))
    (folder / maps.map.FINISHED).touch()
    assert "differs: normalized" in refused(*build)


def test_inputs_are_not_deleted(place, build_map, refused):
    build, _, outputs = place
    build_map()
    before = state(outputs / "map")
    arguments = ("--map", outputs / "map/sfm", *build[2:], "--overwrite", "--feature", "sift")
    message = refused(*arguments)
    assert "map/sfm is in" in message and "move it" in message
    assert state(outputs / "map") == before


def test_a_deletion_that_was_cut_short_goes_on(place, build_map, monkeypatch, run):
    """Nothing of the map before gets into the new one."""
    build, images, outputs = place
    build_map()
    old = (outputs / "map/feats-dog-colmap_sift_sv64.h5").read_bytes()
    unlink = type(outputs).unlink

    def killed(path, *arguments, **options):
        if path.name.startswith("feats-"):
            raise KeyboardInterrupt
        unlink(path, *arguments, **options)

    with monkeypatch.context() as context:
        context.setattr(type(outputs), "unlink", killed)
        with pytest.raises(SystemExit):
            run(*build, "--overwrite")
    with pytest.raises(InputError, match="not a finished one"):
        maps.Map(outputs / "map")
    assert (outputs / "map/feats-dog-colmap_sift_sv64.h5").read_bytes() == old
    run(*build)
    assert (outputs / "map/feats-dog-colmap_sift_sv64.h5").read_bytes() != old  # it has another id


FINDING = {"kind": "a", "text": "b", "names": [], "values": {}, "verdict": "warn", "doubt": ""}


def test_a_broken_map_is_refused(place, build_map, tmp_path, refused):
    _, images, outputs = place
    build_map()
    file = outputs / "map/map.json"
    sound = json.loads(file.read_text())
    for key, value in (
        ("feature", "/../../x"),
        ("matcher", "no_such"),
        ("conf", {**sound["conf"], "output": "../x"}),
        ("conf", {"output": "x"}),
        ("conf", {**sound["conf"], "model": {"projection": "../x.safetensors"}}),
        ("points3D", None),
        ("cameras", []),
        ("cameras", {"a": ["PINHOLE", 9, 9]}),
        ("sizes", [[1e999, 1]]),
        ("findings", [{}]),
        ("findings", [{**FINDING, "verdict": "perhaps"}]),
        ("findings", [{**FINDING, "values": {"a": "b"}}]),
        ("findings", [{**FINDING, "names": None}]),
        ("typical", [[480, 360, 1e9, 0]]),
        ("typical", [[480, 360, 10**400, 0]]),
    ):
        file.write_text(json.dumps({**sound, key: value}))
        with pytest.raises(InputError, match=r"no sound map.json|Unknown matcher"):
            maps.Map(outputs / "map")
    file.write_text("[]")
    arguments = ("--map", outputs / "map", "--outputs", tmp_path / "x", "--query_images", images)
    assert "no sound map.json" in refused(*arguments)


def test_a_map_with_a_broken_file_is_refused_before_any_work(
    place, build_map, tmp_path, run, refused
):
    _, images, _ = place
    folder = build_map("--feature", "sift_sv16")
    given = ("--map", folder, "--outputs", tmp_path / "x", "--query_images", images / "query/day")
    stem = "global-feats-vlad_feats-dog-sift_sv16"
    for name in (
        "sfm/cameras.bin",
        "sfm/images.bin",
        "sfm/points3D.bin",
        "feats-dog-sift_sv16.h5",
        f"{stem}.h5",
        f"{stem}.vocabulary.safetensors",
        "sift_sv16.safetensors",
    ):
        file = folder / name
        content = file.read_bytes()
        file.unlink()
        message = refused(*given)
        assert f"The map {folder} is broken: it has no {name}." in message
        assert "--overwrite" in message
        for damaged in (content[: len(content) // 2], b""):
            file.write_bytes(damaged)
            message = refused(*given)
            assert str(file) in message or str(file.parent) in message, name
        assert not (tmp_path / "x").exists()
        file.write_bytes(content)
    for name in ("feats-dog-sift_sv16.h5", f"{stem}.h5"):
        file = folder / name
        content = file.read_bytes()
        with h5py.File(file, "a") as opened:
            del opened["db/1.png"]
        assert f"db/1.png is not in the file {file}." in refused(*given)
        assert not (tmp_path / "x").exists()
        file.write_bytes(content)
    run(*given)


@pytest.mark.fault(4)
def test_a_map_in_use_is_not_broken(place, build_map, refused):
    """Whoever builds it again loses a good map."""
    build, images, outputs = place
    build_map()
    (path,) = outputs.glob("map/feats-*64.h5")
    with path.open("rb") as file:
        fcntl.flock(file, fcntl.LOCK_EX)  # as a program does that writes to it
        opened = "--map", outputs / "map", "--query_images", images / "query/day"
        for given in (build, (*opened, "--outputs", outputs / "new")):
            message = refused(*given)
            assert message.startswith(f"{path} is open for writing in another program: wait")
            assert "overwrite" not in message and "broken" not in message


def test_a_build_that_was_stopped_goes_on(place, run, refused):
    build, images, outputs = place
    photo = images / "db/3.png"
    content = photo.read_bytes()
    photo.write_bytes(b"no image")
    assert "Cannot read image" in refused(*build)
    with pytest.raises(InputError, match="not a finished one"):
        maps.Map(outputs / "map")
    message = refused("--map", outputs / "map", "--outputs", outputs, "--query_images", images)
    assert "not a finished one" in message
    photo.write_bytes(content)
    run(*build)  # nothing was finished: the photo that changed is no matter
    (outputs / "map/map.json").unlink()
    before = state(outputs / "map")
    run(*build)
    again = state(outputs / "map")
    kept = [path for path in before if path.suffix in (".h5", ".bin", ".txt")]
    assert len(kept) > 6 and all(again[path] == before[path] for path in kept)


def test_a_projection_is_kept_with_the_map(place, tmp_path, run):
    """The map works when the file it was made with is gone."""
    build, images, outputs = place
    mine = tmp_path / "mine.safetensors"
    shutil.copy(projections.find("sift_nested"), mine)
    run(*build, "--feature", "sift", "--projection", f"{mine}@24")
    built = maps.Map(outputs / "map")
    assert built.feature == "mine@24"
    built.check_feature("sift", f"{mine}@24")
    shutil.copy(projections.find("mkd_nested"), mine)  # trained again, say
    with pytest.raises(InputError, match="but not of the mine@24 that it is now"):
        built.check_feature("sift", f"{mine}@24")
    mine.unlink()
    pose, info = Localizer(outputs / "map").localize(images / "query/day/a.png")
    assert pose is not None and info["intrinsics"] == "guess"
    folder, other = outputs / "map", tmp_path / "other"
    run("--map", folder, "--query_images", images / "query/day", "--outputs", other)
    assert outcome(other / "queries-day")[0]["bytes_per_keypoint"]["descriptor"] == 48


@pytest.mark.parametrize("exhaustive", [4, 3])
def test_a_model_of_poses_only(place, aachen_layout, monkeypatch, exhaustive, run):
    """Without points nothing is covisible: all images are matched, or if many similar ones."""
    monkeypatch.setattr(maps.pairing, "MAX_EXHAUSTIVE", exhaustive)
    build, images, outputs = place
    model = aachen_layout / "3D-models/aachen_v_1_1"
    reference = pycolmap.Reconstruction(model)
    for point in list(reference.point3D_ids()):
        reference.delete_point3D(point)
    reference.write(model)
    run(*build, "--num_covis", 2)
    name = "exhaustive" if exhaustive == 4 else "2"
    pairs = list(parsers.parse_pairs(outputs / f"map/pairs-db-{name}.txt"))
    assert len(pairs) == (6 if exhaustive == 4 else 8)
    pose, _ = Localizer(outputs / "map").localize(images / "query/day/a.png")
    assert pose is not None


@pytest.mark.fault(5)
@pytest.mark.parametrize("exhaustive", [4, 3])
@pytest.mark.parametrize(
    ("blind", "numbers"),  # of pairs: of all photos, or each with the two most similar ones
    [([0, 1, 2, 3], (6, 8)), ([0], (9, 8)), ([2, 3], (8, 6))],
)
def test_photos_that_see_no_point_of_the_model(
    blind, numbers, exhaustive, place, aachen_layout, monkeypatch, run
):
    """They are paired as without points; those that see some, by these: of a scanner, none do."""
    monkeypatch.setattr(maps.pairing, "MAX_EXHAUSTIVE", exhaustive)
    build, images, outputs = place
    model = aachen_layout / "3D-models/aachen_v_1_1"
    reference = pycolmap.Reconstruction(model)
    points = [point.xyz for point in reference.points3D.values()]
    for image in (reference.find_image_with_name(f"db/{i}.png") for i in blind):
        while rows := image.get_observation_point2D_idxs():
            reference.delete_observation(image.image_id, rows[0])
    for xyz in points:
        reference.add_point3D(xyz, pycolmap.Track())
    reference.write(model)
    run(*build, "--num_covis", 2)
    (listed,) = (outputs / "map").glob("pairs-db-*.txt")
    pairs = list(parsers.parse_pairs(listed))
    assert len(pairs) == numbers[exhaustive == 3]
    assert {name for pair in pairs for name in pair} == {f"db/{i}.png" for i in range(4)}
    sfm = colmap.read_model(outputs / "map/sfm")
    assert min(image.num_points3D for image in sfm.images.values()) > 100


@pytest.mark.fault(11)
def test_photos_that_were_made_smaller(place, aachen_layout, run, refused):
    """Their cameras are scaled if all were; else nothing is extracted, and the odd ones named."""
    build, images, outputs = place
    for number in range(4):
        photo = images / f"db/{number}.png"
        pixels = cv2.imread(str(photo))
        cv2.imwrite(str(photo), cv2.resize(pixels, (288, 216), interpolation=cv2.INTER_AREA))
        if number < 3:
            said = refused(*build)
            odd = "0.png (288x216" if number < 2 else "3.png (360x270"
            assert f"map do not have the size of their cameras in the model: db/{odd}, its" in said
            assert said.endswith(
                "resized in the same way. Give --accept_partial to do without them."
            )
            assert not list(outputs.rglob("*.h5"))
    run(*build)
    (camera,) = colmap.read_model(outputs / "map/sfm").cameras.values()
    assert [camera.width, camera.height, *camera.params] == [288, 216, 300, 144, 108]
    camera.rescale(360, 270)
    pose, _ = Localizer(outputs / "map").localize(images / "query/day/a.png", camera)
    truth = parsers.parse_poses(aachen_layout / "queries/ground_truth_poses.txt")
    error = pose.inverse().translation - truth["query/day/a.png"].inverse().translation
    assert abs(error).max() < 0.01


@pytest.mark.fault(11)
@pytest.mark.parametrize(
    ("ratio", "crop", "usual"), [(1, (2, 2), (360, 270)), (0.8, (0, 0), (288, 216))]
)
def test_a_photo_of_an_odd_size_may_be_left_out(
    ratio, crop, usual, place, run, refused, caplog, monkeypatch
):
    """Photos of one camera, one of which was cropped, or all but one of which were made smaller."""
    monkeypatch.setattr(cli.logger, "propagate", True)
    build, images, outputs = place
    odd = images / "db/1.png"
    for photo in images.glob("db/*.png"):
        if photo != odd:
            pixels = cv2.imread(str(photo))
            resized = cv2.resize(pixels, usual, interpolation=cv2.INTER_AREA)
            cv2.imwrite(str(photo), resized)
    right, lower = crop
    pixels = cv2.imread(str(odd))
    cv2.imwrite(str(odd), pixels[: 270 - lower, : 360 - right])
    assert "1 of 4 images of the map do not have the size" in refused(*build)
    for _ in range(2):  # a finished map is used again
        run(*build, "--accept_partial")
        sfm = colmap.read_model(outputs / "map/sfm")
        names = [image.name for image in sfm.images.values()]
        assert sorted(names) == ["db/0.png", "db/2.png", "db/3.png"]
    (camera,) = sfm.cameras.values()
    assert [camera.width, camera.height, camera.params[0]] == [*usual, 375 * ratio]
    said = "The map is without 1 images, which do not have the size of their cameras in the model: "
    assert caplog.text.count(said + "db/1.png (") == 1


@pytest.mark.fault(2)
def test_a_map_knows_its_fisheyes(place, build_map):
    """In map.json; that of an earlier version does not have them, but the model does."""
    _, _, outputs = place
    folder = build_map()
    assert maps.Map(folder).cameras.sizes == {SIZE} and not maps.Map(folder).cameras.lenses
    written = json.loads((folder / "map.json").read_text())
    fisheye = ["SIMPLE_RADIAL_FISHEYE", *SIZE, 130.0, SIZE[0] / 2, SIZE[1] / 2, 0.0]
    (folder / "map.json").write_text(json.dumps({**written, "lenses": [fisheye], "sizes": []}))
    assert [to_list(one) for one in maps.Map(folder).cameras.lenses[SIZE]] == [fisheye]
    model = pycolmap.Reconstruction(folder / "sfm")
    for camera in model.cameras.values():
        camera.model = pycolmap.CameraModelId.SIMPLE_RADIAL_FISHEYE
        camera.params = fisheye[3:]
    model.write(folder / "sfm")
    del written["lenses"]
    (folder / "map.json").write_text(json.dumps(written))
    cameras = Localizer(folder).cameras
    assert [to_list(one) for one in cameras.lenses[SIZE]] == [fisheye] and not cameras.sizes
    compact.main(outputs / "place.hlm", folder)
    cameras = Localizer(outputs / "place.hlm").cameras
    assert [to_list(one) for one in cameras.lenses[SIZE]] == [fisheye] and not cameras.sizes


def test_a_map_to_train_on(place, run):
    build, images, outputs = place
    run(*build)
    folders = images, outputs / "map/sfm"
    assert parse_maps([str(outputs / "map")]) == {"outputs": folders}
    assert parse_maps([f"{images}:{outputs / 'map/sfm'}"]) == {"dataset": folders}
    cache = outputs / "cache"
    tracks.main(*folders, cache)
    run(*build, "--overwrite")
    with pytest.raises(InputError, match="tracks of another map"):
        tracks.main(*folders, cache)
    with pytest.raises(InputError, match="neither a map nor"):
        parse_maps([str(outputs)])
