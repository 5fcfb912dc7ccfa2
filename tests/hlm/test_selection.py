"""Small maps keep the points that fix the poses of photos like their images."""

from dataclasses import replace

import h5py
import numpy as np
import pytest
from row_of_photos import row

from hloc_reduce.hlm import selection
from hloc_reduce.hlm.points import Points

IMAGES = 6


def points_of(xyz, shown):
    """Return points (P, 3), of which each image of `row` shows some."""
    descriptors, norms = np.ones((len(xyz), 4), np.float32) / 2, np.ones(len(xyz), np.float32)
    names = [f"{i}.jpg" for i in range(IMAGES)]
    visible = [np.array(sorted(part), np.int64) for part in shown]
    return Points(np.asarray(xyz, float), descriptors, names, visible, visible, norms)


def rank(xyz, shown, reliability=None):
    points = points_of(xyz, shown)
    reliability = np.ones(len(xyz)) if reliability is None else reliability
    return selection.Sights(points, row({})[0], reliability).ranked()


@pytest.fixture
def cloud():
    return np.random.default_rng(1).uniform(-1, 1, (60, 3))


def test_points_on_one_spot_come_after_points_that_fix_the_pose(cloud):
    cloud[10:] = [0.3, 0.2, 0] + cloud[10:] / 1000
    ranking = rank(cloud, [range(60)] * IMAGES)
    assert len(set(ranking[:10]) & set(range(10))) >= 8


def test_every_image_gets_points(cloud):
    """The last image shares no point with the others, which share 50."""
    ranking = rank(cloud, [*[range(50)] * (IMAGES - 1), range(50, 60)])
    assert len(set(ranking[:15]) & set(range(50, 60))) >= 3  # fix a pose


def test_shared_and_reliable_points_come_first(cloud):
    """Point p + 30 is where point p is."""
    cloud[30:] = cloud[:30]
    shared = rank(cloud, [range(60), *[range(30)] * (IMAGES - 1)])
    place = np.argsort(shared)
    assert (place[:30] < place[30:]).mean() > 0.9 and (shared[:10] < 30).all()
    reliability = np.repeat([0.9, 0.3], 30)
    reliable = rank(cloud, [range(60)] * IMAGES, reliability)
    assert (reliable[:10] < 30).all()


def test_all_points_are_ranked_once_and_always_the_same(cloud, monkeypatch):
    """Also if few gains are computed at once, and with points that no image shows: the last."""
    shown = [range(i, i + 40) for i in range(IMAGES)]
    ranking = rank(cloud, shown)
    assert np.array_equal(np.sort(ranking), np.arange(60)) and set(ranking[45:]) == {*range(45, 60)}
    monkeypatch.setattr(selection, "SPARE", 0)
    monkeypatch.setattr(selection, "POINTS_PER_CHUNK", 7)
    assert np.array_equal(rank(cloud, shown), ranking)
    sights = selection.Sights(points_of(cloud, shown), row({})[0], np.ones(60))
    assert np.array_equal(sights.ranked(17), ranking[:17])


def test_images_learn_from_the_points_that_they_share_with_the_one_they_are_matched_with(cloud):
    """The first three show other points than the last three."""
    points = points_of(cloud, [range(30)] * 3 + [range(30, 60)] * 3)
    sights = selection.Sights(points, row({})[0], np.ones(60))
    everything, itself = np.arange(60), np.arange(IMAGES)
    learned = sights.learned(everything, itself)
    assert np.array_equal(learned, sights.learned(everything, np.array([1, 2, 0, 5, 3, 4])))
    nothing = sights.learned(everything[:0], itself)
    np.testing.assert_allclose(nothing, 12 * np.log(1 / selection.UNKNOWN))
    with_first = sights.learned(everything, np.zeros(IMAGES, int))
    assert np.array_equal(with_first, np.append(learned[:3], nothing[3:]))
    fewer = sights.learned(everything[::2], itself)
    assert (nothing < fewer).all() and (fewer < learned).all()


def test_points_like_other_keypoints_are_unreliable(tmp_path):
    """In each of six images, 1 and 2 are about alike, the others are not; three show point 3."""
    generator, alike = np.random.default_rng(0), np.eye(8)[[0, 1, 1, 2, 3, 4]]
    sums = np.zeros((4, 8), np.float32)
    shown = [range(4 if i % 2 else 3) for i in range(IMAGES)]
    with h5py.File(tmp_path / "features.h5", "w") as file:
        for i, part in enumerate(shown):
            described = alike + generator.normal(0, 0.05, alike.shape)
            described /= np.linalg.norm(described, axis=1, keepdims=True)
            file[f"{i}.jpg/descriptors"] = described.T.astype(np.float32)
            sums[list(part)] += described[list(part)]
    norms = np.linalg.norm(sums, axis=1)
    points = points_of(np.zeros((4, 3)), shown)
    points = replace(points, descriptors=sums / norms[:, None], norms=norms)
    found = selection.reliabilities(points, tmp_path / "features.h5")
    assert 0.75 < found[0] < 6 / 7 and 0.65 < found[3] < 3 / 4 and max(found[1:3]) < 0.4
