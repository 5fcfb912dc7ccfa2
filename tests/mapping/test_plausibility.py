"""Which images of a model of photos alone are plausible, and what is said of the others."""

from pathlib import Path

import numpy as np
import pycolmap
import pytest

from hloc_reduce.mapping import registration
from hloc_reduce.mapping.checks import Inputs, partial
from hloc_reduce.mapping.findings import Finding, names_in
from hloc_reduce.mapping.plausibility import count_viewpoints, focal_length_spread, keep_plausible
from hloc_reduce.mapping.registration import Registration
from hloc_reduce.utils import colmap


def chain(cameras, places=None, links=()):
    """Return a model of images that see points with the next one only, of cameras by number.

    The points are 5 units in front of the images, which are at other places along a line. Two
    neighbors share 10 points, or as many as `links` says.
    """
    model = pycolmap.Reconstruction()
    for i, number in enumerate(cameras):
        camera = pycolmap.Camera(
            model="SIMPLE_PINHOLE", width=640, height=480, params=[500, 320, 240], camera_id=number
        )
        pixels = np.random.default_rng(i).uniform(0, 400, (sum(links or (20,)), 2))
        image = pycolmap.Image(name=f"{i}.jpg", keypoints=pixels, camera_id=number, image_id=i + 1)
        place = np.array([i if places is None else places[i], 0, 0])
        colmap.add_image(model, camera, image, pycolmap.Rigid3d(pycolmap.Rotation3d(), -place))
    for i in range(1, len(cameras)):
        number, before = (links[i - 1], sum(links[: i - 1])) if links else (10, 0)
        for j in range(before, before + number):
            first = j if links else 10 + j
            elements = [pycolmap.TrackElement(i, first), pycolmap.TrackElement(i + 1, j)]
            model.add_point3D(np.array([0, 0, 5]), pycolmap.Track(elements))
    given = {key: pycolmap.Camera(camera.todict()) for key, camera in model.cameras.items()}
    return model, given


def kinds(findings):
    """Return the names of the photos by kind."""
    assert all(one.verdict == "drop" for one in findings)
    return {one.kind: sorted(one.names) for one in findings}


def names_of(models):
    return [{model.images[i].name for i in model.reg_image_ids()} for model in models]


@pytest.mark.parametrize(("left", "is_kept"), [(0, False), (7, False), (8, True)])
def test_an_image_that_has_lost_its_points_has_no_pose(left, is_kept):
    """All points of one of 13 photos were outliers, and the map said that it has all of them."""
    model, given = chain([1] * 5)
    image = model.images[5]
    for index in [i for i, p in enumerate(image.points2D) if p.has_point3D()][left:]:
        model.delete_observation(5, index)
    (found,), dropped = keep_plausible([Inputs(model, cameras=given)])
    assert found.num_reg_images() == 4 + is_kept
    assert kinds(dropped) == ({} if is_kept else {"few_points": ["4.jpg"]})


def test_images_that_lose_their_points_to_such_an_image_have_no_pose_either():
    """The last of six images shares 7 points with the fifth, which shares 7 with the fourth."""
    model, given = chain([1] * 6)
    for number in (5, 6):
        points = [i for i, p in enumerate(model.images[number].points2D) if p.has_point3D()]
        shared = [i for i in points if i < 10]  # with the image before
        for index in shared[7:]:
            model.delete_observation(number, index)
    (found,), dropped = keep_plausible([Inputs(model, cameras=given)])
    assert names_of([found]) == [{f"{i}.jpg" for i in range(4)}]
    assert kinds(dropped) == {"few_points": ["4.jpg", "5.jpg"]}


@pytest.mark.parametrize(
    ("links", "dropped"),
    [
        ((300, 300, 300, 20, 25), ["4.jpg", "5.jpg"]),  # like a hinge
        ((300, 300, 300, 20, 90), []),  # more points than that
        ((80, 80, 80, 20, 25), []),  # others have few points, too
    ],
)
def test_images_that_few_points_hold_are_dropped(links, dropped):
    """Two photos of the back of a bag, 6 degrees off, had 23 and 35 points, the others 1,300."""
    model, given = chain([1] * 6, links=links)
    (found,), found_dropped = keep_plausible([Inputs(model, cameras=given)])
    assert kinds(found_dropped) == ({"few_points": dropped} if dropped else {})
    assert found.num_reg_images() == 6 - len(dropped)


@pytest.mark.parametrize(
    ("focal_length", "is_prior", "is_kept"),
    [
        (50.0, False, False),
        (-500.0, False, False),
        (1e6, False, False),
        (1500.0, False, True),
        (1500.0, True, False),
        (700.0, True, True),
    ],
)
def test_focal_lengths_that_no_lens_has(focal_length, is_prior, is_kept):
    """Of 500 pixels at first, by EXIF data or guessed."""
    model, given = chain([1, 2, 3, 4])
    for camera in given.values():
        camera.has_prior_focal_length = is_prior
    model.cameras[4].focal_length = focal_length
    found, dropped = keep_plausible([Inputs(model, cameras=given)])
    everything = {f"{i}.jpg" for i in range(4)}
    assert names_of(found) == [everything if is_kept else everything - {"3.jpg"}]
    spread = {1500.0: 3.0, 700.0: 1.4}[focal_length] if is_kept else 1.0  # of those that are kept
    assert focal_length_spread(found) == spread
    said = f"focal length {focal_length:.0f}" if focal_length > 0 else "no focal length fits"
    assert kinds(dropped) == ({} if is_kept else {"lenses": ["3.jpg"]})
    assert all(f"3.jpg ({said})" in one.message for one in dropped)


