"""Photos of another size than their cameras in a model."""

from collections import Counter
from collections.abc import Mapping

import pycolmap

from ...utils import cli
from ...utils.images import stored_size
from ..adjustment import GAIN_OF_FREE, MAX_ADJUSTED_IMAGES, gain_of_free_intrinsics
from ..findings import Finding
from .inputs import Inputs

Size = tuple[int, int]  # width, height

ROUNDING = 1  # pixels by which a side of a resized photo may be off
TURNED = "turned by 90 degrees"
TURN = (
    "If EXIF data tell how photos are turned, magick mogrify -auto-orient turns the pixels of "
    "copies."
)


def find(inputs: Inputs) -> list[Finding]:
    """Find photos of another size than their cameras, unless all of a camera were resized."""
    if inputs.image_dir is None:
        return []
    known = {name: stored_size(inputs.image_dir / name) for name in inputs.names}
    _, unfit = compare(inputs.model, {name: size for name, size in known.items() if size})
    if not unfit:
        return []
    doubt = "photos of another size than their cameras"
    text = f"These photos {complaint(unfit)}."
    return [Finding("sizes", text, tuple(unfit), verdict="refuse", doubt=doubt)]


def is_resized(before: Size, after: Size) -> bool:
    """Tell whether sizes have the same ratio of width and height, up to rounding."""
    least = max((side - ROUNDING) / old for old, side in zip(before, after, strict=True))
    most = min((side + ROUNDING) / old for old, side in zip(before, after, strict=True))
    return least <= most


def size_of(camera: pycolmap.Camera) -> Size:
    """Return the width and height of a camera."""
    return camera.width, camera.height


def compare(
    model: pycolmap.Reconstruction, sizes: Mapping[str, Size]
) -> tuple[dict[int, Size], dict[str, str]]:
    """Compare the sizes of photos with those of their cameras.

    The photos of a camera have its size, or all were resized in the same way. Most tell which; if
    that is undecided, they have its size.

    Args:
        model: the model.
        sizes: (width, height) of its photos by name; others are left out.

    Returns:
        From the ids of cameras whose photos were resized to the size of these; and from the names
        of the photos that do not fit to their sizes and what happened to them, in words.
    """
    photos: dict[int, dict[str, Size]] = {}
    for image in sorted(model.images.values(), key=lambda image: image.name):
        if image.name in sizes:
            photos.setdefault(image.camera_id, {})[image.name] = sizes[image.name]
    found, unfit = {}, {}
    for camera_id, its_sizes in photos.items():
        before = size_of(model.cameras[camera_id])
        after = _most(before, Counter(its_sizes.values()))
        if after != before:
            found[camera_id] = after
        for name, size in its_sizes.items():
            if not _is_near(size, after):
                reason = _reason(before, after, size)
                unfit[name] = f"{_written(size)}, its camera {_written(before)}: {reason}"
    return found, unfit


def complaint(unfit: Mapping[str, str]) -> str:
    """Say that photos do not fit, see `compare`, and what to do; the sentence has no subject."""
    named = cli.some([f"{name} ({what})" for name, what in unfit.items()], 3)
    turn = f" {TURN}" if any(TURNED in what for what in unfit.values()) else ""
    return (
        f"do not have the size of their cameras in the model: {named}.{turn} Use the photos that "
        "the model was made from, as they were, or all of them resized in the same way"
    )


def scale_cameras(model: pycolmap.Reconstruction, found: Mapping[int, Size]) -> list[str]:
    """Scale cameras of a model, in place, to the sizes in `found`; return them in words."""
    scaled = []
    for camera_id, size in found.items():
        camera = model.cameras[camera_id]
        scaled.append(f"{camera_id} ({_written(size_of(camera))} to {_written(size)})")
        camera.rescale(*size)
    return scaled


def check_scaled(model: pycolmap.Reconstruction) -> None:
    """Check that photos fit the cameras that were scaled to them: cropped ones do not.

    Of a model of more than `MAX_ADJUSTED_IMAGES` images this is not tried.

    Args:
        model: with the points that were triangulated with these cameras.

    Raises:
        InputError: if they fit much better with other intrinsics.
    """
    if model.num_reg_images() > MAX_ADJUSTED_IMAGES:
        return
    gain = gain_of_free_intrinsics(model)
    if gain > GAIN_OF_FREE:
        raise cli.InputError(
            "The photos have another size than their cameras in the model, and do not fit the "
            f"cameras scaled to it: with other intrinsics they fit {100 * gain:.0f} % better. They "
            "were cropped rather than resized: use the photos that the model was made from."
        )


def _most(before: Size, sizes: Counter[Size]) -> Size:
    """Return the size that most photos of a camera have, of those to which it can be scaled."""

    def votes(size: Size) -> tuple[int, int, bool]:
        near = sum(number for other, number in sizes.items() if _is_near(size, other))
        return near, sizes[size], size == before

    return max((size for size in {before: 0, **sizes} if is_resized(before, size)), key=votes)


def _is_near(size: Size, other: Size) -> bool:
    """Tell whether sizes are the same up to rounding."""
    return all(abs(a - b) <= ROUNDING for a, b in zip(size, other, strict=True))


def _reason(before: Size, after: Size, size: Size) -> str:
    """Say how the size of a photo came about that does not fit a camera scaled to another size."""
    if _is_near(size, before):
        return f"not resized, unlike others of the same camera, which have {_written(after)}"
    if is_resized(before, size):
        return "resized or cropped, unlike others of the same camera"
    turned = is_resized(before, size[::-1])
    return TURNED if turned else "cropped, stretched, or by another camera"


def _written(size: Size) -> str:
    return "x".join(map(str, size))
