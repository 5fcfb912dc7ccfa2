"""Maps that grow and shrink: the same command goes on after a kill, and other photos stay."""

import json
import multiprocessing
import os
import shutil
import signal
from collections.abc import Callable

import cv2
import h5py
import numpy as np
import pycolmap
import pytest
import rigs
import torch
from command import contents, write

from hloc_reduce import Localizer, maps
from hloc_reduce.mapping.checks import (
    another_size,
    cropped,
    focal_lengths,
    intrinsics,
    mirrored,
    misfits,
)
from hloc_reduce.maps import grow, placing
from hloc_reduce.runtime import provenance
from hloc_reduce.utils import colmap
from hloc_reduce.utils.h5 import list_h5_names
from pipelines import localize

PIPELINE = localize
BASE, NEW = ["db/0.png", "db/1.png", "db/2.png"], "db/3.png"
# where a change is killed
STAGES = (
    "extract_features.main",
    "Map.aggregate",
    "match_features.main",
    "extension.extend",
    "contradictions.judge",
    "_commit_addition",
    "_commit",
    "_drop_left",
)


@pytest.fixture
def grown(place, tmp_path, run, written_once):
    """A map of three photos with poses; a folder with the fourth, and the model of all four."""
    (_, model, _, images, _, outputs), _, _ = place
    part = colmap.write_part(model, BASE, tmp_path / "part")
    build = "--map", part, "--map_images", images, "--outputs", outputs
    written_once(outputs, lambda: run(*build), "grown")
    (tmp_path / "new/db").mkdir(parents=True)
    shutil.copy(images / NEW, tmp_path / "new" / NEW)
    return outputs / "map", tmp_path / "new", model


def names(folder):
    return maps.Map(folder).names()


def poses(folder):
    images = colmap.read_model(maps.Map(folder).sfm).images.values()
    return {image.name: image.cam_from_world().matrix().tolist() for image in images}


def truth_of(model, name):
    return colmap.read_model(model).find_image_with_name(name).cam_from_world()


def find(folder, *found):
    """Have a map doubted."""
    content = provenance.read(folder / "map.json")
    content["findings"] = [one.to_json() for one in found]
    provenance.write(folder / "map.json", content)


def found_in(folder):
    """Return the names of the photos that are doubted, by kind."""
    return {one.kind: [*one.names] for one in maps.Map(folder).findings}


def test_doubts_end_with_the_photos_that_raised_them(grown, tmp_path, run, caplog):
    """Focal lengths are compared again; those of this map are equal."""
    folder, new, model = grown
    found = cropped.finding(BASE[:2]), misfits.finding(BASE[:2])
    find(folder, *found, focal_lengths.finding(1.3))
    assert len(maps.Map(folder).doubts) == 3
    caplog.clear()
    run("--map", folder, "--add_images", new, "--add_model", model)
    assert caplog.text.count("differ by a factor of 1.30") == 1
    assert found_in(folder) == {"cropped": BASE[:2], "misfits": BASE[:2]}
    run("--map", folder, "--remove_images", write(tmp_path / "list.txt", f"{BASE[0]}\n"))
    assert found_in(folder) == {"cropped": [BASE[1]], "misfits": [BASE[1]]}


@pytest.mark.parametrize("gain", [0.0, 0.5])
def test_a_map_whose_intrinsics_may_be_wrong_tells_none(gain, grown, run):
    """Else queries would be localized with the lens of its photos, or of new ones."""
    folder, new, model = grown
    content = provenance.read(folder / "map.json")
    assert content["typical"]
    lens, wrong = content["typical"], [[360, 270, 0.7, 0.0]]
    provenance.write(folder / "map.json", content | {"typical": wrong})
    find(folder, *([intrinsics.finding(intrinsics.Fit(gain, []))] if gain else []))
    run("--map", folder, "--add_images", new, "--add_model", model)
    assert provenance.read(folder / "map.json")["typical"] == ([] if gain else lens)


