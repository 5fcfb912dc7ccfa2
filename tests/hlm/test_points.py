"""What a compact map keeps of points, images and retrieval: in few bits, and exact enough."""

from pathlib import Path

import h5py
import numpy as np
import pycolmap
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from row_of_photos import row
from small_map import build

from hloc_reduce.hlm import images, names, points, visible
from hloc_reduce.hlm.signs import Signs, columns, hadamard, pack
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.parsers import check_names


def on_grid(xyz, step):
    """Return the grid of coordinates, and these as they are read from a file."""
    grid = points.Grid.of(xyz.min(axis=0), xyz.max(axis=0), step)
    packed = np.concatenate([grid.pack(xyz[part]) for part in points.parts(len(xyz))])
    assert len(packed) == grid.nbytes(len(xyz))
    padded = np.append(packed, np.zeros(points.PADDING, np.uint8))
    return grid, points.Coordinates(padded, len(xyz), grid)


@given(
    arrays.arrays(
        np.float64, st.tuples(st.integers(1, 40), st.just(3)), elements=st.floats(-1e6, 1e6)
    ),
    st.floats(1e-6, 10),
)
@settings(deadline=None)
def test_coordinates_are_within_half_a_step(xyz, step):
    grid, coordinates = on_grid(xyz, step)
    restored = coordinates.all()
    rows = np.arange(len(xyz))[::-2]
    assert np.array_equal(coordinates[rows], restored[rows])
    assert np.abs(restored - xyz).max() <= 0.5001 * grid.step + 1e-9 * np.abs(xyz).max()
    assert grid.step == pytest.approx(step, rel=5e-3) or np.ptp(xyz, axis=0).max() / step > 2**30


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
    grid, coordinates = on_grid(everything.xyz, points.precision(everything, model))
    restored = coordinates.all()
    assert np.abs(restored - everything.xyz).max() <= 0.5001 * grid.step
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
    whole = on_grid(xyz, 0.01)[1].all()
    monkeypatch.setattr(points, "POINTS_PER_CHUNK", 16)
    assert len(points.parts(100)) == 7
    assert np.array_equal(whole, on_grid(xyz, 0.01)[1].all())


@given(st.sets(st.integers(0, 40_000), max_size=30) | st.sets(st.integers(900, 1000)))
@settings(deadline=None)
def test_visible_points_survive(chosen):
    shown = np.array(sorted(chosen), np.int64)
    packed = np.frombuffer(visible.pack(shown), np.uint8)
    for number in (40_001, max(chosen, default=0) + 1):
        assert visible.unpack(packed, number).tolist() == shown.tolist()
    if chosen:
        with pytest.raises(ValueError, match="do not exist"):
            visible.unpack(packed, max(chosen))


def test_the_shorter_way_is_taken():
    assert visible.pack(np.arange(60, 90, 2)) == bytes([121, 0xAA, 0xAA, 0xAA, 0x0A])
    many = 69_995
    expected = [10, 0x80 | (many & 127), 0x80 | (many >> 7 & 127), many >> 14]
    assert visible.pack(np.array([5, 70_000])) == bytes(expected)


def test_points_of_an_image_are_close_together():
    """Along a walk, each image shows some points in a row, but images and points are shuffled."""
    generator = np.random.default_rng(0)
    number, shuffled = 300, generator.permutation(300)
    shown = [np.sort(shuffled[start : start + 20]) for start in generator.permutation(280)]
    names = [f"{i}.jpg" for i in range(len(shown))]
    xyz = np.arange(number * 3.0).reshape(-1, 3)
    walk = points.Points(xyz, xyz, names, shown, shown, np.ones(number))
    ordered = points.Sorted(walk)
    for i, own in enumerate(shown):
        found = ordered.visible(i)
        assert found[-1] - found[0] < 25
        np.testing.assert_array_equal(ordered.xyz(slice(None))[found].sum(0), xyz[own].sum(0))


def test_points_of_places_without_common_images_and_of_few_images():
    for shown in ([[0, 2], [0, 2], [1, 3], [1, 3], []], [[0, 1, 2, 3]], 4 * [[0, 1, 2, 3]]):
        names = [f"{i}.jpg" for i in range(len(shown))]
        shown = [np.array(part, np.int64) for part in shown]
        xyz = np.arange(12.0).reshape(-1, 3)
        ordered = points.Sorted(points.Points(xyz, xyz, names, shown, shown, np.ones(4)))
        assert sorted(ordered.xyz(slice(None))[:, 0]) == [0, 3, 6, 9]
        for i, own in enumerate(shown):
            found = ordered.visible(i)
            assert not len(own) or found[-1] - found[0] == len(own) - 1


@given(st.sets(st.text("ab/\n\tä" + chr(700), min_size=1, max_size=9), min_size=1))
def test_names_survive(chosen):
    listed = sorted(name for name in chosen if is_name(name))
    found = names.Names(names.pack(listed), len(listed), Path("a.hlm")) if listed else []
    assert list(found) == listed == [found[i] for i in range(len(listed))]
    for i, name in enumerate(listed):
        assert found.row(name) == i and name in found
    for name in ("", "a" * 5000, "zz", chr(0xD800)):
        assert not listed or (name in found) == (name in listed)


def is_name(name):
    try:
        return bool(check_names([name], "here"))
    except InputError:
        return False


def test_names_take_few_bytes_and_few_are_read():
    listed = [f"photos/2024/camera_{i:05d}.jpg" for i in range(5000)]
    packed = names.pack(listed)
    assert len(packed) < 9 * len(listed)
    found = names.Names(packed, len(listed), Path("a.hlm"))
    assert found.row(listed[4321]) == 4321
    assert found._names.cache_info().misses == 1


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
    return descriptors, Signs(columns(pack(descriptors)[0]), number)


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
    of_model = images.Images.of(model)
    least = of_model.centers.min(axis=0) - [30, 0, 5]
    packed, step = of_model.pack(least, np.zeros(len(of_model.names)))
    table = packed.view(images.ROW)[:, 0]
    assert np.abs(least + step * table["center"] - of_model.centers).max() < 1e-6
    quaternions = images.rotations(table)
    cosines = np.abs((quaternions * of_model.rotations).sum(axis=1))
    np.testing.assert_allclose(cosines, 1, atol=1e-12)


@given(
    arrays.arrays(np.float64, 4, elements=st.floats(-1, 1)).filter(
        lambda q: np.linalg.norm(q) > 1e-3
    )
)
def test_any_rotation_is_kept(quaternion):
    """Also half turns."""
    unit = quaternion / np.linalg.norm(quaternion)
    one = images.Images(["a"], unit[None], np.zeros((1, 3)), [], np.zeros(1, int))
    packed, _ = one.pack(np.zeros(3), np.zeros(1))
    [found] = images.rotations(packed.view(images.ROW)[:, 0])
    assert min(np.abs(found - unit).max(), np.abs(found + unit).max()) < 2e-9
