"""Models that are aligned with GPS positions, and those that are not."""

import numpy as np
import pycolmap
import pytest

from hloc_reduce.mapping import alignment, gravity
from hloc_reduce.mapping.alignment import NotAligned
from hloc_reduce.utils import colmap

ORIGIN = np.array([47.375, 8.5, 408.5])
# the frame of the map: of another scale, turned and shifted
QUATERNION = np.array([0.1, 0.5, -0.3, 0.8])
MAP = pycolmap.Sim3d(
    0.3, pycolmap.Rotation3d(QUATERNION / np.linalg.norm(QUATERNION)), np.array([1.0, 2, 3])
)
CAMERA = pycolmap.Camera(
    model="SIMPLE_PINHOLE", width=64, height=48, params=[50, 32, 24], camera_id=1
)
GENERATOR = np.random.default_rng(0)
SPREAD = GENERATOR.normal(0, 1, (12, 3)) * [30, 30, 4]
STREET = np.linspace(-60, 60, 12)[:, None] * [0.8, 0.6, 0]
FLAT = SPREAD * [1, 1, 0]


def upright(i, roll=0.0):
    """Return the rotation of a camera that looks around, up and down, and is held upright."""
    yaw, pitch = 2.4 * i, 0.2 * np.sin(5 * i)
    forward = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)])
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    axes = np.array([right, np.cross(forward, right), forward])
    cosine, sine = np.cos(roll), np.sin(roll)
    return np.array([[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1]]) @ axes


def model_of(centres, rotations=None):
    """Return a model of cameras at positions east, north and up, in the frame of the map."""
    model = pycolmap.Reconstruction()
    for i, centre in enumerate(centres):
        rotation = upright(i) if rotations is None else rotations[i]
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), -rotation @ centre)
        image = pycolmap.Image(name=f"{i}.jpg", camera_id=1, image_id=i + 1)
        colmap.add_image(model, CAMERA, image, pose)
    model.transform(MAP)
    return model


def positions_of(centres, noise=0.0, seed=0):
    """Return GPS positions with normal noise in each coordinate."""
    noisy = centres + np.random.default_rng(100 + seed).normal(0, noise, centres.shape)
    found = colmap.ellipsoid_from_enu(noisy, ORIGIN)
    return {f"{i}.jpg": position for i, position in enumerate(found)}


def aligned(model, positions):
    return alignment.align(model, positions, gravity.find(model, {}))


def placed_in(model):
    return np.array([model.images[i].projection_center() for i in sorted(model.reg_image_ids())])


def check(found, model, centres, limit):
    """Check that aligned cameras are where they were, relative to their centre."""
    model.transform(found.metric_from_map)
    placed = placed_in(model)
    origin = colmap.enu_from_ellipsoid(np.array([found.frame.origin]), ORIGIN)[0]
    assert np.abs(placed + origin - centres).max() < limit


@pytest.mark.parametrize("centres", [SPREAD, FLAT], ids=["spread", "flat"])
def test_exact_positions(centres):
    """Are found to a millimetre, and the origin is a photo's position near the centre."""
    model, positions = model_of(centres), positions_of(centres)
    found = aligned(model, positions)
    assert found.frame.units == "m" and found.frame.told_by == ("gps",)
    assert not found.wrong and max(found.residuals.values()) < 1e-3
    [nearest] = [name for name in positions if tuple(positions[name]) == found.frame.origin]
    assert np.linalg.norm(centres[int(nearest.split(".")[0]), :2]) < 30
    check(found, model, centres, 1e-3)


def test_noise_is_averaged():
    scales = []
    for seed in range(20):
        found = aligned(model_of(SPREAD), positions_of(SPREAD, 0.5, seed))
        scales.append(found.metric_from_map.scale * MAP.scale)
        assert not found.wrong and abs(scales[-1] - 1) < 1.5 * found.scale_error < 0.03
    assert abs(np.mean(scales) - 1) < 0.003


def test_a_photo_far_off_is_ignored():
    positions = positions_of(SPREAD, 0.1)
    positions["3.jpg"] = positions["3.jpg"] + [500 / 111_200, 0, 0]
    model = model_of(SPREAD)
    found = aligned(model, positions)
    assert found.wrong == ["3.jpg"] and found.residuals["3.jpg"] == pytest.approx(500, abs=2)
    check(found, model, SPREAD, 0.5)


@pytest.mark.parametrize("noise", [0.0, 0.2])
def test_positions_on_a_line(noise):
    """The cameras tell the roll around it."""
    model = model_of(STREET + np.random.default_rng(1).normal(0, 1e-3, STREET.shape))
    found = aligned(model, positions_of(STREET, noise))
    assert found.frame.told_by == ("gps", "gravity")
    check(found, model, STREET, 0.05 + 2 * noise)


