"""Which images are in a model of photos alone, and what to say about the others."""

from collections.abc import Collection
from pathlib import Path

from .. import logger
from ..runtime import provenance
from ..utils import cli
from ..utils.cli import InputError
from .plausibility import (
    COPY,
    DOUBTFUL,
    FEW,
    FEW_POINTS,
    FEWEST,
    HINGE,
    MISPLACED,
    SPREAD,
    VIEWPOINTS,
)

REGISTRATION = "registration.json"  # which images are in the model, and in other parts
# shares of registered images: a model with fewer is reported in detail, or refused
ENOUGH, LEAST = 0.8, 0.5
ACCEPT = "To use the map as it is, run again with --accept_partial."
NAMED = 10  # images that a message names
LENS = "lens"
# why photos were dropped; see `plausibility`
WHY = {
    LENS: (
        "These have focal lengths in pixels or distortions that no lens has, or focal lengths far "
        "from their EXIF data, so their poses would be wrong"
    ),
    MISPLACED: "Most matches of these contradict the poses that COLMAP found",
    COPY: (
        "These show another side of the place that looks the same, or a copy of it: from where "
        "COLMAP puts them, they would see many points of the others, but they match few of them"
    ),
    FEW_POINTS: (
        f"These have fewer than {FEWEST} points, or fewer than {HINGE} where most photos have more "
        "than eight times as many, so their poses are not certain"
    ),
}
# what to try
TRIES = {
    LENS: "use the photos as the camera wrote them, neither cropped nor edited",
    MISPLACED: "add photos between those in the map and those that are not",
    COPY: (
        "make a map of each side, because other photos of this one may be at the wrong side, too, "
        "or add photos all the way from one side to the other"
    ),
    FEW_POINTS: "add photos between those in the map and those that are not",
}
ONE_CAMERA = "--camera_mode single, if one camera with a fixed zoom took all photos"


class NoModelError(InputError):
    """No two images could be reconstructed."""


def check_number(image_dir: Path, number: int) -> None:
    """Raise a NoModelError for fewer images than a model has viewpoints."""
    if number < VIEWPOINTS:
        raise NoModelError(
            f"A map of photos alone needs {VIEWPOINTS} or more, from different places: {number} "
            f"{'image is' if number == 1 else 'images are'} given of {image_dir}. Fewer do not "
            "determine focal lengths. Take more photos, each overlapping the one before by two "
            "thirds, or give a COLMAP model of their poses."
        )


def nothing(
    image_dir: Path, dropped: dict[str, str] | None = None, attempts_left_out: int = 0
) -> str:
    """Say that no image could be reconstructed, and what to try."""
    why = _left_out(dropped, []) if dropped else "Do enough of them overlap?"
    tries = [TRIES[LENS]] if LENS in _kinds(dropped or {}) else []
    tries.append("take photos from several places, each overlapping the one before by two thirds")
    tries += _more_time(attempts_left_out)
    return (
        f"COLMAP could not reconstruct the images of {image_dir} from {VIEWPOINTS} viewpoints or "
        f"more. {why} What to try: {'; '.join(tries)}."
    )


def _more_time(attempts_left_out: int) -> list[str]:
    """Return what to try if attempts were left out."""
    if not attempts_left_out:
        return []
    return [
        "run again with --overwrite on a faster machine, or one that is idle, as attempts were "
        f"left out for lack of time: {attempts_left_out}"
    ]


def _kinds(dropped: dict[str, str]) -> dict[str, list[str]]:
    """Return the names of dropped images by the kind of what is implausible, sorted."""
    kinds: dict[str, list[str]] = {kind: [] for kind in WHY}
    for name, what in sorted(dropped.items()):
        kinds[what if what in WHY else LENS].append(name)
    return {kind: names for kind, names in kinds.items() if names}


def _left_out(dropped: dict[str, str], missing: list[str]) -> str:
    """Say why images were dropped; names are not repeated if all `missing` ones have one reason."""
    said = []
    for kind, names in _kinds(dropped).items():
        shown = [f"{name} ({dropped[name]})" for name in names] if kind == LENS else names
        named = "" if shown == missing else f": {cli.some(shown, NAMED)}"
        said.append(f"{WHY[kind]}{named}.")
    return " ".join(said)


def doubtful(spread: float, number: int) -> float:
    """Return the ratio of the focal lengths of some images if it is doubtful, 1 otherwise."""
    return round(spread, 2) if spread > (DOUBTFUL if number <= FEW else SPREAD) else 1.0


def warn(spread: float) -> None:
    """Warn of doubtful focal lengths, whose ratio is above 1; see `check`."""
    if spread > 1:
        logger.warning(_doubt(spread))


def _doubt(spread: float) -> str:
    """Say that the ratio of the focal lengths of some images is doubtful, and what to try."""
    return (
        "The map may be wrong: its photos have the same size, but their estimated focal lengths "
        f"differ by a factor of {spread:.2f}. If one camera with a fixed zoom took all, build it "
        "again with --camera_mode single; otherwise add photos from more viewpoints."
    )


