"""Images that are added to a model, and taken away, of a scene whose points are known."""

import numpy as np
import pycolmap
import pytest

from hloc_reduce.localization.projection import photo_scale
from hloc_reduce.mapping import extension
from hloc_reduce.mapping.extension import Placed
from hloc_reduce.utils import colmap
from hloc_reduce.utils.feature_files import get_colmap_keypoints
from hloc_reduce.utils.h5 import open_h5

OLD, NEW = [f"db/{i}.jpg" for i in range(4)], ["db/4.jpg", "query/6.jpg"]
KNOWN = 200  # points that the model has before


@pytest.fixture
def model(scene) -> pycolmap.Reconstruction:
    scene.camera = scene.reference.cameras[1]
    with open_h5(scene.features) as file:
        scene.keypoints = {name: get_colmap_keypoints(file, name)[0] for name in OLD + NEW}
    return build(scene)


def build(scene) -> pycolmap.Reconstruction:
    """A model of four images with two thirds of the points."""
    made = pycolmap.Reconstruction()
    for i, name in enumerate(OLD):
        arguments = {"keypoints": scene.keypoints[name], "camera_id": 1, "image_id": i + 1}
        image = pycolmap.Image(name=name, **arguments)
        colmap.add_image(made, scene.camera, image, scene.poses[name])
    for point in range(KNOWN):
        rows = [int(np.flatnonzero(scene.seen[name] == point)[0]) for name in OLD]
        elements = [pycolmap.TrackElement(i + 1, row) for i, row in enumerate(rows)]
        made.add_point3D(scene.points[point], pycolmap.Track(elements))
    return made


def matches(scene, pairs) -> dict:
    """Return the true matches of pairs."""
    order = {name: np.argsort(scene.seen[name]) for name in OLD + NEW}
    return {(a, b): np.column_stack([order[a], order[b]]) for a, b in pairs}


def extend(scene, model, names, pairs=None, known=True, fixed=False, move=0.0, **options) -> None:
    placed = {}
    for name in names:
        pose = scene.poses[name]
        pose = pycolmap.Rigid3d(pose.rotation, pose.translation + move)
        placed[name] = Placed(pose, scene.camera, known, fixed)
    if pairs is None:
        pairs = [(name, other) for name in names for other in OLD]
    used = {name for pair in pairs for name in pair}
    keypoints = {name: scene.keypoints[name] for name in used}
    cameras = {image.name: image.camera for image in model.images.values()}
    uncertainty = {name: photo_scale(cameras.get(name, scene.camera)) for name in used}
    extension.extend(model, placed, keypoints, uncertainty, matches(scene, pairs), **options)


def poses(model) -> dict[str, np.ndarray]:
    return {image.name: image.cam_from_world().matrix() for image in model.images.values()}


def test_points_are_extended_and_others_triangulated(scene, model):
    before = poses(model)
    extend(scene, model, NEW, move=0.003)
    after = poses(model)
    assert all(np.array_equal(after[name], before[name]) for name in OLD)
    for name in NEW:  # they were 3 mm off
        assert after[name] == pytest.approx(scene.poses[name].matrix(), abs=1e-4)
    assert model.num_points3D() == len(scene.points)
    lengths = [point.track.length() for point in model.points3D.values()]
    assert set(lengths) == {len(OLD) + len(NEW)}
    assert model.num_cameras() == 1  # their intrinsics are those of the map's camera
    assert extension.count_shared(model, NEW) == dict.fromkeys(NEW, len(scene.points))


@pytest.mark.fault(1)
def test_far_from_the_origin(scene, model):
    """In UTM coordinates, images find the poses that they are moved away from."""
    utm = pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), np.array([448251.0, 5411932.0, 312.0]))
    model.transform(utm)
    scene.poses = {name: utm.transform_camera_world(pose) for name, pose in scene.poses.items()}
    extend(scene, model, NEW, move=0.003)
    for name in NEW:
        pose = model.find_image_with_name(name).cam_from_world()
        moved = pose * scene.poses[name].inverse()
        assert np.linalg.norm(moved.translation) < 1e-4
    assert model.num_points3D() == len(scene.points)


@pytest.mark.parametrize("large", [OLD, NEW])
def test_photos_of_12_megapixels_keep_their_points_beside_small_ones(scene, model, large):
    """A noise of 2.5 of their 4,000 pixels is one of 1,600, in which keypoints are found."""
    small, enlarged = scene.camera, pycolmap.Camera(scene.camera.todict())
    enlarged.rescale(6.25)
    generator = np.random.default_rng(0)
    for name in large:
        keypoints = 6.25 * scene.keypoints[name]
        scene.keypoints[name] = keypoints + generator.normal(0, 2.5, keypoints.shape)
    scene.camera = enlarged if large == OLD else small
    model = build(scene)
    scene.camera = enlarged if large == NEW else small
    extend(scene, model, NEW, fixed=True)
    for name in OLD + NEW:
        assert model.find_image_with_name(name).num_points3D > 0.95 * len(scene.points)


def test_given_poses_stay(scene, model):
    extend(scene, model, NEW, fixed=True, move=0.003)
    moved = scene.poses[NEW[0]].matrix()[:, 3] + 0.003
    assert np.array_equal(poses(model)[NEW[0]][:, 3], moved)