def test_positions_without_altitudes():
    """The cameras tell the tilt, and heights are relative to the origin."""
    positions = positions_of(SPREAD)
    for position in positions.values():
        position[2] = np.nan
    model = model_of(SPREAD)
    found = aligned(model, positions)
    assert found.frame.told_by == ("gps", "gravity") and np.isnan(found.frame.origin[2])
    model.transform(found.metric_from_map)
    heights = placed_in(model)[:, 2]
    np.testing.assert_allclose(heights - heights[0], SPREAD[:, 2] - SPREAD[0, 2], atol=0.5)


def scattered():
    """Return rotations of cameras that do not agree on which way is up."""
    return [upright(i, roll=2.1 * i) for i in range(12)]


@pytest.mark.parametrize(
    ("centres", "rotations", "said"),
    [
        (STREET, scattered(), "nearly on a line, do not tell the tilt. Nor do the cameras"),
        (SPREAD / 10, None, "too inexact for this place"),
        (SPREAD[:2], None, "with a GPS position: 2 (0.jpg, 1.jpg). At least 3 are needed"),
    ],
    ids=["line", "small", "few"],
)
def test_what_does_not_determine_the_frame(centres, rotations, said):
    model = model_of(centres, rotations)
    with pytest.raises(NotAligned) as error:
        aligned(model, positions_of(centres, 1.0))
    assert said in str(error.value)


def test_photos_with_the_same_positions():
    positions = positions_of(np.repeat(SPREAD[:2], 6, axis=0))
    with pytest.raises(NotAligned, match="fewer than 3 different GPS positions"):
        aligned(model_of(SPREAD), positions)


def test_positions_that_contradict_each_other():
    """As those of other photos with the same names."""
    positions = positions_of(40 * np.random.default_rng(5).normal(0, 1, SPREAD.shape))
    with pytest.raises(NotAligned, match="contradict each other or the map: only . of 12 agree"):
        aligned(model_of(SPREAD), positions)


def test_coordinates_of_a_given_model():
    """As UTM, in which a metre is the sixth digit."""
    model = model_of(SPREAD)
    model.transform(pycolmap.Sim3d(1, pycolmap.Rotation3d(), np.array([448251.0, 5411932, 312])))
    check(aligned(model, positions_of(SPREAD)), model, SPREAD, 1e-3)


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_gravity_of_photos_that_are_stored_turned(orientation):
    """Some are; EXIF data say how."""
    quarter = {1: 0, 3: 2, 6: 3, 8: 1}[orientation]
    rolls = [np.pi / 2 * quarter * (i % 2) for i in range(12)]
    model = model_of(SPREAD, [upright(i, -roll) for i, roll in enumerate(rolls)])
    found = gravity.find(model, {f"{i}.jpg": orientation for i in range(1, 12, 2)})
    assert found.number == 12
    np.testing.assert_allclose(found.up, MAP.rotation.matrix()[:, 2], atol=5e-3)
    np.testing.assert_allclose(found.level().matrix() @ found.up, [0, 0, 1], atol=1e-12)


def test_gravity_of_most_cameras():
    """Those that are not held upright do not count; without most there is none."""
    rotations = [upright(i, roll=1.5 * (i < 4)) for i in range(12)]
    found = gravity.find(model_of(SPREAD, rotations), {})
    assert found.number == 8
    np.testing.assert_allclose(found.up, MAP.rotation.matrix()[:, 2], atol=5e-3)
    assert gravity.find(model_of(SPREAD, scattered()), {}) is None
    assert gravity.find(pycolmap.Reconstruction(), {}) is None


def test_gravity_of_photos_that_are_gone():
    """They may be stored turned, whereas the others were held upright."""
    model = model_of(SPREAD, [upright(i, roll=np.pi / 2 * (i > 3)) for i in range(12)])
    turned = [f"{i}.jpg" for i in range(4, 12)]
    found = gravity.find(model, {}, turned)
    assert found.number == 4
    np.testing.assert_allclose(found.up, MAP.rotation.matrix()[:, 2], atol=5e-3)
    assert gravity.find(model, {}, [*turned, "0.jpg", "1.jpg", "2.jpg"]) is None


def test_a_frame_that_is_upside_down():
    found = gravity.Gravity(np.array([0.0, 0, -1]), 1).level().matrix()
    np.testing.assert_allclose(found @ [0, 0, -1], [0, 0, 1], atol=1e-12)


def test_photos_of_a_moment_count_once():
    """As the views of a panorama, which are at one place."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 1, 3, 2
    model = pycolmap.synthesize_dataset(options)
    names = sorted(image.name for image in model.images.values())
    assert len(names) == 6
    positions = dict(zip(names, colmap.ellipsoid_from_enu(SPREAD[:6], ORIGIN), strict=True))
    with pytest.raises(NotAligned, match="GPS position: 2"):
        alignment.align(model, positions, None)
