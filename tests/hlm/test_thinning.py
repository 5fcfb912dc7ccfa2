"""Which images a small map keeps."""

import numpy as np

from hloc_reduce.hlm.points import Points
from hloc_reduce.hlm.thinning import thinned


def shown_in(visible, number):
    names = [f"{i}.jpg" for i in range(len(visible))]
    visible = [np.array(part, np.int32) for part in visible]
    return Points(np.zeros((number, 3)), np.ones((number, 2)), names, visible, visible, number)


def test_images_that_show_what_others_show_are_left_out():
    """Two places, each with an image that shows all of it, and images of parts of that."""
    points = shown_in([[0, 1], range(6), [2, 3, 4], [6, 7], [], range(6, 10), [8, 9]], 10)
    found = thinned(points, 2)
    assert found.names == ["1.jpg", "5.jpg"]
    assert np.concatenate(found.visible).tolist() == [*range(10)]
    assert np.concatenate(found.keypoints).tolist() == [*range(10)]
    assert len(found) == len(points)


def test_each_place_keeps_an_image_before_one_keeps_two():
    many = [np.arange(start, start + 4) for start in (0, 1, 2, 3, 4)]
    found = thinned(shown_in([*many, [20, 21]], 22), 2)
    assert found.names == ["2.jpg", "5.jpg"]


def test_all_images_stay_if_they_may():
    points = shown_in([[0], [0]], 1)
    assert thinned(points, 2) is points and len(thinned(points, 1).names) == 1
