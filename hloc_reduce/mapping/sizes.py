"""Cameras of a model whose photos have another size."""

from collections import Counter
from collections.abc import Mapping

import pycolmap

from .. import logger
from ..utils import cli

Size = tuple[int, int]  # width, height

ROUNDING = 1  # pixels by which a side of a resized photo may be off
TURNED = "turned by 90 degrees"
TURN = (
    "If EXIF data tell how photos are turned, magick mogrify -auto-orient turns the pixels of "
    "copies."
)


def is_resized(before: Size, after: Size) -> bool:
    """Tell whether sizes have the same ratio of width and height, up to rounding."""
    least = max((side - ROUNDING) / old for old, side in zip(before, after, strict=True))
    most = min((side + ROUNDING) / old for old, side in zip(before, after, strict=True))
    return least <= most


def size_of(camera: pycolmap.Camera) -> Size:
    """Return the width and height of a camera."""
    return camera.width, camera.height


def resized(model: pycolmap.Reconstruction, sizes: Mapping[str, Size]) -> dict[int, Size]:
    """Find the cameras of a model whose photos were all resized in the same way.

    Args:
        model: the model.
        sizes: (width, height) of its photos by name; others are left out.

    Returns:
        From the ids of these cameras to the size of their photos.

    Raises:
        InputError: if photos have another size than their cameras, and not all photos of a camera
            were resized in the same way.
    """
    photos: dict[int, dict[str, Size]] = {}
    for image in sorted(model.images.values(), key=lambda image: image.name):
        if image.name in sizes:
            photos.setdefault(image.camera_id, {})[image.name] = sizes[image.name]
    found, wrong = {}, []
    for camera_id, its_sizes in photos.items():
        before = size_of(model.cameras[camera_id])
        ((after, _),) = Counter(its_sizes.values()).most_common(1)
        alike = all(
            abs(side - other) <= ROUNDING
            for size in its_sizes.values()
            for side, other in zip(size, after, strict=True)
        )
        if not (alike and is_resized(before, after)):
            wrong += [
                f"{name} ({_written(size)}, its camera {_written(before)}: {_reason(before, size)})"
                for name, size in its_sizes.items()
                if size != before
            ]
        elif after != before:
            found[camera_id] = after
    if wrong:
        raise cli.InputError(
            f"{len(wrong)} of {len(sizes)} photos do not have the size of their cameras in the "
            f"model: {cli.some(wrong, 3)}. Use the photos that the model was made from, as they "
            "were, or all of them resized in the same way."
            + (f" {TURN}" if any(TURNED in one for one in wrong) else "")
        )
    return found


def scale_cameras(model: pycolmap.Reconstruction, sizes: Mapping[str, Size]) -> None:
    """Scale the cameras of a model, in place, whose photos were resized; see `resized`."""
    scaled = []
    for camera_id, size in resized(model, sizes).items():
        camera = model.cameras[camera_id]
        scaled.append(f"{camera_id} ({_written(size_of(camera))} to {_written(size)})")
        camera.rescale(*size)
    if scaled:
        logger.info("Cameras of the model are scaled to their photos: %s.", cli.some(scaled))


def _reason(before: Size, size: Size) -> str:
    """Say how the size of a photo came about."""
    if is_resized(before, size):
        return "resized, unlike others of the same camera"
    return TURNED if is_resized(before, size[::-1]) else "cropped, or by another camera"


def _written(size: Size) -> str:
    return "x".join(map(str, size))
