"""Photos that are missing from a map of photos alone."""

from collections.abc import Sequence

from ...utils import cli
from ..findings import PHOTOS_NAMED, Finding
from ..registration import Registration, more_time
from .inputs import Inputs

ENOUGH_REGISTERED = 0.8  # share of the photos: if fewer are in a map, what to try is said
ONE_CAMERA = "--camera_mode single, if one camera with a fixed zoom took all photos"


def find(inputs: Inputs) -> list[Finding]:
    """Find the photos that are missing. A map with fewer than half of its photos is refused."""
    known = inputs.registration
    if known is None:
        return []
    found = []
    total = known.images + len(known.left_out)
    if 2 * known.registered < known.images:
        return [_fewer_than_half(shortfall(known), known.missing)]
    if 2 * known.registered < total:
        left_out = sorted(known.left_out)
        text = (
            f"Only {known.registered} of {total} photos are in the map. Left out: {{names}}, "
            "because they are mirrored, or their size, focal length or principal point is not that "
            "of the others. Use photos as the camera took them."
        )
        found.append(_fewer_than_half(text, left_out))
    if known.registered < ENOUGH_REGISTERED * known.images or len(known.parts) > 1:
        found.append(Finding("partial", shortfall(known), tuple(known.missing)))
    elif known.missing:
        found.append(_some_missing(known.images, known.missing))
    return found


def of_numbers(registered: int, images: int, missing: Sequence[str] = ()) -> list[Finding]:
    """Return what the numbers of images with a pose, and of all, say of a map.

    Args:
        registered: number of images with a pose.
        images: number of all images.
        missing: the other ones, if known.
    """
    if 2 * registered < images:
        text = f"Only {registered} of {images} photos are in the map."
        return [_fewer_than_half(text, missing)]
    return [_some_missing(images, missing)] if missing else []


def _some_missing(images: int, missing: Sequence[str]) -> Finding:
    text = f"{len(missing)} of {images} images are not in the map: {{names}}."
    return Finding("partial", text, tuple(missing))


def _fewer_than_half(text: str, names: Sequence[str]) -> Finding:
    doubt = "fewer than half of its photos"
    return Finding("partial", text, tuple(names), verdict="refuse", doubt=doubt)


def shortfall(known: Registration) -> str:
    """Say that images are missing, and what to try; `{names}` stands for them."""
    only = "Only " if known.registered < ENOUGH_REGISTERED * known.images else ""
    left_out, missing, parts = len(known.left_out), known.missing, known.parts
    all_names = f" (all in {known.file})" if known.file and len(missing) > PHOTOS_NAMED else ""
    said = [
        f"{only}{known.registered} of {known.images + left_out} photos are in the map.",
        f"Missing: {{names}}{all_names}.",
    ]
    if left_out:
        said.append(f"{left_out} more {'is' if left_out == 1 else 'are'} left out.")
    tries: list[str] = []
    dropped = {name for one in known.dropped for name in one.names}
    if len(parts) > 1:
        sizes = [str(len(part)) for part in parts]
        said.append(
            f"COLMAP found {len(parts)} parts that do not connect, of {', '.join(sizes[:-1])} and "
            f"{sizes[-1]} photos, and the map is the first"
            + (f"; the second has {cli.some(parts[1], 3)}." if parts[1] != missing else ".")
        )
        tries.append("add photos between the parts, each overlapping the one before by two thirds")
    elif {*missing} - {*known.unmatched} - dropped:
        tries.append("add photos between those in the map and those that are not")
    if known.unmatched:
        said.append(f"No other photo matches {cli.some(known.unmatched)}.")
        tries.append("retake blurred or dark photos")
    if tries:
        tries.append("leave out photos of other places")
    if known.alike:
        tries.append(ONE_CAMERA)
    tries += more_time(known.attempts_left_out)
    return " ".join(said) + (f" What to try: {'; '.join(tries)}." if tries else "")
