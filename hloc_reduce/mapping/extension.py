"""Add images with poses to a COLMAP model: extend its points and triangulate new ones."""

import copy
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
import pycolmap

from ..localization.projection import median_photo_scale
from ..utils import colmap
from .epipolar import agreeing

COMPLETIONS = 2  # of completing tracks, adjusting and filtering
# the poses of cameras in rigs are given
REPEATABLE = {"num_threads": 1, "random_seed": 0, "ba_refine_sensor_from_rig": False}
OPTIONS = colmap.mapper_options(REPEATABLE)  # without a scale

Pair = tuple[str, str]


@dataclass(frozen=True)
class Placed:
    """The pose of an image in the frame of a model.

    Args:
        cam_from_world: the pose.
        camera: the intrinsics.
        known: the intrinsics are exact: those of a camera of the map, or given.
        fixed: the pose is given, so that it stays.
    """

    cam_from_world: pycolmap.Rigid3d
    camera: pycolmap.Camera
    known: bool
    fixed: bool


def extend(
    model: pycolmap.Reconstruction,
    placed: Mapping[str, Placed],
    keypoints: Mapping[str, np.ndarray],
    uncertainty: Mapping[str, float],
    matches: Mapping[Pair, np.ndarray],
    refine_map: bool = False,
) -> None:
    """Add images to a model.

    The points that they see and the poses that are not given are adjusted; the other images and
    their intrinsics stay, unless `refine_map`.

    Args:
        model: changed in place.
        placed: the new images, by name.
        keypoints: (N, 2) of all images that are matched, COLMAP's pixels.
        uncertainty: of their keypoints in pixels.
        matches: (M, 2) of pairs of new images, and of new images and those of the model; those that
            contradict the poses are not used.
        refine_map: adjust the poses of all images, but those that are given, and all points.
    """
    with colmap.near_origin(model) as near_from_world:
        near = {
            name: replace(
                image, cam_from_world=near_from_world.transform_camera_world(image.cam_from_world)
            )
            for name, image in placed.items()
        }
        # the larger one: points must not lose their observations in the larger photos
        pixel_scale = max(
            median_photo_scale(image.camera for image in model.images.values()),
            median_photo_scale(image.camera for image in near.values()),
        )
        ids = _add_images(model, near, keypoints)
        graph = _graph(model, keypoints, uncertainty, matches)
        observations = pycolmap.ObservationManager(model, graph)
        triangulator = pycolmap.IncrementalTriangulator(graph, model, observations)
        options = colmap.mapper_options(REPEATABLE, pixel_scale)
        tracks, limits = options.get_triangulation(), options.get_mapper()
        # the graph has no matches of two images of the model, so longer tracks look like these
        tracks.ignore_two_view_tracks = False
        for image_id in ids.values():
            triangulator.triangulate_image(tracks, image_id)
        free = {ids[name] for name, image in near.items() if not image.fixed}
        unknown = {model.images[ids[n]].camera_id for n, image in near.items() if not image.known}
        for _ in range(COMPLETIONS):
            triangulator.complete_tracks(tracks, _points_of(model, ids.values()))
            triangulator.merge_tracks(tracks, _points_of(model, ids.values()))
            _adjust(model, ids.values(), free, unknown, refine_map)
            observations.filter_points3D_in_images(
                limits.filter_max_reproj_error, limits.filter_min_tri_angle, set(ids.values())
            )
        model.update_point_3d_errors()


def _add_images(
    model: pycolmap.Reconstruction,
    placed: Mapping[str, Placed],
    keypoints: Mapping[str, np.ndarray],
) -> dict[str, int]:
    """Add images without points; equal known intrinsics are one camera. Returns their ids."""
    # cameras with a rig of their own; an added image gets ids that no frame and rig has
    own = {
        rig.rig_id
        for rig in model.rigs.values()
        if rig.num_sensors() == 1 and rig.ref_sensor_id.id == rig.rig_id
    }
    cameras = {_values(camera): camera for id, camera in model.cameras.items() if id in own}
    image_id = max([*model.images, *model.frames], default=0)
    camera_id = max([*model.cameras, *model.rigs], default=0)
    ids = {}
    for name, image in placed.items():
        camera = cameras.get(_values(image.camera)) if image.known else None
        if camera is None:
            camera_id += 1
            camera = pycolmap.Camera(image.camera.todict() | {"camera_id": camera_id})
            if image.known:
                cameras[_values(camera)] = camera
        image_id += 1
        ids[name] = image_id
        new = pycolmap.Image(
            name=name,
            keypoints=keypoints[name].astype(np.float64),
            camera_id=camera.camera_id,
            image_id=image_id,
        )
        colmap.add_image(model, camera, new, image.cam_from_world)
    return ids


def _values(camera: pycolmap.Camera) -> tuple:
    """Return what makes two cameras equal."""
    return camera.model, camera.width, camera.height, *camera.params


