"""Queries without a list in maps whose photos are by fisheyes and the like."""

import json

import numpy as np
import pycolmap
import pytest
from test_intrinsics import write_photo

from hloc_reduce.localization import intrinsics, lens_choice, mirrored
from hloc_reduce.localization.gate import DEFAULT_GATE, SAME_POSE
from hloc_reduce.localization.intrinsics import infer, of_cameras, refinement
from hloc_reduce.localization.lenses import is_bent, split
from hloc_reduce.localization.pose import Pose
from hloc_reduce.utils.colmap import cam_from_img

pytestmark = pytest.mark.fault(2)
WIDTH, HEIGHT = 1280, 960
POSE = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.1, 0.2, 0.04])), [0.3, 0.1, 8.0])
PHOTO = np.zeros((HEIGHT, WIDTH), np.uint8)
# their guessed poses are up to 64 % off, and called localized
BENT = {
    "OPENCV_FISHEYE": [700, 700, 640, 480, 0, 0, 0, 0],
    "RADIAL_FISHEYE": [520, 632, 477, 0.03, -0.01],
    "SIMPLE_RADIAL_FISHEYE": [520, 640, 480, 0.02],
    "THIN_PRISM_FISHEYE": [500, 500, 640, 480, -0.01, 0.002, 0, 0, 0, 0, 1e-3, 1e-3],
    "FOV": [620, 620, 640, 480, 0.8],
    "OPENCV": [700, 700, 640, 480, -0.3, 0.1, 0, 0],
    "FULL_OPENCV": [700, 700, 640, 480, -0.35, 0.15, 0, 0, -0.03, 0, 0, 0],
    "EUCM": [450, 450, 640, 480, 0.6, 1.1],
    "SIMPLE_FISHEYE": [520, 640, 480],
    "SIMPLE_DIVISION": [700, 640, 480, -0.3],
}
MILD = {
    "PINHOLE": [900, 905, 640, 480],
    "SIMPLE_RADIAL": [640, 640, 480, -0.2],
    "RADIAL": [900, 640, 480, -0.1, 0.02],
    "OPENCV": [900, 900, 640, 480, -0.1, 0.02, 0, 0],
    "OPENCV_FISHEYE": [1600, 1600, 640, 480, 0, 0, 0, 0],
    "FOV": [620, 620, 640, 480, 0.2],
}
KNOWN = pycolmap.CameraModelId.__members__  # of this version of COLMAP


def camera_of(model: str, params: list) -> pycolmap.Camera:
    return pycolmap.Camera(model=model, width=WIDTH, height=HEIGHT, params=params)


def cameras(lenses: dict[str, list]) -> list[pycolmap.Camera]:
    return [camera_of(model, params) for model, params in lenses.items() if model in KNOWN]


def named(lenses: dict[str, list]) -> list:
    return [pytest.param(camera, id=camera.model.name) for camera in cameras(lenses)]


