"""Rows that benchmarks write, and the documentation that is made from them."""

import copy
import csv
import itertools
import json
import re
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pycolmap
import pytest
import row_of_photos
import yaml

from benchmarks import (
    accuracy,
    accuracy_tables,
    adding,
    against_hloc,
    changed_photos,
    fit_gate,
    metres,
    photos_alone,
    ransacs,
    render,
    rows,
    selections,
    split_place,
    trial_rows,
    triangulation_scale,
    video,
)
from benchmarks import trials as benchmark_trials
from hloc_reduce.confs import features as features_confs
from hloc_reduce.datasets import true_poses
from hloc_reduce.datasets.aachen import Aachen
from hloc_reduce.demo import town
from hloc_reduce.evaluation.poses import pose_error
from hloc_reduce.localization import absolute_pose, gate
from hloc_reduce.utils import colmap, images, videos
from hloc_reduce.utils.cli import InputError
from pipelines.batch import jobs
from pipelines.batch.jobs import Job

ROOT = Path(__file__).parents[1]


@pytest.fixture
def results(tmp_path, monkeypatch):
    monkeypatch.setattr(rows, "RESULTS", tmp_path / "results")
    return tmp_path / "results"


def row(feature, **cells):
    return {"place": "mill", "feature": feature, "inliers": 3} | cells


def test_a_row_replaces_one_of_the_same(results):
    rows.add("accuracy", [row("sift"), row("mkd")])
    rows.add("accuracy", [row("sift", inliers=4.0, recall=None), row("sift", storage="uint8")])
    found = rows.read("accuracy")
    assert [(each["feature"], each["storage"], each["inliers"]) for each in found] == [
        ("mkd", "", "3"),
        ("sift", "", "4"),
        ("sift", "uint8", "3"),
    ]
    assert rows.select(found, feature="sift", storage="uint8") == found[2:]
    assert found[0]["recall"] == ""
    assert not rows.read("maps")


def moved(model, similarity):
    """Return a copy of a model that is moved by a similarity."""
    copied = pycolmap.Reconstruction(model)
    copied.transform(similarity)
    return copied


def test_models_are_aligned_in_spite_of_a_wrong_pose():
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 1, 1, 12
    options.num_points3D = 20
    reference = pycolmap.synthesize_dataset(options)
    turn = pycolmap.Rotation3d(np.array([0.1, 0.2, 0.3]))
    similarity = pycolmap.Sim3d(0.5, turn, np.array([1.0, 2, 3]))
    model = moved(reference, similarity)
    wrong = min(model.images.values(), key=lambda image: image.name)
    wrong.frame.set_cam_from_world(wrong.camera_id, pycolmap.Rigid3d())
    scale, rotation, shift = photos_alone.align(model, reference)
    back = similarity.inverse()
    assert scale == pytest.approx(back.scale, rel=1e-2)
    np.testing.assert_allclose(rotation, back.rotation.matrix(), atol=1e-2)
    distances, angles = photos_alone.pose_errors(model, reference)
    assert (distances[1:] < 1).all() and (angles[1:] < 1).all() and angles[0] > 1
    few = pycolmap.Reconstruction(reference)
    for image in sorted(few.images.values(), key=lambda image: image.name)[2:]:
        few.deregister_frame(image.frame_id)
    with pytest.raises(InputError, match="share 2 images"):
        photos_alone.align(few, reference)


def test_photos_are_added_to_a_map_of_the_others(tmp_path, monkeypatch):
    reference, _ = row_of_photos.row({})
    known = colmap.write_model(reference, tmp_path / "reference")
    names = sorted(image.name for image in reference.images.values())

    def built(folder, photos, **_):
        if folder.name == adding.ALONE:
            raise InputError("They do not overlap.")
        colmap.write_part(known, [path.name for path in photos.iterdir()], folder)
        return SimpleNamespace(sfm=folder)

    def added(folder, photos):
        inside = {image.name for image in colmap.read_model(folder).images.values()}
        new = {path.name for path in photos.iterdir()}
        assert not inside & new and inside | new == {*names}
        return SimpleNamespace(sfm=known)

    monkeypatch.setattr(adding, "NEW", 2)
    monkeypatch.setattr(adding, "Map", lambda folder: folder)
    monkeypatch.setattr(adding, "maps", SimpleNamespace(main=built, add=added))
    found = [*adding.compared(tmp_path, names, reference, tmp_path / "maps", "sift")]
    counted = {row["variant"]: (row["photos"], row["registered"]) for row in found}
    assert counted == {"at once": (6, 6), "others": (4, 4), "alone": (2, 0), "added": (6, 6)}
    assert found[-1]["median_percent"] == pytest.approx(0, abs=1e-6)