def _graph(
    model: pycolmap.Reconstruction,
    keypoints: Mapping[str, np.ndarray],
    uncertainty: Mapping[str, float],
    matches: Mapping[Pair, np.ndarray],
) -> pycolmap.CorrespondenceGraph:
    """Return the matches of images of a model that agree with their poses."""
    graph, ids = pycolmap.CorrespondenceGraph(), {}
    for image_id, image in model.images.items():
        graph.add_image(image_id, image.num_points2D())
        ids[image.name] = image_id
    matched = [model.images[ids[name]] for name in keypoints]
    for pair, valid in agreeing(matched, keypoints, matches, uncertainty).items():
        rows, (first, second) = matches[pair][valid].astype(np.uint32), (ids[name] for name in pair)
        if hasattr(graph, "add_correspondences"):  # pycolmap 3.13
            graph.add_correspondences(first, second, rows)
            continue
        config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
        geometry = pycolmap.TwoViewGeometry(config=config, inlier_matches=rows)
        graph.add_two_view_geometry(first, second, geometry)
    graph.finalize()
    return graph


def _points_of(model: pycolmap.Reconstruction, image_ids: Collection[int]) -> set[int]:
    """Return the ids of the points that images see."""
    found = [colmap.point3D_ids(model.images[image_id]) for image_id in image_ids]
    return {int(i) for i in np.unique(np.concatenate(found)) if i >= 0}


def _adjust(
    model: pycolmap.Reconstruction,
    new: Collection[int],
    free: Collection[int],
    unknown: Collection[int],
    refine_map: bool,
) -> None:
    """Adjust the points of new images with poses and intrinsics, COLMAP's local bundle adjustment.

    Args:
        model: the model.
        new: ids of the new images.
        free: of those whose poses are estimated.
        unknown: ids of the cameras whose intrinsics are estimated.
        refine_map: adjust the other images and points, too; what the given poses leave open of the
            frame stays that of the other images.
    """
    config = pycolmap.BundleAdjustmentConfig()
    images = set(model.reg_image_ids()) if refine_map else set(new)
    for image_id in images:
        config.add_image(image_id)
    stays = set(new) - set(free)
    for frame_id in {model.images[image_id].frame_id for image_id in stays}:
        config.set_constant_rig_from_world_pose(frame_id)
    for camera_id in {model.images[image_id].camera_id for image_id in images} - set(unknown):
        config.set_constant_cam_intrinsics(camera_id)
    if refine_map:
        config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    else:
        for point_id in _points_of(model, new):
            config.add_variable_point(point_id)  # also seen by images that stay
    options = colmap.exact(OPTIONS.get_local_bundle_adjustment())
    adjuster = pycolmap.create_default_bundle_adjuster(options, config, model)
    if refine_map:
        with _same_frame(model, images - set(new), stays):
            adjuster.solve()
    else:
        adjuster.solve()


@contextmanager
def _same_frame(
    model: pycolmap.Reconstruction, old: Collection[int], fixed: Collection[int]
) -> Iterator[None]:
    """Move a model that is adjusted in a block back to where its images were.

    COLMAP's gauge fixes one pose and a coordinate of another, so that the adjusted model depends on
    the directions of its axes.

    Args:
        model: the model.
        old: ids of the images that are aligned with where they were.
        fixed: of those whose poses are given and stay. Two fix the frame, one all but its scale.
    """
    before = _corners(model, old)
    yield
    after = _corners(model, old)
    if not fixed:
        moved = pycolmap.estimate_sim3d(after, before)
        if moved is not None:  # images at one place determine none
            model.transform(moved)
    elif len(fixed) == 1:
        (image,) = (model.images[image_id] for image_id in fixed)
        pose, centre = copy.deepcopy(image.cam_from_world()), image.projection_center()
        scale = np.linalg.norm(before - centre) / np.linalg.norm(after - centre)
        model.transform(pycolmap.Sim3d(scale, pycolmap.Rotation3d(), (1 - scale) * centre))
        model.frames[image.frame_id].rig_from_world = pose  # to the bit


def _corners(model: pycolmap.Reconstruction, image_ids: Collection[int]) -> np.ndarray:
    """Return points (6 I, 3) that determine a frame, on the axes of cameras around their centres.

    Centres alone leave open how a row of cameras is turned about itself. The distance of the points
    is the spread of the centres, so that it has the scale of the model.
    """
    images = [model.images[i] for i in image_ids]
    centres = np.array([image.projection_center() for image in images])
    axes = np.concatenate([image.cam_from_world().rotation.matrix() for image in images])
    spread, centres = np.sqrt(centres.var(axis=0).sum()), centres.repeat(3, axis=0)
    return np.concatenate([centres + spread * axes, centres - spread * axes])


def count_shared(model: pycolmap.Reconstruction, names: Collection[str]) -> dict[str, int]:
    """Return how many points each of `names` shares with images that are not among them."""
    new = {image_id for image_id, image in model.images.items() if image.name in names}
    found = {}
    for image_id in new:
        ids = colmap.point3D_ids(model.images[image_id])
        tracks = [model.points3D[int(i)].track.elements for i in ids[ids >= 0]]
        others = (any(one.image_id not in new for one in track) for track in tracks)
        found[model.images[image_id].name] = sum(others)
    return found
