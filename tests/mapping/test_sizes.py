"""Cameras of a model whose photos have another size."""

import pycolmap
import pytest

from hloc_reduce.mapping.checks import sizes
from hloc_reduce.utils import colmap

BEFORE, HALF = (640, 480), (320, 240)


def model_of(number):
    """Return a model of photos by a camera."""
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(
        model="PINHOLE", width=640, height=480, params=[500, 510, 320, 240], camera_id=7
    )
    for i in range(number):
        image = pycolmap.Image(name=f"{i}.jpg", camera_id=7, image_id=i + 1)
        colmap.add_image(model, camera, image, pycolmap.Rigid3d())
    return model


def named(found):
    return {f"{i}.jpg": size for i, size in enumerate(found)}


@pytest.mark.fault(11)
@pytest.mark.parametrize(
    ("found", "after"),
    [
        ([BEFORE] * 3, BEFORE),
        ([(320, 240)] * 3, (320, 240)),
        ([(1280, 960)] * 3, (1280, 960)),
        ([(213, 160)] * 3, (213, 160)),  # 640 / 3 is rounded
        ([(640, 479)] * 3, (640, 479)),
        ([BEFORE, (640, 479), BEFORE], BEFORE),
        ([(320, 240), (320, 240), (321, 240)], (320, 240)),
        ([], BEFORE),
    ],
)
def test_cameras_are_scaled(found, after):
    model = model_of(3)
    resized, unfit = sizes.compare(model, named(found))
    assert not unfit
    sizes.scale_cameras(model, resized)
    camera = model.cameras[7]
    assert (camera.width, camera.height) == after
    x, y = after[0] / BEFORE[0], after[1] / BEFORE[1]
    assert camera.params == pytest.approx([500 * x, 510 * y, 320 * x, 240 * y])


@pytest.mark.fault(11)
@pytest.mark.parametrize(
    ("found", "odd", "reason"),
    [
        ([(480, 640)] * 3, [0, 1, 2], "480x640, its camera 640x480: turned by 90 degrees"),
        ([(240, 320)] * 3, [0, 1, 2], "240x320, its camera 640x480: turned by 90 degrees"),
        ([BEFORE, (480, 640), BEFORE], [1], "turned by 90 degrees"),
        ([BEFORE, BEFORE, HALF], [2], "320x240, its camera 640x480: resized or cropped, unl"),
        ([HALF, (160, 120), HALF], [1], "160x120, its camera 640x480: resized or cropped, unl"),
        ([HALF, HALF, (321, 240), (160, 120)], [3], "resized or cropped, unlike others"),
        ([HALF] * 5 + [BEFORE], [5], "640x480: not resized, unlike others of the same camera, whi"),
        ([HALF] * 2 + [(240, 320)], [2], "turned by 90 degrees"),
        ([HALF] * 2 + [BEFORE] * 2, [0, 1], "resized or cropped, unlike others"),  # undecided
        ([(640, 470)] * 2 + [BEFORE], [0, 1], "cropped, stretched, or by another camera"),
        ([(320, 200)] * 3, [0, 1, 2], "cropped, stretched, or by another camera"),
        ([(638, 480), BEFORE, BEFORE], [0], "638x480, its camera 640x480: "),
        ([(640, 470), BEFORE, BEFORE], [0], "640x470, its camera 640x480: cropped, stretched"),
    ],
)
def test_photos_that_do_not_fit_are_named(found, odd, reason):
    _, unfit = sizes.compare(model_of(len(found)), named(found))
    assert list(unfit) == [f"{number}.jpg" for number in odd]
    said = sizes.complaint(unfit)
    assert f"model: {odd[0]}.jpg (" in said and reason in said
    assert (sizes.TURN in said) == ("turned" in reason)