def check(
    sfm_dir: Path,
    accept_partial: bool,
    left_out: Collection[str] = (),
    doubts: Collection[str] = (),
) -> float:
    """Report which images are missing from a model.

    Args:
        sfm_dir: folder of the model.
        accept_partial: whether it may have fewer than half of the images, focal lengths that
            differ by a factor above `SPREAD`, or `doubts`.
        left_out: images that it was not to have; they are reported elsewhere.
        doubts: further reasons why it may be wrong, in sentences.

    Returns:
        The ratio of the largest to the least focal length if one camera may have taken all images,
        and they differ so much that the model may be wrong; 1 otherwise.

    Raises:
        InputError: if it has fewer than half of the images, one camera may have taken all and
            their focal lengths differ too much, or there are doubts, unless `accept_partial`.
    """
    state = provenance.read(sfm_dir / REGISTRATION)
    missing, number, spread = state["missing"], state["images"], state.pop("spread", 1.0)
    registered = number - len(missing)
    factor = doubtful(spread, number) if state["alike"] else 1.0
    is_partial = registered < ENOUGH * number or len(state["parts"]) > 1
    if factor > SPREAD:
        doubts = [_doubt(factor), *doubts]
    accept = " ".join([*doubts, ACCEPT])
    message = shortfall(sfm_dir / REGISTRATION, **state, left_out=len(left_out))
    if not accept_partial:
        if registered < LEAST * number:
            raise InputError(f"{message} {accept}")
        if registered < LEAST * (number + len(left_out)):
            raise InputError(
                f"Only {registered} of {number + len(left_out)} photos are in the map. Left out: "
                f"{cli.some(sorted(left_out), NAMED)}, because they are mirrored, or their size, "
                "focal length or principal point is not that of the others. Use photos as the "
                f"camera took them. {accept}"
            )
    if is_partial:
        logger.warning(message)
    elif missing:
        implausible = state["implausible"]
        logger.warning(
            "%d of %d images are not in the map: %s.%s",
            *(len(missing), number, cli.some(missing, NAMED)),
            f" {_left_out(implausible, missing)}" if implausible else "",
        )
    if doubts and not accept_partial:
        raise InputError(accept)
    if state["alike"] and factor == 1 and not is_partial:
        logger.info(
            "EXIF data do not say which images share a camera, so each has its own. If one camera "
            "with a fixed zoom took all, --camera_mode single --overwrite gives better poses."
        )
    return factor


def shortfall(
    path: Path,
    images: int,
    parts: list[list[str]],
    missing: list[str],
    unmatched: list[str],
    implausible: dict[str, str],
    alike: bool,
    left_out: int = 0,
    attempts_left_out: int = 0,
) -> str:
    """Say which images are not in a model, why, and what to try.

    Args:
        path: file with all names.
        images: number of images.
        parts: the images of each part that COLMAP reconstructed, the model first.
        missing: the images that are not in the model.
        unmatched: the images without verified matches.
        implausible: from each dropped image to what is implausible about it.
        alike: each image has its own camera, but one camera may have taken all.
        left_out: number of further images that the model was not to have.
        attempts_left_out: number of attempts that were not made for lack of time.
    """
    registered = images - len(missing)
    only = "Only " if registered < ENOUGH * images else ""
    said = [
        f"{only}{registered} of {images + left_out} photos are in the map.",
        f"Missing: {cli.some(missing, NAMED)}{f' (all in {path})' * bool(missing[NAMED:])}.",
    ]
    if left_out:
        said.append(f"{left_out} more {'is' if left_out == 1 else 'are'} left out.")
    tries: list[str] = []
    if len(parts) > 1:
        sizes = [str(len(part)) for part in parts]
        said.append(
            f"COLMAP found {len(parts)} parts that do not connect, of {', '.join(sizes[:-1])} and "
            f"{sizes[-1]} photos, and the map is the first"
            + (f"; the second has {cli.some(parts[1], 3)}." if parts[1] != missing else ".")
        )
        tries.append("add photos between the parts, each overlapping the one before by two thirds")
    elif set(missing) - set(unmatched) - set(implausible):
        tries.append("add photos between those in the map and those that are not")
    if unmatched:
        said.append(f"No other photo matches {cli.some(unmatched)}.")
        tries.append("retake blurred or dark photos")
    if tries:
        tries.append("leave out photos of other places")
    if implausible:
        said.append(_left_out(implausible, missing))
        tries += [TRIES[kind] for kind in _kinds(implausible)]
    if alike:
        likely = LENS in _kinds(implausible)  # own focal lengths of photos of one camera
        tries.insert(0 if likely else len(tries), ONE_CAMERA)
    tries += _more_time(attempts_left_out)
    return f"{' '.join(said)} What to try: {'; '.join(dict.fromkeys(tries))}."
