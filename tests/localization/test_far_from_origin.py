"""A map far from the origin, as in UTM or ECEF, localizes as the same map near it does."""

import base64
import shutil

import cv2
import numpy as np
import pycolmap
import pytest
import small_map
from command import outcome

from hloc_reduce import Localizer, compact, maps
from hloc_reduce.evaluation.poses import pose_error
from hloc_reduce.localization.records import pose_of
from hloc_reduce.mapping import adjustment
from hloc_reduce.report.runs import load
from hloc_reduce.report.scene import scenes
from hloc_reduce.utils import colmap
from pipelines import localize

PIPELINE = localize
# the same worlds in other units and frames: units in a metre, a turn and an origin
FRAMES = {
    "near": (1.0, (0, 0, 0), (0, 0, 0)),
    "near, in mm": (1000.0, (0, 0, 0), (0, 0, 0)),
    "local": (1.0, (0, 0, 0), (1e5, 0, 0)),
    "utm": (1.0, (0, 0, 0), (448251.0, 5411932.0, 312.0)),
    "ecef": (1.0, (0.4, 1.1, -0.7), (4.0e6, 6.0e5, 4.9e6)),
    "utm, in mm": (1000.0, (0, 0, 0), (4.48251e8, 5.411932e9, 3.12e5)),
}
FAR = [name for name in FRAMES if not name.startswith("near")]
MILLIMETRE = 0.001


def frame(name: str) -> pycolmap.Sim3d:
    scale, turn, origin = FRAMES[name]
    rotation = pycolmap.Rotation3d(cv2.Rodrigues(np.array(turn, float))[0])
    return pycolmap.Sim3d(scale, rotation, np.array(origin, float))


def assert_same(
    pose: pycolmap.Rigid3d, expected: pycolmap.Rigid3d, name: str, near: str = "near"
) -> None:
    """Check a pose, camera from world, in a frame against one in a frame near the origin."""
    in_metres = frame(near).inverse().transform_camera_world(expected)
    position, rotation = pose_error(pose, frame(name).transform_camera_world(in_metres))
    assert position < MILLIMETRE * FRAMES[name][0] and rotation < 0.01


def move_model(path, name: str) -> None:
    model = pycolmap.Reconstruction(path)
    model.transform(frame(name))
    shutil.rmtree(path)
    path.mkdir()
    model.write(path)


@pytest.mark.fault(1)
@pytest.mark.parametrize("name", FAR)
def test_stages(scene, name):
    """Triangulated, and localized with listed and with unknown intrinsics."""
    move_model(scene.model, name)
    built = small_map.build(scene)
    for point in built.map.points3D.values():
        image = built.map.images[point.track.elements[0].image_id]
        which = scene.seen[image.name][point.track.elements[0].point2D_idx]
        error = np.linalg.norm(point.xyz - frame(name) * scene.points[which])
        assert error < MILLIMETRE * FRAMES[name][0]
    refined = {"estimation": {"estimate_focal_length": True}}
    refined["refinement"] = {"refine_focal_length": True}
    for refinements in ({}, {f"query/{i}.jpg": refined for i in (6, 7)}):
        records = built.localize(refinements=refinements, full_names=True, overwrite=True)
        for query, record in records.items():
            assert record["localized"]
            assert_same(pose_of(record), scene.poses[query], name)


@pytest.mark.fault(1)
@pytest.mark.parametrize("name", FAR)
def test_adjustment(scene, name):
    """The adjustment of a whole model finds the poses and points that it is moved away from."""
    move_model(scene.model, name)
    sfm = small_map.build(scene).map
    generator = np.random.default_rng(0)
    for point in sfm.points3D.values():
        point.xyz = point.xyz + FRAMES[name][0] * generator.normal(0, 0.01, 3)
    assert adjustment.adjusted_error(sfm) < 0.01
    deviations = adjustment.focal_length_deviations(sfm)
    assert all(0 < deviation < 0.01 for deviation in deviations.values())


@pytest.fixture
def build(aachen_layout, tmp_path, run):
    """Builds a map of the plane in a frame, and returns its folder."""
    images, model = aachen_layout / "images_upright", aachen_layout / "3D-models/aachen_v_1_1"

    def build(name: str):
        moved = tmp_path / name / "model"
        shutil.copytree(model, moved)
        move_model(moved, name)
        run("--map", moved, "--map_images", images, "--outputs", tmp_path / name)
        return tmp_path / name / "map"

    return build


@pytest.mark.fault(1)
@pytest.mark.parametrize(("near", "name"), [("near", "ecef"), ("near, in mm", "utm, in mm")])
def test_maps(build, aachen_layout, tmp_path, run, near, name):
    """In memory, in a compact file, and with a photo that is localized and added."""
    queries, found = aachen_layout / "images_upright/query/day", []
    for where in (near, name):
        folder = build(where)
        compact.main(tmp_path / f"{where}.hlm", folder)
        camera = next(iter(colmap.read_model(folder / "sfm").cameras.values()))
        poses = [
            Localizer(place).localize(queries / "a.png", of_photo)[0]
            for place in (folder, tmp_path / f"{where}.hlm")
            for of_photo in (camera, None)
        ]
        run("--map", folder, "--add_images", queries)
        sfm = colmap.read_model(maps.Map(folder).sfm)
        poses.append(sfm.find_image_with_name("a.png").cam_from_world())
        found.append(poses)
    for expected, pose in zip(*found, strict=True):
        assert_same(pose, expected, name, near)


@pytest.mark.fault(1)
def test_report(build, aachen_layout, run):
    """The page has single precision: its points lie where the cameras see them."""
    shown = []
    for name in ("near", "utm"):
        folder = build(name)
        queries = aachen_layout / "images_upright/query/day"
        run("--map", folder, "--query_images", queries, "--outputs", folder.parent)
        outputs = folder.parent / "queries-day"
        assert outcome(outputs)[1]["a.png"]["status"] == "localized"
        [view] = scenes(load([outputs])[0]).values()
        points = np.frombuffer(base64.b64decode(view["points"]), np.float32).reshape(-1, 3)
        shown.append((points, np.array(view["map"])))
    for near, far in zip(*shown, strict=True):
        np.testing.assert_allclose(far, near, atol=MILLIMETRE)
