"""Which images a small map keeps."""

import numpy as np
import pytest
from row_of_photos import row

from hloc_reduce.hlm.points import Points
from hloc_reduce.hlm.selection import Sights
from hloc_reduce.hlm.thinning import ordered, shares_of, thinned

PARTS = {"header": 100, "poses": 600, "retrieval": 600, "names": 0}
PARTS |= {"coordinates": 240, "descriptors": 240, "visible": 0}


def shown_in(visible, number):
    names = [f"{i}.jpg" for i in range(len(visible))]
    visible = [np.array(part, np.int32) for part in visible]
    xyz = np.random.default_rng(1).uniform(-1, 1, (number, 3))
    return Points(xyz, np.ones((number, 2)), names, visible, visible, np.ones(number))


def first(number, visible):
    """Return the first images of those that show some points, ascending."""
    points = shown_in(visible, 1 + max(max(part, default=0) for part in visible))
    return sorted(ordered(shares_of(points))[:number].tolist())


def test_images_that_show_what_others_show_are_last():
    """Two places, each with an image that shows all of it, and images of parts of that."""
    visible = [[0, 1], range(6), [2, 3, 4], [6, 7], [], range(6, 10), [8, 9]]
    assert first(2, visible) == [1, 5]
    assert first(7, visible) == [*range(7)]


def test_each_place_has_an_image_before_one_has_two():
    many = [np.arange(start, start + 4) for start in (0, 1, 2, 3, 4)]
    assert first(2, [*many, [20, 21]]) == [2, 5]


def kept(visible, limit, parts=PARTS):
    points = shown_in(visible, 60)
    sights = Sights(points, row({})[0], np.ones(60))
    found = thinned(sights, sights.ranked(), parts, limit)
    assert len(found) == 60
    return found


@pytest.mark.parametrize("limit", [500, 900, 1700])
def test_images_of_the_same_points_make_room_for_points(limit):
    found = kept([range(60)] * 6, limit)
    assert len(found.names) == 1 and found.visible[0].tolist() == [*range(60)]


def test_images_of_other_points_all_stay():
    """A photo like one that is left out could not be localized."""
    parts = PARTS | {"coordinates": 2400}
    found = kept([range(10 * i, 10 * i + 10) for i in range(6)], 3000, parts)
    assert len(found.names) == 6
    assert [part.tolist() for part in found.keypoints] == [part.tolist() for part in found.visible]