@pytest.mark.parametrize(("distortion", "is_kept"), [(-0.6, True), (4.56, False), (-5.9, False)])
def test_distortions_that_no_lens_has(distortion, is_kept):
    """Of photos of a flat wall, each with a camera of its own."""
    model, given = chain([1, 2, 3, 4])
    params = [500, 320, 240, distortion]
    model.cameras[4].model, model.cameras[4].params = "SIMPLE_RADIAL", params
    _, dropped = keep_plausible([Inputs(model, cameras=given)])
    assert kinds(dropped) == ({} if is_kept else {"lenses": ["3.jpg"]})
    assert all(f"3.jpg (distortion {distortion:.1f})" in one.message for one in dropped)


def test_what_only_an_implausible_image_connects_is_dropped():
    model, given = chain([1, 2, 3, 4, 5, 6])
    model.cameras[3].focal_length = 1e6
    found, dropped = keep_plausible([Inputs(model, cameras=given)])
    assert names_of(found) == [{"3.jpg", "4.jpg", "5.jpg"}] and names_in(dropped) == {"2.jpg"}
    model, given = chain([1, 2, 3])
    model.cameras[2].focal_length = 1e6
    assert keep_plausible([Inputs(model, cameras=given)])[0] == []


@pytest.mark.parametrize(
    ("places", "viewpoints"),
    [((0, 0.1, 2, 2.05, 2.1), 2), ((0, 0, 0, 0, 0), 1), ((0, 0.1, 2, 2.05, 4), 3)],
)
def test_bursts_from_two_viewpoints_are_no_map(places, viewpoints):
    """Nothing fixes their focal lengths, so that their poses may be wrong by 30 degrees."""
    model, given = chain([1, 2, 3, 4, 5], places)
    assert count_viewpoints(model) == viewpoints
    found, dropped = keep_plausible([Inputs(model, cameras=given)])
    assert bool(found) == (viewpoints >= 3) and not dropped


def test_a_camera_of_many_photos_is_known_better_than_by_exif():
    """As of photos that were cropped and kept their EXIF data."""
    for cameras, is_kept in (([1, 1, 1, 1], True), ([1, 1, 2, 2], False)):
        model, given = chain(cameras)
        for camera in given.values():
            camera.focal_length, camera.has_prior_focal_length = 200, True
        found, dropped = keep_plausible([Inputs(model, cameras=given)])
        assert bool(found) == is_kept and bool(dropped) != is_kept


def test_no_plausible_image_at_all_is_said():
    dropped = Finding("lenses", "No lens has these: {names}. Use the photos.", ("a.jpg",))
    message = registration.nothing(Path("photos"), [dropped])
    assert "No lens has these: a.jpg. Use the photos. What to try: take photos" in message
    assert "enough of them overlap" not in message
    assert "Do enough of them overlap?" in registration.nothing(Path("photos"))
    message = registration.nothing(Path("photos"), [], attempts_left_out=3)
    assert message.endswith("left out for lack of time: 3.")


def message_of(**changed):
    """Return what is said of the photos that are missing from a model."""
    state = {
        "images": 10,
        "parts": [["a", "b", "c", "d", "e"], ["f", "g", "h"]],
        "missing": ["f", "g", "h", "i", "j"],
        "unmatched": ["j"],
        "dropped": [],
        "alike": False,
    }
    registered = Registration(**state | changed)
    (found,) = partial.find(Inputs(None, registration=registered))
    return found.message


def test_parts_that_do_not_connect():
    message = message_of()
    assert "Only 5 of 10 photos" in message and "f, g, h, i, j." in message
    assert "2 parts that do not connect, of 5 and 3 photos" in message
    assert "the second has f, g, h." in message and "between the parts" in message
    assert "matches j." in message and "--camera_mode" not in message
    assert "; --camera_mode single, if one camera" in message_of(alike=True)


def test_photos_that_were_left_out_are_counted():
    message = message_of(images=12, missing=[*"fghijkl"], left_out=("x", "y"))
    assert "Only 5 of 14 photos" in message and "2 more are left out." in message


def test_photos_that_were_dropped_are_not_between_others():
    """What to do about them is said with them."""
    one = {"images": 4, "parts": [["a", "b", "c"]], "missing": ["d"], "unmatched": []}
    assert "What to try: add photos between those in the map" in message_of(**one)
    dropped = Finding("lenses", "No lens has these: {names}.", ("d",), verdict="drop")
    assert "What to try" not in message_of(**one, dropped=[dropped])