@pytest.fixture
def query():
    """60 matches of a photo of points in a row of photos, the first 20 of which are wrong."""
    model, _ = row_of_photos.row({})
    camera, pose = copy.deepcopy(model.cameras[1]), model.images[1].cam_from_world()
    points2D = camera.img_from_cam(pose * row_of_photos.POINTS)
    points2D[:20] = np.random.default_rng(1).uniform((0, 0), (640, 480), (20, 2))
    images = [np.arange(60)[::-1], np.arange(40, 60)]
    return ransacs.Query(points2D, row_of_photos.POINTS, images, camera, pose)


@pytest.mark.parametrize("estimate", ransacs.estimators().values(), ids=ransacs.estimators())
def test_all_ransacs_find_the_pose_of_a_query(estimate, query):
    found = ransacs.measured([query], estimate)
    assert (found["matches"], found["queries"], found["within_1cm"]) == (60, 1, 1)
    assert 40 <= found["inliers"] < 50
    assert 60 <= query.right < 80


def test_matches_of_queries_are_kept(query, tmp_path):
    ransacs.save(tmp_path / "matches.npz", [query, query])
    (_, read) = ransacs.load(tmp_path / "matches.npz")
    np.testing.assert_array_equal(read.points2D, query.points2D)
    np.testing.assert_array_equal(read.points3D, query.points3D)
    assert [chosen.tolist() for chosen in read.images] == [one.tolist() for one in query.images]
    assert read.camera.model == query.camera.model
    np.testing.assert_array_equal(read.camera.params, query.camera.params)
    assert pose_error(read.cam_from_world, query.cam_from_world) == pytest.approx((0, 0), abs=1e-9)


def test_landmarks_of_synthetic_maps_are_triangulated(tmp_path):
    triangulation_scale.synthesize([f"{i}.jpg" for i in range(15)], tmp_path)
    found = triangulation_scale.triangulate(tmp_path)
    assert found["pairs"] == 15 * 14 / 2
    landmarks = 1200 + 10 * 48  # that at least three images show
    assert 0.98 * landmarks < found["points"] < 1.02 * landmarks
    assert found["near"] > 50  # most images that show one are within two metres