@pytest.mark.parametrize("check", [mirrored, another_size])
def test_a_photo_that_was_left_out_is_added_and_removed(check, grown, tmp_path, run):
    folder, new, model = grown
    left_out = check.finding(["left.jpg", NEW])
    find(folder, left_out)
    run("--map", folder, "--add_images", new, "--add_model", model)
    assert found_in(folder) == {left_out.kind: ["left.jpg"]} and NEW in names(folder)
    find(folder, left_out)
    run("--map", folder, "--remove_images", write(tmp_path / "list.txt", f"{NEW}\n"))
    assert found_in(folder) == {left_out.kind: ["left.jpg"]}


def test_a_photo_that_is_only_left_out_is_removed(grown, tmp_path, refused, run):
    """It has features, like all photos of the folder, and is in no model."""
    folder, _, _ = grown
    features = maps.Map(folder).features
    with h5py.File(features, "a") as file:
        file.copy(file[BASE[0]], NEW)
    find(folder, another_size.finding([NEW]))
    arguments = "--map", folder, "--remove_images", write(tmp_path / "list.txt", f"{NEW}\n")
    run(*arguments)
    assert found_in(folder) == {}
    assert "has no photo" in refused(*arguments)


@pytest.mark.fault(3)
@pytest.mark.parametrize("lost", ["db/0.png", "db/1.png"])  # of the reference sensor, and not
@pytest.mark.parametrize("is_missing", [True, False])
def test_a_photo_of_a_rig_is_missing_or_removed(is_missing, lost, place, tmp_path, run):
    (_, model, _, images, _, outputs), _, _ = place
    (tmp_path / "rig").mkdir()
    rigs.taken_by_a_rig(colmap.read_model(model)).write(tmp_path / "rig")
    if is_missing:
        shutil.move(images / lost, tmp_path)
    options = "--map_images", images, "--outputs", outputs, "--accept_partial"
    run("--map", tmp_path / "rig", *options)
    if not is_missing:
        run("--map", outputs / "map", "--remove_images", write(tmp_path / "list.txt", lost))
    found = poses(outputs / "map")
    assert {*found} == {*BASE, NEW} - {lost}
    for name, pose in found.items():
        np.testing.assert_allclose(pose, truth_of(model, name).matrix(), atol=1e-9)


def test_a_photo_with_a_pose(grown, place, tmp_path, capsys, run):
    folder, new, model = grown
    built, before, features = maps.Map(folder), poses(folder), contents(maps.Map(folder).features)
    run("--map", folder, "--add_images", new, "--add_model", model)
    assert ": 1. It has 4 now." in capsys.readouterr().out
    after = maps.Map(folder)
    assert after.names() == [*BASE, NEW] and after.num_images == 4
    assert after.num_points3D > built.num_points3D and after.id != built.id
    assert {name: poses(folder)[name] for name in BASE} == before
    given = pycolmap.Reconstruction(model).find_image_with_name(NEW).cam_from_world()
    assert poses(folder)[NEW] == given.matrix().tolist()
    same = contents(after.features)
    assert {key: same[key] for key in features} == features
    assert list_h5_names(after.descriptors) == [*BASE, NEW]
    assert {path.name for path in folder.glob("sfm*")} == {after.sfm.name}
    assert not (folder / placing.GROWING).exists()

    # as well as a map that was built at once
    build, images, _ = place
    run(*build[:-1], tmp_path / "at_once")
    at_once = maps.Map(tmp_path / "at_once/map")
    camera = next(iter(pycolmap.Reconstruction(model).cameras.values()))
    found = [
        Localizer(one.folder).localize(images / "query/day/a.png", camera)[1]["num_inliers"]
        for one in (after, at_once)
    ]
    assert found[0] >= 0.95 * found[1] > 0

    # the same command again changes nothing, and neither does the one that built the map
    run("--map", folder, "--add_images", new, "--add_model", model)
    run("--map", tmp_path / "part", "--map_images", images, "--outputs", folder.parent)
    assert maps.Map(folder).id == after.id

    removed = write(tmp_path / "removed.txt", f"{NEW}\n")
    run("--map", folder, "--remove_images", removed)
    assert names(folder) == BASE and poses(folder) == before
    assert list_h5_names(maps.Map(folder).features) == BASE
    assert contents(maps.Map(folder).features) == features
    run("--map", folder, "--add_images", new, "--add_model", model)
    assert names(folder) == [*BASE, NEW]


