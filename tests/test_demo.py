import copy
import dataclasses
import json
import os

import numpy as np
import pycolmap
import pytest

from hloc_reduce import demo
from hloc_reduce.demo import cameras, town
from hloc_reduce.demo.cameras import MAP, look
from hloc_reduce.demo.photo import take
from hloc_reduce.demo.render import SUPERSAMPLING, Light, Scene, downsample, rasterize, render
from hloc_reduce.demo.surface import Surface, Texture, View
from hloc_reduce.utils.cli import InputError

CAMERA = pycolmap.Camera(model="PINHOLE", width=256, height=192, params=[212, 214, 125.3, 98.1])
# Obliquely from the left and from below, rolled, as the surfaces stand in the plane y = 0.
POSE = look(np.array([-1.5, -4.5, 1.0]), 1.15, 0.15, 0.1)
WHITE = Texture(np.full((8, 8, 3), 255, np.uint8), 8)


def scene_of(texture, outline, holes=()):
    axes = np.array([(1.0, 0, 0), (0, 0, -1.0)])
    wall = Surface(np.array([-1.0, 0, 2.8]), axes, np.array(outline, float), texture, list(holes))
    sky = np.zeros((4, 4, 3), np.uint8)
    return Scene([wall], np.zeros((0, 4)), [(0.0, -0.8, 0.6)], sky, extent=5)


def photograph(scene):
    light = Light(0, np.zeros(3), np.full(3, 1.0 / 0.72), np.zeros(3))
    view = View.of(CAMERA, POSE, SUPERSAMPLING)
    return downsample(render(scene, view, light))[..., 1]


def project(points):
    """With pycolmap itself, so that a wrong convention of the renderer shows."""
    return CAMERA.img_from_cam(POSE * points)


def on_wall(plane):
    return np.column_stack([plane[:, 0] - 1, np.zeros(len(plane)), 2.8 - plane[:, 1]])


def test_a_texture_lies_where_it_projects():
    squares = np.indices((8, 8)).sum(0) % 2
    image = np.kron(squares, np.full((48, 48), 255)).astype(np.uint8)  # squares of 0.3 m
    texture = Texture(np.repeat(image[..., None], 3, axis=2), 160)
    picture = photograph(scene_of(texture, [(0, 0), (2.4, 0), (2.4, 2.4), (0, 2.4)]))
    # The same without a renderer: 8 x 8 rays for each pixel, intersected with y = 0.
    pixels = np.stack(np.meshgrid(np.arange(2048), np.arange(1536)), -1).reshape(-1, 2) / 8 + 1 / 16
    rays = np.column_stack([CAMERA.cam_from_img(pixels), np.ones(len(pixels))])
    rays, center = rays @ POSE.rotation.matrix(), POSE.inverse().translation
    points = center - rays * (center[1] / rays[:, 1:2])
    u, v = points[:, 0] + 1, 2.8 - points[:, 2]
    exact = (np.floor(u / 0.3) + np.floor(v / 0.3)) % 2 * (np.minimum(u, v) > 0)
    exact *= np.maximum(u, v) < 2.4
    exact = exact.reshape(192, 8, 256, 8).mean(axis=(1, 3))
    assert abs(shift(exact, picture)).max() < 0.01
    corners = np.stack(np.meshgrid(np.arange(1, 8), np.arange(1, 8)), -1).reshape(-1, 2) * 0.3
    for x, y in project(on_wall(corners)).astype(int):
        patch = slice(y - 6, y + 7), slice(x - 6, x + 7)
        assert np.linalg.norm(shift(exact[patch], picture[patch])) < 0.1


def shift(exact, picture):
    """How far the picture is off in x and y, in pixels, by least squares on the gradients."""
    dy, dx = np.gradient(exact)
    gradients = np.column_stack([dx.ravel(), dy.ravel()])
    return np.linalg.lstsq(gradients, (exact - picture).ravel(), rcond=None)[0]


@pytest.mark.parametrize("hole", [None, (0.5, 0.4, 1.2, 1.7)])
def test_outlines_and_holes_cover_what_they_project_to(hole):
    outline = np.array([(0, 0.7), (1.1, 0), (2.2, 0.6), (2.2, 2.1), (0, 2.3)])
    picture = photograph(scene_of(WHITE, outline, [hole] if hole else []))
    ys, xs = np.mgrid[:192, :256] + 0.5
    found = np.array([picture.sum(), (xs * picture).sum(), (ys * picture).sum()])
    expected = moments(project(on_wall(outline)))
    if hole:
        u0, v0, u1, v1 = hole
        corners = np.array([(u0, v0), (u1, v0), (u1, v1), (u0, v1)])
        expected -= moments(project(on_wall(corners)))
    assert abs(found[0] / expected[0] - 1) < 0.005
    assert np.allclose(found[1:] / found[0], expected[1:] / expected[0], atol=0.03)


def moments(polygon):
    """Area and first moments of a polygon that runs clockwise in the image."""
    (x, y), (x_next, y_next) = polygon.T, np.roll(polygon, -1, axis=0).T
    cross = x * y_next - x_next * y
    area = cross.sum() / 2
    return np.array([area, ((x + x_next) * cross).sum() / 6, ((y + y_next) * cross).sum() / 6])