def test_errors_in_metres():
    """Of a map that is a hundredth too large and turned by two degrees."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 1, 1, 12
    reference = pycolmap.synthesize_dataset(options)
    poses = {image.name: image.cam_from_world() for image in reference.images.values()}
    turn = pycolmap.Rotation3d(np.deg2rad([0, 0, 2.0]))
    model = moved(reference, pycolmap.Sim3d(10.1, turn, np.array([1.0, 2, 3])))
    distances, scale, angle = metres.errors(model, poses, factor=10)
    np.testing.assert_allclose(distances, 1, atol=1e-6)
    assert (scale, angle) == pytest.approx((1, 2), abs=1e-6)


def test_the_walk_of_a_video_is_steady_and_closed():
    """And the camera keeps away from obstacles."""
    poses = [pose.inverse() for pose in video.walk(400)]
    positions = np.array([pose.translation for pose in poses])
    turns = [(a.inverse() * b).rotation.angle() for a, b in itertools.pairwise(poses)]
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    assert steps.max() < 0.3 and max(turns) < np.radians(6)
    assert np.linalg.norm(positions[-1, :2] - video.ROUTE[1][:2]) < 1e-6
    for x, y, radius in town.OBSTACLES:
        assert np.linalg.norm(positions[:, :2] - (x, y), axis=1).min() > radius + 0.1


def test_frames_of_a_sequence_are_named_by_time(tmp_path):
    frames = tmp_path / "place/frames"
    frames.mkdir(parents=True)
    np.savetxt(tmp_path / "place/camera-intrinsics.txt", np.diag([500, 500, 1]))
    for number in (0, 15):
        cv2.imwrite(str(frames / f"frame-{number:06}.color.jpg"), np.zeros((48, 64, 3), np.uint8))
        pose = np.eye(4)
        pose[0, 3] = number
        np.savetxt(frames / f"frame-{number:06}.pose.txt", pose)
    model = video.sequence(tmp_path / "place", 0, tmp_path / "photos")
    centres = {image.name: image.projection_center()[0] for image in model.images.values()}
    assert centres == {"0000.000.jpg": 0, "0000.500.jpg": 15}
    assert sorted(path.name for path in (tmp_path / "photos").iterdir()) == sorted(centres)
    encoded = video.encode(tmp_path / "photos", tmp_path / "video.mp4")
    assert [round(frame.seconds, 3) for frame in videos.read(encoded)] == [0, 0.1]


def test_a_table_without_rows_is_an_error():
    with pytest.raises(InputError, match="no rows for the table of images, search"):
        render.markdown([["images", "search"]])


def test_a_row_says_who_measured_it():
    how = rows.how(2.5, cores=2)
    assert how["seconds"] == 2.5 and how["machine"].endswith(", 2 cores")
    assert how["commit"] and how["command"].startswith("python -m ")


@pytest.mark.parametrize("map_every, gain", [(None, (0.1, 0.2)), (4, None)])
def test_a_place_is_split_into_a_map_and_queries(tmp_path, map_every, gain):
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 1, 1, 12
    options.num_points3D, options.camera_width, options.camera_height = 20, 64, 48
    model = pycolmap.synthesize_dataset(options)
    images, sparse, output = (tmp_path / name for name in ("images", "sparse", "place"))
    sparse.mkdir()
    model.write(sparse)
    for image in model.images.values():
        path = images / image.name
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), np.full((48, 64, 3), 200, np.uint8))

    split_place.main(images, sparse, output, gain, map_every)

    place = Aachen(output)
    [(listed, queries)] = place.query_lists().items()
    names = sorted(image.name for image in model.images.values())
    kept = names[2::4] if map_every else [name for i, name in enumerate(names) if i % 3 != 1]
    assert sorted(place.map_names()) == [f"db/{name}" for name in kept]
    assert len(queries) == len(names) - len(kept)
    assert listed.startswith("night" if gain else "day")
    truth = true_poses([name for name, _ in queries], place.ground_truth, True)
    for name, camera in queries:
        assert (camera.width, camera.height) == (64, 48)
        pixels = cv2.imread(str(place.images / name))
        assert pixels.mean() < 50 if gain else (pixels == 200).all()
        [known] = [one for one in model.images.values() if Path(one.name).stem == Path(name).stem]
        assert pose_error(truth[name], known.cam_from_world()) == pytest.approx((0, 0), abs=1e-6)


def test_localized_queries_count_by_their_errors():
    errors = [(0.004, 0.1), (0.03, 0.1), (0.001, 2.5), (float("inf"), float("inf"))]
    found = rows.localization(errors, [10, 20, 30, 0], localized=3)
    assert (found["queries"], found["localized"], found["inliers"]) == (4, 3, 15)
    # the third one is turned too far
    assert [found[f"within_{limit}cm"] for limit in rows.CENTIMETRES] == [1, 1, 2, 2]
    assert found["median_cm"] == pytest.approx(0.4) and found["largest_cm"] == pytest.approx(3)
    nothing = rows.localization([(float("inf"),) * 2], [0], localized=0)
    assert nothing["median_cm"] is nothing["largest_cm"] is None


def test_rows_of_a_finished_run(tmp_path, results):
    summary = {
        "bytes_per_keypoint": {"descriptor": 8, "keypoints": 6000, "images": 6},
        "map_images": 3,
        "map_points3D": 3871,
        "map_bytes": 2_500_000,
        "seconds": {"extract_features": 3.0, "match_map": 1.0, "localization": 0.5},
        "lists": {"night_time": {"localized": 1, "queries": 2}},
    }
    (tmp_path / "summary.json").write_text(json.dumps(summary))
    with (tmp_path / "queries.csv").open("w", newline="") as file:
        header = "query,list,status,position_error_m,rotation_error_deg,num_inliers"
        writer = csv.DictWriter(file, header.split(","))
        writer.writeheader()
        for line in (
            "a.jpg,night_time,localized,0.004,0.1,51",
            "b.jpg,night_time,fallback,0.001,0.1,3",
            "c.jpg,day_time,failed,,,0",
        ):
            writer.writerow(dict(zip(header.split(","), line.split(","), strict=True)))
    job = Job(
        dataset=Path("datasets/mill"),
        feature="colmap_sift_sv32",
        matcher="NN-ratio",
        storage="uint2",
        num_loc=20,
    )
    rows.add("accuracy", [accuracy.what(job) | cells for cells in accuracy.measured(tmp_path)])
    (found,) = rows.read("accuracy")
    expected = {"place": "mill", "list": "night", "storage": "uint2", "variant": "num_loc20"}
    expected |= {"queries": "2", "within_1cm": "1", "inliers": "27", "keypoints": "1000"}
    expected |= {"points": "3871", "mb": "2.5", "seconds": "1.5", "bytes": "8"}
    assert expected.items() <= found.items()
    assert rows.select(rows.read("accuracy"), **accuracy.what(job))


def test_pages_show_what_the_rows_say(monkeypatch):
    monkeypatch.chdir(ROOT)
    for page in render.PAGES:
        text = Path(page).read_text()
        assert render.rendered(text) == text, f"{page}: run python -m benchmarks.render"


@pytest.mark.skipif(
    find_spec("matplotlib") is None
    or f"matplotlib=={version('matplotlib')}\n" not in (ROOT / "constraints.txt").read_text(),
    reason="figures are drawn by the matplotlib of constraints.txt",
)
@pytest.mark.parametrize("name", render.FIGURES)
def test_figures_show_what_the_rows_say(name, monkeypatch):
    monkeypatch.chdir(ROOT)
    number = re.compile(r"-?\d+\.\d+")
    # names of clip paths and markers depend on the last digits of numbers, and so on the processor
    named = re.compile(r"\b[mp][0-9a-f]{10}\b")
    committed, drawn = (named.sub("", svg) for svg in (Path(name).read_text(), render.figure(name)))
    assert number.sub("", committed) == number.sub("", drawn), "run python -m benchmarks.render"
    values = [np.array(number.findall(text), float) for text in (committed, drawn)]
    np.testing.assert_allclose(*values, atol=0.01, err_msg="run python -m benchmarks.render")


def test_without_hloc_the_comparison_says_what_to_install(monkeypatch):
    monkeypatch.setattr("hloc_reduce.utils.hloc.is_installed", lambda: False)
    with pytest.raises(InputError, match="hloc is not installed: pip install"):
        against_hloc.stages_of(against_hloc.Run("hloc"), [])


def test_features_of_sift_run_with_each_setting_of_the_keypoints():
    listed = against_hloc.runs(["sift_sv64", "mini32:uint2"], ["hloc", "fast"])
    assert [list(run.cells().values()) for run in listed] == [
        ["hloc", "float16", ""],
        ["sift_sv64", "float16", "hloc keypoints"],
        ["sift_sv64", "float16", "fast keypoints"],
        ["mini32", "uint2", ""],
    ]
    assert listed[2].conf()["model"]["base"]["keypoints"] == "fast"


def test_jobs_without_rows_are_written_as_they_were_read(tmp_path):
    read = jobs.read(Path(__file__).parents[1] / "results/accuracy.yaml")[1]
    path = tmp_path / "missing.yaml"
    path.write_text(yaml.safe_dump({"jobs": [accuracy._options(job) for job in read]}))
    assert jobs.read(path)[1] == read


@pytest.fixture(scope="module")
def trials():
    found = trial_rows.read(sorted(trial_rows.TRIALS.glob("*.csv")))
    assert len(found) > 1000
    return found


@pytest.mark.parametrize("kind", gate.MATCH_KINDS)
def test_the_weights_of_the_gate_are_those_of_the_trials(trials, kind):
    poses = [row for row in trials if row["matcher"] == kind and "measures" in row]
    weights, bias, *_ = gate.MATCH_KINDS[kind]
    assert fit_gate.fit_rows(poses).round(2) == pytest.approx([*weights, bias], abs=0.02)


def test_how_often_the_gate_errs_in_the_trials(trials):
    """Those of the seeds of results/trials; as many errors as today, at most."""

    def share(rows):
        return sum(row["accepted"] for row in rows) / len(rows)

    own = [row for row in trials if row["kind"] in accuracy_tables.OWN and row["outcome"] == "true"]
    assert 1 - share(own) <= 0.016
    wrong = [row for row in trials if row["outcome"] == "wrong"]
    assert share([row for row in wrong if row["kind"] in trial_rows.STRANGERS]) == 0
    assert share([row for row in wrong if row["intrinsics"] == "off"]) <= 0.05
    assert share([row for row in wrong if row["kind"] in trial_rows.RESHAPED]) <= 0.1


def test_no_pose_of_another_place_is_certain_and_most_right_ones_are(trials):
    poses = [row for row in trials if "measures" in row]
    kinds = "other", "turned"
    elsewhere = [row["measures"].confidence for row in poses if row["kind"] in kinds]
    assert len(elsewhere) > 1500 and 1.5 * max(elsewhere) < absolute_pose.CERTAIN
    own = [row for row in poses if row["kind"] in accuracy_tables.OWN and row["outcome"] == "true"]
    certain = [row["measures"].confidence >= absolute_pose.CERTAIN for row in own]
    assert np.mean(certain) > 0.94  # with dark and blurred ones


def test_trials_name_the_places_of_their_maps(trials):
    """With keypoints of other settings, they were once called by their base feature."""
    bases = {*features_confs.BASES}
    assert not bases & {row[key] for row in trials for key in ("map", "place")}


def test_labels_of_trials():
    """Poses that are wrong although the photo belongs are not by wrong matches."""
    for outcome, kind, expected in (
        ("true", "own", True),
        ("true", "cropped", True),
        ("wrong", "other", False),
        ("wrong", "mirrored", False),
        ("wrong", "own", None),
        ("near", "own", None),
    ):
        assert trial_rows.label({"outcome": outcome, "kind": kind}) is expected


def test_measures_are_the_same_in_rows(trials):
    row = next(row for row in trials if "measures" in row and row["measures"].alternatives)
    again = trial_rows.to_row(row["measures"])
    text = {name: str(again.get(name, "")) for name in trial_rows.COLUMNS}
    assert trial_rows.of_row(text) == row["measures"]


def test_a_warped_photo_is_taken_by_a_turned_camera():
    camera = pycolmap.Camera(
        model="SIMPLE_PINHOLE", width=1200, height=900, params=[1000, 600, 450]
    )
    truth = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.1, 0.2, 0.3])), [1.0, 2, 3])
    found = benchmark_trials.warped_pose(camera, truth)
    assert found.inverse().translation == pytest.approx(truth.inverse().translation)
    points = np.random.default_rng(0).uniform(-1, 1, (20, 3)) + [0, 0, 8]
    warped = project(truth, points) @ camera.calibration_matrix().T
    warped = warped @ benchmark_trials.warping(1200, 900).T
    # rays of the turned camera are those of the warped photo, by some upper triangular matrix
    rays = project(found, points)
    calibration = np.linalg.lstsq(rays / rays[:, 2:], warped / warped[:, 2:], rcond=None)[0].T
    assert np.abs(np.tril(calibration, -1)).max() < 1e-9
    assert (np.diag(calibration) > 0).all()


def project(cam_from_world, points):
    return points @ cam_from_world.rotation.matrix().T + cam_from_world.translation


@pytest.mark.parametrize("turns", range(4))
def test_points_of_a_turned_photo_are_where_its_pixels_are(turns):
    camera = pycolmap.Camera(model="PINHOLE", width=40, height=30, params=[31, 32, 19, 16])
    pose = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.1, 0.2, 0.3])), np.array([0, 0.2, 5]))
    points = np.random.default_rng(0).uniform(-1, 1, (5, 3))
    expected = images.turned(camera.img_from_cam(pose * points) - 0.5, np.array([40, 30]), turns)
    turned = changed_photos.on_its_side(camera, turns)
    found = turned.img_from_cam(changed_photos.about_axis(pose, turns) * points)
    np.testing.assert_allclose(found - 0.5, expected, atol=1e-9)
    assert (turned.width, turned.height) == ((30, 40) if turns % 2 else (40, 30))


def test_triplets_with_accurate_poses():
    """Those with a keypoint that is far off are none; the others are."""
    model, _ = row_of_photos.row({})
    image = model.find_image_with_name("2.jpg")
    image.points2D[7].xy = image.points2D[7].xy + [40, 0]
    generator, points = np.random.default_rng(0), np.arange(60)
    rows = selections._accurate(image, row_of_photos.POINTS, points, generator)
    assert 7 not in rows and len(rows) > 0.8 * selections.TRIPLETS
    assert all(len(set(triplet)) == 3 for triplet in rows.tolist())