def test_photos_that_are_localized(place, build_map, tmp_path, monkeypatch, caplog, run, refused):
    paired, pair = [], placing.pairs_from_retrieval.main

    def logged(descriptors, output, number, query_list, db_list):
        paired.append((output.name, query_list, db_list))
        return pair(descriptors, output, number, query_list=query_list, db_list=db_list)

    _, images, _ = place
    folder = build_map()
    before = poses(folder)
    new = images / "query/day"  # one that the map shows, and a grey one
    cv2.imwrite(str(new / "noise.png"), np.random.default_rng(0).integers(0, 255, (270, 360)))
    (new / "broken.png").write_text("no photo")
    with monkeypatch.context() as context:
        context.setattr(placing.pairs_from_retrieval, "main", logged)
        run("--map", folder, "--add_images", new)
    assert names(folder) == ["a.png", *sorted(before)]
    everything = ["a.png", *sorted(before)]  # as when a map is built: new ones only among these
    assert ("pairs-new1.txt", ["a.png"], everything) in paired
    assert {name: poses(folder)[name] for name in before} == before
    assert "not readable: broken.png" in caplog.text
    assert "not localized in the map: grey.png, noise.png" in caplog.text
    truth = (images.parent / "queries/ground_truth_poses.txt").read_text().split()
    assert poses(folder)["a.png"][2][3] == pytest.approx(float(truth[7]), abs=0.1)
    content = json.loads((folder / "map.json").read_text())
    assert content["images_added"] == ["a.png"]

    state = (folder / "map.json").read_bytes()
    for name in ("a.png", "noise.png"):
        (new / name).unlink()
    message = refused("--map", folder, "--add_images", new)
    assert "No photo was added" in message and "not localized in the map: grey.png" in message
    copied = tmp_path / "copied"
    copied.mkdir()
    shutil.copy(images / BASE[0], copied / "again.png")
    assert "copies of db/0.png: again.png" in refused("--map", folder, "--add_images", copied)
    cv2.imwrite(str(copied / "a.png"), cv2.imread(str(images / BASE[1]))[:, :-1])
    assert "other photos that are called a.png" in refused("--map", folder, "--add_images", copied)
    assert (folder / "map.json").read_bytes() == state and names(folder)[0] == "a.png"


def test_a_pose_in_another_frame_is_refused(grown, tmp_path, refused):
    folder, new, model = grown
    moved = pycolmap.Reconstruction(model)
    rotation = pycolmap.Rotation3d(np.array([0, 0, np.sin(0.2), np.cos(0.2)]))
    moved.transform(pycolmap.Sim3d(1.5, rotation, np.array([0.3, 0, 0])))
    (tmp_path / "moved").mkdir()
    moved.write(tmp_path / "moved")
    message = refused("--map", folder, "--add_images", new, "--add_model", tmp_path / "moved")
    assert "No photo was added" in message and "the map" in message
    assert names(folder) == BASE


@pytest.mark.fault(11)
def test_the_camera_of_a_photo_that_was_made_smaller_is_scaled(grown, run):
    """Its focal length and principal point are those of its pixels, and its pose is the given."""
    folder, new, model = grown
    photo = cv2.imread(str(new / NEW))
    cv2.imwrite(str(new / NEW), cv2.resize(photo, (288, 216), interpolation=cv2.INTER_AREA))
    run("--map", folder, "--add_images", new, "--add_model", model)
    sfm = colmap.read_model(maps.Map(folder).sfm)
    image = sfm.find_image_with_name(NEW)
    camera, before = image.camera, sfm.find_image_with_name(BASE[0]).camera
    assert [camera.width, camera.height, *camera.params] == [288, 216, 300, 144, 108]
    assert [before.width, before.height, before.params[0]] == [360, 270, 375]
    assert np.array_equal(image.cam_from_world().matrix(), truth_of(model, NEW).matrix())
    assert image.num_points3D > 100


