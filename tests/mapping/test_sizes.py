"""Cameras of a model whose photos have another size."""

import pycolmap
import pytest

from hloc_reduce.mapping import sizes
from hloc_reduce.utils import cli, colmap

BEFORE = (640, 480)


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
    sizes.scale_cameras(model, named(found))
    camera = model.cameras[7]
    assert (camera.width, camera.height) == after
    x, y = after[0] / BEFORE[0], after[1] / BEFORE[1]
    assert camera.params == pytest.approx([500 * x, 510 * y, 320 * x, 240 * y])


@pytest.mark.fault(11)
@pytest.mark.parametrize(
    ("found", "number", "reason"),
    [
        ([(480, 640)] * 3, 3, "0.jpg (480x640, its camera 640x480: turned by 90 degrees), 1.jpg"),
        ([(240, 320)] * 3, 3, "turned by 90 degrees"),
        ([BEFORE, (480, 640), BEFORE], 1, "model: 1.jpg (480x640"),
        ([BEFORE, BEFORE, (320, 240)], 1, "2.jpg (320x240, its camera 640x480: resized, unlike"),
        ([(320, 240), (160, 120), (320, 240)], 3, "resized, unlike others of the same camera"),
        ([(320, 200)] * 3, 3, "cropped"),
        ([(640, 470), BEFORE, BEFORE], 1, "0.jpg (640x470, its camera 640x480: cropped"),
    ],
)
def test_photos_that_do_not_fit_are_named(found, number, reason):
    model = model_of(3)
    with pytest.raises(cli.InputError) as refusal:
        sizes.scale_cameras(model, named(found))
    assert f"{number} of 3 photos" in str(refusal.value) and reason in str(refusal.value)
    assert model.cameras[7].params.tolist() == [500, 510, 320, 240]