def test_depth_is_exact_at_pixel_centres_and_clipped_at_the_camera():
    view = View.of(CAMERA, POSE)
    surface, nearness = rasterize(
        scene_of(WHITE, [(-50, -50), (50, -50), (50, 50), (-50, 50)]), view
    )
    rows, columns = np.nonzero(surface == 0)
    assert len(rows) > 20_000
    pixels = np.column_stack([columns + 0.5, rows + 0.5])
    rays = np.column_stack([CAMERA.cam_from_img(pixels), np.ones(len(pixels))])
    points = POSE.inverse() * (rays / nearness[rows, columns, None])
    assert abs(points[:, 1]).max() < 1e-3


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """Four houses, few and small photos, rendered by the whole pipeline."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(town, "HOUSES", town.HOUSES[:3])
        patch.setattr(demo, "list_photos", small_photos)
        town.build_town.cache_clear()
        yield demo.main(tmp_path_factory.mktemp("demo") / "town")
    town.build_town.cache_clear()


def small_photos(seed):
    photos = cameras.list_photos(seed)
    return [scaled(photo) for photo in photos[:7] + photos[-20:-18] + photos[-2:]]


def scaled(photo):
    camera = copy.deepcopy(photo.camera)
    camera.rescale(256, 192)
    return dataclasses.replace(photo, camera=camera)


def test_the_layout_is_that_of_aachen(small):
    names = {photo.name for photo in small_photos(0)}
    images = small / "images_upright"
    assert {str(p.relative_to(images)) for p in images.rglob("*") if p.is_file()} == names
    model = small / "3D-models" / "aachen_v_1_1"
    assert {p.name for p in model.iterdir()} == {"cameras.bin", "images.bin", "points3D.bin"}
    poses = (small / "queries" / "ground_truth_poses.txt").read_text().splitlines()
    for kind in ("day", "night"):
        lines = (small / "queries" / f"{kind}_time_queries_with_intrinsics.txt").read_text()
        for line in lines.splitlines():
            name, camera_model, *numbers = line.split()
            assert name in names and kind in name and camera_model == "PINHOLE"
            assert len(numbers) == 6 and len([p for p in poses if p.split()[0] == name]) == 1
    photo = small_photos(0)[-1]
    numbers = np.array([float(word) for word in poses[-1].split()[1:]])
    x, y, z, w = photo.cam_from_world.rotation.quat
    assert np.array_equal(numbers, [w, x, y, z, *photo.cam_from_world.translation])


def test_the_model_agrees_with_the_depth_buffer(small):
    model = pycolmap.Reconstruction(small / "3D-models" / "aachen_v_1_1")
    assert model.num_reg_images() == 7 and model.num_points3D() > 200
    scene = town.build_town(0)
    for image in model.images.values():
        view = View.of(image.camera, image.cam_from_world())
        _, nearness = rasterize(scene, view)
        for point2D in image.points2D:
            assert point2D.has_point3D()
            xyz = model.point3D(point2D.point3D_id).xyz
            assert np.allclose(image.project_point(xyz), point2D.xy, atol=1e-6)
            x, y = point2D.xy
            assert 0 < x < 256 and 0 < y < 192
            depth = (image.cam_from_world() * xyz)[2]
            assert depth > 0 and abs(nearness[int(y), int(x)] * depth - 1) < 0.0101
    assert all(point.track.length() >= 3 for point in model.points3D.values())


def test_an_interrupted_run_renders_only_what_is_missing(small):
    images = small / "images_upright"
    before = {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in images.rglob("*.jpg")}
    os.replace(small / "town.json", small / "town.json.partial")
    lost = [images / "db" / "0003.jpg", images / "query" / "night" / "phone" / "0008.jpg"]
    for path in lost:
        path.unlink()
    demo.main(small)
    for path, (content, time) in before.items():
        assert path.read_bytes() == content
        assert (path.stat().st_mtime_ns == time) == (path not in lost)
    assert (small / "town.json").exists() and not (small / "town.json.partial").exists()


def test_a_complete_town_is_left_alone_and_never_mixed(small, tmp_path):
    listing = {path: path.stat().st_mtime_ns for path in small.rglob("*")}
    assert demo.main(small) == small
    assert listing == {path: path.stat().st_mtime_ns for path in small.rglob("*")}
    with pytest.raises(InputError, match="seed"):
        demo.main(small, seed=1)
    (tmp_path / "3D-models").mkdir()
    with pytest.raises(InputError, match="not the demo town"):
        demo.main(tmp_path, overwrite=True)


def test_leftovers_of_another_seed_are_dropped(tmp_path):
    leftover = tmp_path / "images_upright" / "db" / "0000.jpg"
    for mark, overwrite in (("town.json.partial", False), ("town.json", True)):
        leftover.parent.mkdir(parents=True)
        leftover.touch()
        (tmp_path / mark).write_text('{"seed": 5, "version": 1}')
        state = {"seed": 0, "version": 1}
        assert demo._start(tmp_path, state, overwrite)
        assert not leftover.exists() and not (tmp_path / "town.json").exists()
        assert json.loads((tmp_path / "town.json.partial").read_text()) == state


def test_the_seed_decides_every_byte(small):
    scene, photo = town.build_town(0), small_photos(0)[2]
    content = (small / "images_upright" / photo.name).read_bytes()
    assert take(scene, photo, 0) == content
    assert take(scene, photo, 1) != content
    assert small_photos(1)[2].cam_from_world.matrix().tolist() != (
        photo.cam_from_world.matrix().tolist()
    )
    other = town.build_town.__wrapped__(1)
    assert take(other, photo, 0) != content
    again = town.build_town.__wrapped__(0)
    assert take(again, photo, 0) == content


def test_all_photos_have_their_own_names_and_kinds():
    photos = cameras.list_photos(0)
    assert len({photo.name for photo in photos}) == len(photos)
    assert 26 <= sum(photo.kind == MAP for photo in photos) <= 32
