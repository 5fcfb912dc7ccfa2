"""Pictures of single surfaces, against projections by pycolmap itself."""

import numpy as np
import pycolmap
import pytest

from hloc_reduce.demo.cameras import look
from hloc_reduce.demo.render import SUPERSAMPLING, Light, Scene, downsample, rasterize, render
from hloc_reduce.demo.surface import Surface, Texture, View

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