def localize(
    camera: pycolmap.Camera,
    of_map: intrinsics.MapCameras,
    photo: np.ndarray = PHOTO,
    number: int = 150,
) -> tuple[Pose, float, float]:
    """Return the pose of a photo by a camera, with its errors: in median depths, and degrees."""
    generator = np.random.default_rng(0)
    pixels = generator.uniform([20, 20], [WIDTH - 20, HEIGHT - 20], (400, 2))
    rays = cam_from_img(camera, pixels)
    seen = np.isfinite(rays).all(axis=1) & (np.linalg.norm(rays, axis=1) < 12)
    rays = np.pad(rays[seen], ((0, 0), (0, 1)), constant_values=1)
    again = np.linalg.norm(camera.img_from_cam(rays) - pixels[seen], axis=1) < 0.01
    pixels, rays = pixels[seen][again][:number], rays[again][:number]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    points = POSE.inverse() * (rays * generator.uniform(8, 10, (len(rays), 1)))
    pixels = pixels + 0.5 * generator.standard_normal(pixels.shape)
    wrong = generator.uniform([0, 0], [WIDTH, HEIGHT], (number // 6, 2))
    pixels = np.concatenate([pixels, wrong])
    points = np.concatenate([points, generator.permutation(points)[: number // 6]])
    assumed, source = infer(photo, of_map)
    options = refinement(assumed, source, of_map)
    gate = DEFAULT_GATE.of_matches({}, 64)
    found = lens_choice.estimate(pixels, points, [np.arange(len(pixels))], assumed, options, gate)
    if found.cam_from_world is None:
        return found, np.inf, np.inf
    moved = found.cam_from_world * POSE.inverse()
    distance = np.linalg.norm(
        found.cam_from_world.inverse().translation - POSE.inverse().translation
    )
    return found, float(distance) / 9, float(np.degrees(moved.rotation.angle()))


@pytest.mark.parametrize("camera", named(BENT))
def test_a_query_of_the_size_of_photos_by_a_bent_lens_has_that_lens(camera):
    of_map = of_cameras(3 * [camera])
    assert infer(PHOTO, of_map)[1] == "lens"
    found, position, rotation = localize(camera, of_map)
    assert found.refusal is None and position < 0.005 and rotation < 0.1
    assert found.camera.params.tolist() == camera.params.tolist()


@pytest.mark.parametrize("camera", named(MILD))
def test_a_mild_lens_is_estimated_with_the_pose(camera):
    of_map = of_cameras(3 * [camera])
    assert not of_map.lenses and infer(PHOTO, of_map)[1] == "guess"
    found, position, rotation = localize(camera, of_map)
    assert found.refusal is None and position < 0.01 and rotation < 0.2


@pytest.mark.parametrize("camera", ["SIMPLE_RADIAL", "THIN_PRISM_FISHEYE"])
@pytest.mark.parametrize("of_map", ["FOV", "OPENCV", "FULL_OPENCV"])
def test_another_lens_of_the_size_is_not_localized_wrongly(of_map, camera):
    """Nor is a photo by a normal lens, which has the size by chance."""
    lens, other = camera_of(of_map, BENT[of_map]), camera_of(camera, {**MILD, **BENT}[camera])
    found, position, rotation = localize(other, of_cameras(3 * [lens]))
    is_right = position < SAME_POSE.position and rotation < SAME_POSE.rotation
    assert found.refusal is not None or is_right


def test_few_matches_do_not_tell_another_lens_of_the_size():
    """Its pose was 44 % off."""
    lens, other = (camera_of(name, BENT[name]) for name in ("OPENCV", "THIN_PRISM_FISHEYE"))
    found, position, _ = localize(lens, of_cameras(3 * [lens]), number=20)
    assert found.refusal is None and position < 0.01
    found, position, _ = localize(other, of_cameras(3 * [lens]), number=20)
    assert position > 0.2 and "another lens" in found.refusal


def test_the_likeliest_lens_of_a_size_counts():
    """Two of a stereo camera, and a normal one whose photos have the same size."""
    left = camera_of("OPENCV_FISHEYE", [500, 500, 642, 483, 0, 0, 0, 0])
    right = camera_of("OPENCV_FISHEYE", [504, 504, 620, 470, 0.003, 0, 0, 0])
    for camera in (left, right):
        found, position, rotation = localize(camera, of_cameras(3 * [left] + 4 * [right]))
        assert found.refusal is None and position < 0.005 and rotation < 0.1
        assert found.camera.params.tolist() == camera.params.tolist()
    normal = camera_of("PINHOLE", MILD["PINHOLE"])
    of_map = of_cameras(3 * [left] + 3 * [normal])
    assert infer(PHOTO, of_map)[1] == "guess"
    for camera in (left, normal):
        found, position, rotation = localize(camera, of_map)
        assert found.refusal is None and is_bent(found.camera) == (camera is left)
        assert position < 0.01 and rotation < 0.2


def test_a_query_of_another_size_is_refused_in_a_map_of_a_bent_lens():
    camera = camera_of("OPENCV_FISHEYE", BENT["OPENCV_FISHEYE"])
    for size in ((480, 640), (WIDTH, HEIGHT), (960, 1280, 3)[:2][::-1]):
        photo = np.zeros(size, np.uint8)
        assert infer(photo, of_cameras(3 * [camera]))[1] == "none"
    found, _, _ = localize(camera, of_cameras(3 * [camera]), np.zeros((480, 640), np.uint8))
    assert found.cam_from_world is None and found.num_inliers == 0
    assert found.refusal.startswith("its lens is not known") and "--queries" in found.refusal
    normal = pycolmap.Camera(model="PINHOLE", width=640, height=480, params=[500, 500, 320, 240])
    both = of_cameras(3 * [camera] + 3 * [normal])
    assert both.sizes == {(640, 480)} and {*both.lenses} == {(WIDTH, HEIGHT)}
    assert both.focal_lengths == (500 / 640, 500 / 640)  # those of guesses
    assert infer(np.zeros((480, 640), np.uint8), both)[1] == "guess"


@pytest.mark.parametrize(
    ("changed", "models", "source"),
    [
        ({}, {"Maker Phone 1"}, "lens"),
        ({}, set(), "lens"),  # the map's photos have no EXIF data
        ({"make": "Other"}, {"Maker Phone 1"}, "EXIF"),
        ({"make": "Other"}, set(), "lens"),
        ({"zoom": 2.0}, {"Maker Phone 1"}, "none"),
        ({"taken": (4000, 2250)}, {"Maker Phone 1"}, "none"),
        ({"size": (240, 180)}, {"Maker Phone 1"}, "none"),
        ({"size": (240, 180)}, set(), "EXIF"),  # a robot's map, and a phone
        ({"size": (240, 180), "make": "Other"}, {"Maker Phone 1"}, "EXIF"),
    ],
)
def test_exif_data_tell_whether_another_camera_took_a_photo(changed, models, source, tmp_path):
    lens = pycolmap.Camera(
        model="OPENCV_FISHEYE", width=480, height=360, params=[190, 190, 240, 180, 0, 0, 0, 0]
    )
    of_map = of_cameras(3 * [lens])._replace(models=models)
    write_photo(tmp_path / "new.jpg", **changed)
    assert infer(tmp_path / "new.jpg", of_map)[1] == source


def test_bent_lenses_of_a_map():
    """Alike ones count as one; those of few photos may be failed estimates."""
    params = BENT["OPENCV_FISHEYE"]
    lens = camera_of("OPENCV_FISHEYE", params)
    alike = camera_of("OPENCV_FISHEYE", [701, *params[1:]])
    unlike = camera_of("OPENCV_FISHEYE", [720, 720, *params[2:]])
    normal = camera_of("PINHOLE", MILD["PINHOLE"])
    plain, lenses = split([alike, lens, lens, unlike, *(40 * [normal])])
    assert len(plain) == 41  # with the one that took a single photo
    assert [one.params.tolist() for one in lenses[WIDTH, HEIGHT]] == [params]
    assert split([lens, normal])[1] and split([unlike, *(9 * [normal])])[1]
    assert len(split([lens, unlike])[1][WIDTH, HEIGHT]) == 2
    many = [
        camera_of("OPENCV_FISHEYE", [500 + 20 * i] * 2 + params[2:])
        for i in range(intrinsics.MOST_LENSES + 1)
    ]
    assert infer(PHOTO, of_cameras(many))[1] == "none"
    assert infer(PHOTO, of_cameras(many[1:]))[1] == "lens"


def test_a_full_circle_is_bent():
    circle = camera_of("OPENCV_FISHEYE", [300, 300, 640, 480, 0, 0, 0, 0])  # 240 degrees
    assert is_bent(circle)


def test_lenses_in_map_json():
    lens = camera_of("OPENCV_FISHEYE", BENT["OPENCV_FISHEYE"])
    told = of_cameras(3 * [lens])
    rows = json.loads(json.dumps(intrinsics.to_dict(told)))["lenses"]
    again = intrinsics.to_lenses(rows)[WIDTH, HEIGHT]
    assert [one.params.tolist() for one in again] == [lens.params.tolist()]
    with pytest.raises(ValueError):
        intrinsics.to_lenses([[*rows[0], 1]])
    before = intrinsics.MapCameras({}, {(WIDTH, HEIGHT)}, focal_lengths=(0.5, 0.6))
    known = intrinsics.with_lenses(before, 3 * [lens])  # of a map of an earlier version
    assert known.sizes == set() and [*known.lenses] == [(WIDTH, HEIGHT)]
    normal = camera_of("PINHOLE", MILD["PINHOLE"])
    assert intrinsics.with_lenses(before, 3 * [normal]) == before
    assert intrinsics.merged(before, told).lenses == told.lenses


def test_lenses_to_try_on_a_mirror_image_are_mirrored():
    left = camera_of("OPENCV_FISHEYE", [500, 500, 642, 483, 0, 0, 0, 0])
    right = camera_of("OPENCV_FISHEYE", [504, 504, 620, 470, 0.003, 0, 0, 0])
    of_map = of_cameras(3 * [left] + 2 * [right])
    options = refinement(left, "lens", of_map)
    [row] = mirrored.mirror_options(options)["photo"]["lenses"]
    assert row[5] == WIDTH - 620 and row[3:5] == [504, 504]
    assert options["photo"]["lenses"][0][5] == 620
    assert mirrored.mirror_options({"refinement": {}}) == {"refinement": {}}