@pytest.mark.fault(11)
@pytest.mark.parametrize(("height", "width"), [(268, 360), (270, 300), (200, 360)])
def test_a_photo_that_was_cropped_is_refused(height, width, grown, refused):
    folder, new, model = grown
    photo = cv2.imread(str(new / NEW))
    cv2.imwrite(str(new / NEW), photo[:height, :width])
    message = refused("--map", folder, "--add_images", new, "--add_model", model)
    assert f"of another size than their cameras in the model: {NEW}." in message
    assert names(folder) == BASE


def killed_at(target: object, name: str, change: Callable[[], object]) -> None:
    """Change a map in a forked process that is killed when it calls a function."""

    def kill(*_, **__) -> None:
        os.kill(os.getpid(), signal.SIGKILL)

    def run() -> None:
        setattr(target, name, kill)
        torch.set_num_threads(1)  # a fork hangs if it waits for OpenMP's threads, which it lacks
        change()

    process = multiprocessing.get_context("fork").Process(target=run, daemon=True)
    process.start()
    process.join(120)
    assert process.exitcode == -signal.SIGKILL


@pytest.mark.parametrize("stage", STAGES)
def test_a_killed_change_goes_on(grown, stage):
    folder, new, model = grown
    module, _, name = stage.rpartition(".")
    target = getattr(placing, module) if module else grow
    killed_at(target, name, lambda: maps.add(maps.Map(folder), new, model))
    finished = stage == STAGES[-1]
    assert names(folder) == ([*BASE, NEW] if finished else BASE)  # whole at any moment
    maps.add(maps.Map(folder), new, model)
    assert names(folder) == [*BASE, NEW]
    assert not (folder / placing.GROWING).exists() and len(list(folder.glob("sfm*"))) == 1


def test_copies_in_the_map_keep_their_features(place, tmp_path, run):
    (_, model, _, images, _, outputs), _, _ = place
    folder, photos = outputs / "map", tmp_path / "photos/db"
    shutil.copytree(images / "db", photos)
    shutil.copy(photos / "0.png", photos / "1.png")  # the model has poses of both
    run(
        "--map",
        colmap.write_part(model, BASE, tmp_path / "part"),
        "--map_images",
        photos.parent,
        "--outputs",
        outputs,
    )
    run("--map", folder, "--add_images", photos.parent, "--add_model", model)
    assert names(folder) == [*BASE, NEW]
    assert list_h5_names(maps.Map(folder).features) == [*BASE, NEW]
    assert list_h5_names(maps.Map(folder).descriptors) == [*BASE, NEW]


def test_a_killed_removal_goes_on(grown):
    folder, _, _ = grown
    killed_at(grow, "merge", lambda: maps.remove(maps.Map(folder), BASE[:1]))
    assert names(folder) == BASE[1:]
    maps.remove(maps.Map(folder), BASE[:1])
    assert list_h5_names(maps.Map(folder).features) == BASE[1:]
    assert len(list(folder.glob("sfm*"))) == 1


@pytest.mark.fault(13)
@pytest.mark.parametrize("option", ["--add_images", "--remove_images"])
def test_a_compact_map_cannot_be_changed(option, tmp_path, refused):
    path = tmp_path / "place.hlm"
    message = refused("--map", path, option, tmp_path)
    assert message.startswith(f"--map {path} is a compact map, which cannot be changed: add photos")
    assert message.endswith(f"and pack that again: --map FOLDER --compact {path}")


def test_wrong_options(grown, tmp_path, refused):
    folder, new, model = grown
    assert "is a COLMAP model" in refused("--map", model, "--add_images", new)
    assert "a map that was built before" in refused("--add_images", new)
    assert "--add_images." in refused("--map", folder, "--add_model", model, "--outputs", tmp_path)
    assert "no photo x.png" in refused(
        "--map", folder, "--remove_images", write(tmp_path / "list.txt", "x.png\n")
    )
    listed = write(tmp_path / "all.txt", "\n".join(BASE))
    assert "No point" in refused("--map", folder, "--remove_images", listed)
    empty = tmp_path / "empty"
    empty.mkdir()
    refused("--map", folder, "--add_images", empty)
    refused("--map", folder, "--add_images", tmp_path / "absent")
    other = colmap.write_part(model, BASE, tmp_path / "of_others")
    message = refused("--map", folder, "--add_images", new, "--add_model", other)
    assert "has a pose of no photo" in message
    assert names(folder) == BASE