def test_inexact_intrinsics_are_refined(scene, model):
    focal_length = scene.camera.params[0]
    scene.camera = pycolmap.Camera(scene.camera.todict())
    scene.camera.params = [1.01 * focal_length, *scene.camera.params[1:]]
    extend(scene, model, NEW, known=False)
    assert model.num_cameras() == 3  # each photo has its own
    for name in NEW:
        camera = model.find_image_with_name(name).camera
        assert camera.params[0] == pytest.approx(focal_length, rel=1e-3)
    assert model.cameras[1].params[0] == focal_length


def test_points_of_an_old_and_a_new_image(scene, model):
    extend(scene, model, NEW[:1], pairs=[(NEW[0], OLD[0])])
    lengths = [point.track.length() for point in model.points3D.values()]
    assert lengths.count(len(OLD) + 1) >= 0.95 * KNOWN
    assert lengths.count(2) >= 0.5 * (len(scene.points) - KNOWN)


def test_matches_that_contradict_the_poses_are_not_used(scene, model):
    scene.seen[NEW[0]] = np.random.default_rng(0).permutation(scene.seen[NEW[0]])  # wrong matches
    extend(scene, model, NEW[:1], fixed=True)
    assert extension.count_shared(model, NEW[:1])[NEW[0]] < 0.05 * KNOWN


def test_the_map_is_refined_on_demand(scene, model):
    for image in model.images.values():
        frame, pose = model.frames[image.frame_id], image.cam_from_world()
        noise = 0.003 * np.random.default_rng(image.image_id).standard_normal(3)
        frame.rig_from_world = pycolmap.Rigid3d(pose.rotation, pose.translation + noise)
    extend(scene, model, NEW, fixed=True, refine_map=True)
    for name in OLD:
        assert poses(model)[name] == pytest.approx(scene.poses[name].matrix(), abs=1e-3)


FRAMES = {
    "ECEF": pycolmap.Sim3d(
        1.0,
        pycolmap.Rotation3d(np.array([0.5, 0.1, 0.7, 0.5])),
        np.array([4.000006e6, 6.00005e5, 4.899995e6]),
    ),
    "UTM in millimetres": pycolmap.Sim3d(
        1000.0, pycolmap.Rotation3d(), np.array([4.48251e8, 5.411932e9, 3.12e5])
    ),
}


@pytest.fixture
def noisy(scene, model):
    """The scene with keypoints that are off by a pixel, which no map fits exactly."""
    generator = np.random.default_rng(0)
    for name, keypoints in scene.keypoints.items():
        scene.keypoints[name] = keypoints + generator.normal(0, 1, keypoints.shape)
    return scene


@pytest.mark.fault(1)
@pytest.mark.parametrize("frame", FRAMES.values(), ids=FRAMES.keys())
@pytest.mark.parametrize(("names", "fixed"), [(NEW, False), (NEW[:1], True)])
def test_a_map_is_refined_alike_in_any_frame(noisy, frame, names, fixed):
    """The solver ends at no size of the gradient, and the map keeps its frame."""
    near, far = build(noisy), build(noisy)
    extend(noisy, near, names, fixed=fixed, refine_map=True)
    far.transform(frame)
    noisy.poses = {n: frame.transform_camera_world(pose) for n, pose in noisy.poses.items()}
    extend(noisy, far, names, fixed=fixed, refine_map=True)
    far.transform(frame.inverse())
    for image in near.images.values():
        other = far.find_image_with_name(image.name)
        assert np.linalg.norm(image.projection_center() - other.projection_center()) < 1e-4
        turn = image.cam_from_world().rotation * other.cam_from_world().rotation.inverse()
        assert np.rad2deg(turn.angle()) < 0.001


@pytest.mark.fault(1)
def test_a_refined_map_keeps_its_frame(noisy):
    """The errors of one camera, or of a coordinate, are not those of the whole map."""
    refined = build(noisy)
    extend(noisy, refined, NEW, refine_map=True)
    errors = [
        refined.find_image_with_name(name).projection_center() - pose.inverse().translation
        for name, pose in noisy.poses.items()
        if name in OLD
    ]
    assert np.linalg.norm(np.mean(errors, axis=0)) < 0.1 * np.linalg.norm(errors, axis=1).mean()


def test_removed_images_leave_the_points_of_the_others(scene, model):
    extend(scene, model, NEW)
    colmap.remove_images(model, [*NEW, OLD[0]])
    assert {image.name for image in model.images.values() if image.has_pose} == {*OLD[1:]}
    assert {point.track.length() for point in model.points3D.values()} == {3}
    colmap.remove_images(model, OLD[1:3])
    assert model.num_points3D() == 0


def test_a_model_with_a_rig(scene, model):
    """A photo by a camera of a rig, which has no rig of its own, gets another camera."""
    other = pycolmap.Camera({**scene.camera.todict(), "camera_id": 7})
    other.params = [501.0, *scene.camera.params[1:]]
    model.add_camera(other)
    rig = model.rigs[1]
    rig.add_sensor(other.sensor_id, pycolmap.Rigid3d())
    scene.camera = other
    extend(scene, model, NEW[:1])
    image = model.find_image_with_name(NEW[0])
    assert image.camera_id == 8 and image.frame_id not in range(1, len(OLD) + 1)
