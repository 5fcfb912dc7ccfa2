"""Sides of a place that a mapper put one upon the other."""

import itertools

import numpy as np
import pycolmap
import pytest
from colmap_database import write_with_pycolmap

from hloc_reduce import check
from hloc_reduce.mapping.checks import Inputs, copies, groups
from hloc_reduce.mapping.findings import names_in
from hloc_reduce.mapping.plausibility import keep_plausible
from hloc_reduce.utils import colmap

NUMBER = 5  # photos of each side


def two_sides(common: int, turn: float = 2.0) -> pycolmap.Reconstruction:
    """Photos on an arc, of two sides with 300 points each and some common ones.

    Args:
        common: the number of points that the photos of both sides see.
        turn: degrees between the photos of one side and those of the other.
    """
    generator = np.random.default_rng(0)
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(
        model="SIMPLE_PINHOLE", width=640, height=480, params=[500, 320, 240], camera_id=1
    )
    points = generator.uniform(-1, 1, (600 + common, 3))
    side = np.repeat([0, 1, 2], [300, 300, common])  # 2 is seen from both
    for i in range(2 * NUMBER):
        angle = np.radians(8 * (i % NUMBER) + turn * (i >= NUMBER))
        rotation = pycolmap.Rotation3d(angle * np.array([0, 1, 0]))
        pose = pycolmap.Rigid3d(rotation, [0, 0, 6])
        local = points @ rotation.matrix().T + pose.translation
        image = pycolmap.Image(
            name=f"{i}.jpg", keypoints=camera.img_from_cam(local), camera_id=1, image_id=i + 1
        )
        colmap.add_image(model, camera, image, pose)
    for row, point in enumerate(points):
        shown = [i for i in range(2 * NUMBER) if side[row] in (2, i // NUMBER)]
        elements = [pycolmap.TrackElement(i + 1, row) for i in shown]
        model.add_point3D(point, pycolmap.Track(elements))
    return model


SIDES = [{f"{i}.jpg" for i in range(NUMBER)}, {f"{i + NUMBER}.jpg" for i in range(NUMBER)}]


@pytest.mark.parametrize(
    ("common", "turn", "is_found"),
    [(12, 2.0, True), (0, 2.0, True), (200, 2.0, False), (12, 120.0, False)],
)
def test_sides_that_share_too_few_points(common, turn, is_found):
    """Of photos from other directions, no common points are expected."""
    found = copies.find(Inputs(two_sides(common, turn)))
    assert names_in(found) in SIDES if is_found else found == []


def test_photos_that_were_not_matched_tell_nothing():
    """As frames of two laps: those that were matched show that they are one side, or two."""
    for common, is_found in ((0, True), (12, True), (200, False)):
        sides = two_sides(common)
        every = [*itertools.combinations(sorted(image.name for image in sides.images.values()), 2)]
        inside = [pair for pair in every if any({*pair} <= side for side in SIDES)]
        across = [pair for pair in every if pair not in inside]
        assert copies.find(Inputs(sides, matched=inside)) == []
        found = copies.find(Inputs(sides, matched=inside + across[::2]))
        assert names_in(found) in SIDES if is_found else found == []
        listed = [pair for pair in every if "9.jpg" not in pair]  # 9.jpg was added later
        assert bool(copies.find(Inputs(sides, matched=listed))) == is_found


@pytest.mark.parametrize("are_matched", [True, False])
def test_a_database_tells_which_photos_were_matched(are_matched, tmp_path):
    """Those of a pair without matches were, if the pair is listed."""
    sides = two_sides(12)
    sides.write(tmp_path)
    keypoints, shown = {}, {}
    for image in sides.images.values():
        keypoints[image.name] = np.array([point.xy for point in image.points2D])
        shown[image.name] = np.array([point.has_point3D() for point in image.points2D])
    matches = {}
    for pair in itertools.combinations(sorted(shown), 2):
        is_inside = any({*pair} <= side for side in SIDES)
        if is_inside or are_matched:
            rows = np.flatnonzero(shown[pair[0]] & shown[pair[1]] & is_inside)
            matches[pair] = (np.stack([rows, rows], axis=1),) * 2
    colmap.write_reference(tmp_path / "database.db", sides)
    colmap.write_matches(tmp_path / "database.db", keypoints, matches)
    found, _ = check.main(tmp_path, tmp_path / "database.db")
    assert bool(names_in(found, "copies")) == are_matched


def test_colmap_lists_pairs_that_have_few_matches(tmp_path):
    descriptors = np.random.default_rng(0).integers(0, 99, (3, 100, 128))
    descriptors[1] = descriptors[0]
    descriptors[2, :8] = descriptors[0, :8]
    keypoints = np.random.default_rng(1).uniform(0, 200, (100, 4))
    features = {f"{i}.jpg": (keypoints, of_image) for i, of_image in enumerate(descriptors)}
    path = write_with_pycolmap(tmp_path / "database.db", features)
    pycolmap.match_exhaustive(path)
    with colmap.open_stored(path) as database:
        assert [*database.verified()] == [("0.jpg", "1.jpg")]
        assert sorted(database.matched()) == [*itertools.combinations(sorted(features), 2)]


def test_what_is_before_a_point_hides_it():
    """A pillar passes by, in the right half of a photo: what is behind it is not expected there."""
    camera = pycolmap.Camera(
        model="SIMPLE_PINHOLE", width=640, height=480, params=[500, 320, 240], camera_id=1
    )
    pixels = np.random.default_rng(0).uniform(5, [635, 475], (400, 2))
    rays = np.pad(camera.cam_from_img(pixels), ((0, 0), (0, 1)), constant_values=1)
    is_right = pixels[:, 0] > 320
    for depth_of_pillar, is_hidden in ((3.0, True), (7.0, False)):
        wall, pillar = 9 * rays[:300], depth_of_pillar * rays[300:][is_right[300:]]
        xyz = np.concatenate([wall, pillar])
        seen = np.concatenate([~is_right[:300], np.ones(len(pillar), bool)])
        image = pycolmap.Image(name="a.jpg", camera_id=1, image_id=1)
        model = pycolmap.Reconstruction()
        colmap.add_image(model, camera, image, pycolmap.Rigid3d())
        visible = copies._visible(model.images[1], seen, xyz)
        assert visible[seen].all()
        behind = visible[:300][pixels[:300, 0] > 400]  # not at the pillar's edge
        assert not behind.any() if is_hidden else behind.all()


def test_photos_that_are_too_far_away_are_not_compared(monkeypatch):
    """What is left out expects no points, here of photos all around some near and far points."""
    model = two_sides(100, turn=120.0)
    generator = np.random.default_rng(0)
    for image in model.images.values():
        nearer = pycolmap.Rigid3d(pycolmap.Rotation3d(), [0, 0, generator.uniform(-4, 6)])
        model.frames[image.frame_id].rig_from_world = nearer * image.cam_from_world()
    images = list(model.images.values())
    expected, shared, _ = copies._count(model, images)
    assert 0 < (expected > 0).sum() < len(images) ** 2 / 2
    monkeypatch.setattr(copies, "REACH", np.inf)
    for part, whole in zip((expected, shared), copies._count(model, images), strict=False):
        assert np.array_equal(part, whole)


def test_points_are_expected_from_similar_directions_and_distances():
    model = two_sides(100, turn=30.0)
    images = list(model.images.values())
    for image in images[::3]:
        image.frame.rig_from_world = pycolmap.Rigid3d(pycolmap.Rotation3d(), [0, 0, 3]) * (
            image.cam_from_world()
        )
    ids = sorted(model.points3D)
    xyz = np.array([model.points3D[i].xyz for i in ids])
    seen = [np.isin(ids, [p.point3D_id for p in image.points2D]) for image in images]
    rays = [xyz - image.projection_center() for image in images]
    length = [np.linalg.norm(ray, axis=1) for ray in rays]
    expected = np.zeros((len(images), len(images)))
    for i, j in itertools.permutations(range(len(images)), 2):
        angle = np.degrees(np.arccos((rays[i] * rays[j]).sum(axis=1) / length[i] / length[j]))
        ratio = np.maximum(length[i] / length[j], length[j] / length[i])
        wanted = seen[i] & (angle < copies.MAX_ANGLE_DEGREES) & (ratio < copies.MAX_DISTANCE_RATIO)
        expected[i, j] = (wanted & copies._visible(images[j], seen[j], xyz)).sum()
    counted, _, _ = copies._count(model, images)
    assert 0 < (expected > 0).sum() < len(images) ** 2 - len(images)
    assert np.array_equal(counted, expected + expected.T)


def test_some_of_the_points_are_enough(monkeypatch):
    monkeypatch.setattr(copies, "MAX_TESTS", 2e4)
    assert names_in(copies.find(Inputs(two_sides(12)))) in SIDES
    assert copies.find(Inputs(two_sides(200))) == []


def test_one_side_is_left_out_of_a_map():
    """Queries of one side were localized at the other, with 691 inliers."""
    model = two_sides(12)
    given = {1: pycolmap.Camera(model.cameras[1].todict())}
    (kept,), (dropped,) = keep_plausible([Inputs(model, cameras=given)])
    names = {kept.images[i].name for i in kept.reg_image_ids()}
    assert names in SIDES and dropped.kind == "copies" and dropped.verdict == "drop"
    assert names | {*dropped.names} == SIDES[0] | SIDES[1]


def test_sides_that_are_not_joined_directly():
    """A pillar with sides A B A C: both A are one, and B and C are seen from the same places."""
    side = np.array(["A"] * 4 + ["B"] * 2 + ["C"] * 2)
    strength = {"AA": 900, "BB": 900, "CC": 900, "AB": 500, "AC": 450, "BC": 0}
    shared = np.array([[strength["".join(sorted(a + b))] for b in side] for a in side], float)
    expected = np.full_like(shared, 1000)
    for values in (shared, expected):
        np.fill_diagonal(values, 0)

    def enough(wanted, pairs, smaller):
        return smaller > 1

    assert groups.contradicting(shared, expected, copies.JOINED_SHARE, enough) == []
    found = groups.contradicting(shared, expected, copies.JOINED_SHARE, enough, copies.APART_SHARE)
    assert found in ([4, 5], [6, 7])
    shared[shared == 0] = 80  # as photos of another season
    found = groups.contradicting(shared, expected, copies.JOINED_SHARE, enough, copies.APART_SHARE)
    assert found == []


def test_few_photos_have_no_sides():
    model = two_sides(12)
    for image_id in list(model.reg_image_ids())[3:]:
        model.deregister_frame(model.images[image_id].frame_id)
    assert copies.find(Inputs(model)) == []
