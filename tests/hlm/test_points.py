"""What a compact map keeps of points, images and retrieval: in few bits, and exact enough."""

import h5py
import numpy as np
import pycolmap
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from row_of_photos import row
from small_map import build

from hloc_reduce.hlm import points, writer
from hloc_reduce.hlm.reader import rotation_of
from hloc_reduce.hlm.signs import Signs, hadamard, pack


@given(
    arrays.arrays(
        np.float64, st.tuples(st.integers(1, 40), st.just(3)), elements=st.floats(-1e6, 1e6)
    ),
    st.floats(1e-6, 10),
)
@settings(deadline=None)
def test_coordinates_are_within_half_a_step(xyz, step):
    packed, least, used, bits = points.quantize(xyz, step)
    coordinates = points.Coordinates(packed, len(xyz), least, used, bits)
    restored = coordinates.all()
    rows = np.arange(len(xyz))[::-2]
    assert np.array_equal(coordinates[rows], restored[rows])
    assert np.abs(restored - xyz).max() <= 0.5001 * used + 1e-9 * np.abs(xyz).max()
    assert len(packed) == -(-len(xyz) * sum(bits) // 8)
    assert used == step or np.ptp(xyz, axis=0).max() / step > 2**31


def test_coordinates_move_less_than_is_said(scene):
    """By half a step; in images, 98 % of them by less than a tenth of the reprojection error."""
    generator = np.random.default_rng(0)
    with h5py.File(scene.features, "a") as file:
        for name in scene.seen:
            file[name]["keypoints"][...] += generator.normal(0, 0.5, (300, 2)).astype(np.float32)
    build(scene)
    model, everything = scene.map, points.collect(scene.map, scene.features)
    error = model.compute_mean_reprojection_error()
    assert len(everything) > 200 and 0.3 < error < 1
    packed, least, step, bits = points.quantize(everything.xyz, points.precision(everything, model))
    restored = points.Coordinates(packed, len(everything), least, step, bits).all()
    assert np.abs(restored - everything.xyz).max() <= 0.5001 * step
    moved = []
    for name, rows in zip(everything.names, everything.visible, strict=True):
        image = model.find_image_with_name(name)
        before, after = (
            image.camera.img_from_cam(image.cam_from_world() * xyz[rows])
            for xyz in (everything.xyz, restored)
        )
        moved.extend(np.linalg.norm(before - after, axis=1))
    assert np.quantile(moved, 0.98) < error / 10 and max(moved) < error / 5
    assert np.median(moved) > error / 50  # no more bits than that needs


def test_coordinates_of_many_points_are_packed_in_parts(monkeypatch):
    xyz = np.random.default_rng(0).uniform(-5, 90, (100, 3))
    whole = points.quantize(xyz, 0.01)
    monkeypatch.setattr(points, "POINTS_PER_CHUNK", 16)
    parts = points.quantize(xyz, 0.01)
    assert np.array_equal(whole[0], parts[0])
    every = [points.Coordinates(packed, 100, *rest).all() for packed, *rest in (whole, parts)]
    assert np.array_equal(*every)


@given(st.lists(st.sets(st.integers(0, 40_000), max_size=30), min_size=1, max_size=5))
@settings(deadline=None)
def test_visible_points_survive(chosen):
    for number in (40_001, max([i for part in chosen for i in part], default=0) + 1):
        visible = [np.array(sorted(part), np.int64) for part in chosen]
        packed, kind = points.pack_visible(visible, number)
        counts = np.array([len(part) for part in visible])
        found = points.Visible(packed, kind, counts, number)
        assert len(found) == len(visible)
        assert [found[i].tolist() for i in range(len(found))] == [part.tolist() for part in visible]


def test_the_shorter_way_is_taken():
    dense, sparse = [np.arange(0, 800, 2)], [np.array([5, 70_000])]
    assert points.pack_visible(dense, 800)[1] == "bitmaps"
    packed, kind = points.pack_visible(sparse, 70_001)
    assert kind == "deltas" and packed.tolist() == [
        6,
        0x80 | (69_995 & 127),
        0x80 | (69_995 >> 7 & 127),
        69_995 >> 14,
    ]


def test_hadamard_is_its_own_inverse():
    rows = np.random.default_rng(0).standard_normal((3, 12)).astype(np.float32)
    there = hadamard(rows, 12)
    assert there.shape == (3, 16)
    np.testing.assert_allclose(there @ there.T, 16 * rows @ rows.T, rtol=1e-4)
    np.testing.assert_allclose(hadamard(there, 12)[:, :12] / 16, rows, atol=1e-5)


def signed(number):
    """Return ten descriptors of a number of dimensions, and their signs."""
    descriptors = np.random.default_rng(0).standard_normal((10, number)).astype(np.float32)
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    return descriptors, Signs(pack(descriptors)[0], number)


@pytest.mark.parametrize("number", [3, 12, 1024, 3000])
def test_signs_retrieve_as_the_descriptors_that_they_tell(number):
    descriptors, found = signed(number)
    products = descriptors @ found.descriptors().T
    for query, expected in zip(descriptors, products, strict=True):
        np.testing.assert_allclose(found.similarity(query), expected, atol=1e-5)


@pytest.mark.parametrize("number", [12, 1024, 3000])
def test_a_descriptor_finds_its_signs(number):
    descriptors, found = signed(number)
    assert [found.similarity(query).argmax() for query in descriptors] == list(range(10))


def test_images_far_from_the_origin_stay_where_they_are():
    """As in projected coordinates; rounded rotations moved them by up to 0.6 m."""
    model, *_ = row({1: 20.0, 4: -15.0})
    model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), [450_000.0, 5_400_000.0, 400.0]))
    names = sorted(image.name for image in model.images.values())
    nothing = points.Points(np.zeros((0, 3)), np.zeros((0, 4)), names, [], [], np.zeros(0))
    tensors: dict[str, np.ndarray] = {}
    writer._add_images(tensors, {}, nothing, model)
    for i, name in enumerate(names):
        rotation = rotation_of(tensors["rotations"][i])
        pose = pycolmap.Rigid3d(rotation, tensors["translations"][i])
        moved = model.find_image_with_name(name).projection_center() - pose.inverse().translation
        assert np.linalg.norm(moved) < 1e-6
