"""Whether to trust a pose: every limit, and the one verdict on what `measures` tells."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated, NamedTuple

import numpy as np
import pycolmap

from ..utils.cli import InputError
from ..utils.options import HIDDEN
from .measures import Alternative, Measures, Uncertainty
from .projection import ALL

FOCAL_LENGTHS = (0.3, 5.0)  # range of estimated ones, in longer sides: 11 to 180 mm on 35 mm film
REFINED = 2.0  # factor by which a focal length from EXIF data may change
LISTED = 0.1, 50.0  # range of listed focal lengths, in longer sides
# distances of the principal point from the centre, as shares of the size
OFF_CENTRE, CENTRED = 0.15, 0.02
ZOOMED = 1.05  # times the map's focal lengths: beyond, a photo may be cropped and enlarged

MAX_POSITION = 0.05  # standard deviation of the position, in median depths of the inliers
MAX_ROTATION = 2.0  # standard deviation in degrees
# multiples of MAX_POSITION and MAX_ROTATION
PRECISE = 0.6, 1.0  # uncertainty of a pose; one error in ten is more than 1.9 times as large
ESTIMATED = 0.4, 1.0  # the same, with all intrinsics estimated
CROPPED = 3.0, 1.0  # uncertainty with unknown intrinsics, of a photo that may be cropped

# The least agreement of a pose, from a confidence on. With a ratio test, wrong poses at copies of
# repeated structures have confidences of 50 to 300. Below, there are few matches, so that the
# agreement is less certain; above, there are many more right poses in noisy scans.
Steps = tuple[tuple[float, float], ...]
AGREEMENT: Steps = ((0, 0.3),)  # of matches without a strict ratio test
AGREEMENT_NOISY: Steps = ((0, 0.17),)  # the same for photos whose noise was reduced
STRICT = 0.8  # the largest ratio of a strict test
AGREEMENT_RATIO: Steps = ((0, 0.76), (50, 0.86), (300, 0.76))  # with a strict ratio test
FEW = 32  # dimensions
AGREEMENT_FEW: Steps = ((0, 0.55), (50, 0.72), (300, 0.55))  # the same for fewer dimensions
# The largest share of its confidence that the mirror image of a right pose may have. On symmetric
# facades networks, which match without a ratio test, have up to 0.73; of mirrored photos of a
# castle, localized 90 degrees off by matches with a strict one, seven have 0.47 to 0.97.
MIRRORED, MIRRORED_RATIO = 0.8, 0.4
# agreement and confidence below which mirror images are tried. Poses of most mirrored photos have
# an agreement of at most 0.85 or a confidence of at most 125; two of a castle 0.92 and 432.
DOUBTFUL = 0.9, 500.0


class Tolerance(NamedTuple):
    """How far apart two poses may be that count as one.

    Args:
        position: in units of the inliers' median depth.
        rotation: in degrees.
    """

    position: float
    rotation: float


ALIKE = Tolerance(MAX_POSITION, MAX_ROTATION)
LISTS = Tolerance(0.06, 2.4)  # with listed and other focal lengths: many lists are 5 % off
RIVALS = Tolerance(0.25, 10.0)
# standard deviations between poses with the intrinsics of a map's own lens and with another focal
# length: photos of a flat scene hardly tell one, and errors of the map decide which fits better
UNCERTAIN = 1.5

STRETCHED = (
    "it may be cropped or stretched: another principal point and aspect ratio fit about as well, "
    "and the pose differs; known intrinsics would help"
)
CONTRADICTED = "its intrinsics contradict the map: {} fit much better, and the pose differs"


class Limit(NamedTuple):
    """When another pose makes one doubtful: it is nearly as likely, and differs.

    Args:
        ratio: of both confidences, above which it is.
        tolerance: beyond it, the poses differ.
        reason: the message; {detail:.0f} is that of the `Alternative`, {inliers} of the pose.
    """

    ratio: float
    tolerance: Tolerance
    reason: str


ALTERNATIVES = {
    # with a skew, which no lens has
    "skew": Limit(1.1, ALIKE, "it may be warped, or a photo of a picture: a skew fits much better"),
    # for given intrinsics: with other ones
    "focal_length": Limit(
        1.0,
        LISTS,
        "its intrinsics contradict the map: a focal length of {detail:.0f} pixels fits better, and "
        "the pose differs",
    ),
    "principal_point": Limit(
        1.1, LISTS, CONTRADICTED.format("another principal point and aspect ratio")
    ),
    "parameters": Limit(1.1, LISTS, CONTRADICTED.format("other parameters of its camera model")),
    # for those of a lens of the map's photos that may have taken it
    "lens_by_size": Limit(
        0.8,
        LISTS,
        "another lens than that of the map's photos of its size may have taken it: other "
        "parameters fit about as well, and the pose differs; known intrinsics would help",
    ),
    "lens": Limit(
        0.8,
        ALIKE,
        "another lens of the map's photos of its size fits about as well, and the pose differs; "
        "known intrinsics would help",
    ),
    # for estimated ones: with another principal point and aspect ratio, whose parameters cost
    # confidence, of a photo that may be cropped and of another one; and with the map's lens
    "cropped": Limit(0.8, ALIKE, STRETCHED),
    "stretched": Limit(1.05, ALIKE, STRETCHED),
    "typical_lens": Limit(0.8, ALIKE, STRETCHED),
    # by other matches
    "rival": Limit(
        0.25, RIVALS, "ambiguous: another pose has {detail:.0f} inliers, this one {inliers}"
    ),
    "other_images": Limit(
        0.8,
        RIVALS,
        "ambiguous: a pose by other images has {detail:.0f} inliers, this one {inliers}",
    ),
}
BETTER = 1.1  # ratio of confidences above which other intrinsics replace the assumed ones


@dataclass(frozen=True)
class Gate:
    """What a pose must have for the query to be called localized.

    Args:
        min_confidence: minimum confidence of a localized query: -log10 of the number of poses with
            as many inliers that are expected by chance.
        min_inliers: minimum number of RANSAC's inliers of a localized query.
        min_agreement: pairs, in ascending order, of a confidence and the minimum `agreement` of
            poses with at least this confidence; default: by the matches, see `of_matches`.
        min_agreement_noisy: the same for photos whose noise was reduced.
        max_mirrored: the maximum confidence of the mirror image, as a share of its own; default: by
            the matches.

    Raises:
        InputError: for a confidence that is not finite, or a negative number of inliers or share.
    """

    min_confidence: float = 8.0
    min_inliers: int = 8
    min_agreement: Steps | None = None
    min_agreement_noisy: Steps | None = None
    max_mirrored: Annotated[float, HIDDEN] | None = None

    def __post_init__(self) -> None:
        if not 0 <= self.min_confidence < np.inf:
            raise InputError(
                f"min_confidence is {self.min_confidence}: it must be finite and at least 0."
            )
        if self.min_inliers < 0:
            raise InputError(f"min_inliers is {self.min_inliers}: at least 0.")
        if self.max_mirrored is not None and not self.max_mirrored >= 0:
            raise InputError(f"max_mirrored is {self.max_mirrored}: at least 0.")

    def of_matches(self, matcher: dict, dim: int) -> "Gate":
        """Return the gate for a matcher and descriptors.

        Args:
            matcher: configuration of the matcher's model.
            dim: dimension of the descriptors.
        """
        is_strict = (matcher.get("ratio_threshold") or 1) <= STRICT
        gate = self
        if self.max_mirrored is None:
            gate = replace(gate, max_mirrored=MIRRORED_RATIO if is_strict else MIRRORED)
        if self.min_agreement is not None:
            return gate
        if not is_strict:
            return replace(gate, min_agreement=AGREEMENT, min_agreement_noisy=AGREEMENT_NOISY)
        return replace(gate, min_agreement=AGREEMENT_FEW if dim < FEW else AGREEMENT_RATIO)

    def of_photo(self, blur: float) -> "Gate":
        """Return the gate for a photo whose noise was reduced by a blur in pixels, 0 for none."""
        noisy = self.min_agreement_noisy
        return replace(self, min_agreement=noisy) if blur > 0 and noisy else self

    def least_agreement(self, confidence: float) -> float:
        """Return the least agreement of a pose with a confidence."""
        steps = self.min_agreement or AGREEMENT
        return next((least for start, least in reversed(steps) if confidence >= start), 0.0)


DEFAULT_GATE = Gate()


def refusal(measures: Measures, gate: Gate) -> str | None:
    """Return why a pose is not trusted, None if it is."""
    return next((reason for rule in RULES if (reason := rule(measures, gate))), None)


def _no_lens(measures: Measures, _: Gate) -> str | None:
    given = measures.given_focal_length
    low, high = LISTED
    if measures.is_focal_length_free or low <= given / measures.longer_side <= high:
        return None
    return f"no lens has its listed focal length of {given:g} pixels: is it in millimetres?"


def _few_inliers(measures: Measures, gate: Gate) -> str | None:
    if measures.num_inliers >= gate.min_inliers:
        return None
    return f"too few inliers: {measures.num_inliers}, at least {gate.min_inliers} are needed"


def _chance(measures: Measures, gate: Gate) -> str | None:
    if measures.confidence >= gate.min_confidence:
        return None
    return (
        f"{measures.num_inliers} inliers of {measures.num_matches} matches may be chance: "
        f"confidence {_down(max(0, measures.confidence), 1)}, at least {gate.min_confidence:g} is "
        "needed"
    )


def _implausible_focal_length(measures: Measures, _: Gate) -> str | None:
    found, (low, high) = measures.focal_length, measures.focal_range
    if not measures.is_focal_length_free or low <= found <= high:
        return None
    named = f"{found:.0f} pixels" if 0 < found < 100 * high else "none"
    return f"no plausible focal length: {named}, {low:.0f} to {high:.0f} were expected"


def _swapped(measures: Measures, _: Gate) -> str | None:
    if measures.off_centre_swapped < CENTRED < measures.off_centre / 2:
        return "the x and y of its listed principal point are swapped"
    return None


def _other_intrinsics(measures: Measures, _: Gate) -> str | None:
    return _doubtful(measures, lambda kind: kind not in BY_MATCHES)


def _imprecise(measures: Measures, _: Gate) -> str | None:
    limits = [
        (
            measures.uncertainty,
            ESTIMATED if measures.degrees_of_freedom == ALL else PRECISE,
            "the inliers do not fix the pose: its",
        )
    ]
    if measures.may_be_cropped:
        reason = "it may be cropped, and without its intrinsics its"
        limits.append((measures.uncropped, CROPPED, reason))
    elif measures.off_centre > OFF_CENTRE:
        reason = "its principal point is far from the centre, and without its intrinsics its"
        limits.append((measures.uncropped, CROPPED, reason))
    for found, (far, turned), reason in limits:
        hint = "; known intrinsics would help" if measures.is_focal_length_free else ""
        if found.position > far * MAX_POSITION or found.rotation > turned * MAX_ROTATION:
            return (
                f"{reason} position is uncertain by {_up_to(100, 100 * found.position)} % of the "
                f"distance (at most {100 * far * MAX_POSITION:.0f} %), its rotation by "
                f"{_up_to(180, found.rotation)} degrees (at most {turned * MAX_ROTATION:.0f}){hint}"
            )
    return None


def _no_agreement(measures: Measures, gate: Gate) -> str | None:
    least = gate.least_agreement(measures.confidence)
    if measures.agreement >= least:
        return None
    return (
        "the matches of no image agree with the pose: agreement "
        f"{_down(measures.agreement, 2)}, at least {least:g} is needed"
    )


def _ambiguous(measures: Measures, _: Gate) -> str | None:
    return _doubtful(measures, lambda kind: kind in BY_MATCHES)


def _mirrored(measures: Measures, gate: Gate) -> str | None:
    most = MIRRORED if gate.max_mirrored is None else gate.max_mirrored
    if measures.mirror_image is None or measures.mirror_image <= most * measures.confidence:
        return None
    return (
        f"it may be mirrored: the confidence is {measures.confidence:.1f}, that of its mirror "
        f"image {measures.mirror_image:.1f}"
    )


BY_MATCHES = "rival", "other_images"  # alternatives by other matches
RULES: tuple[Callable[[Measures, Gate], str | None], ...] = (
    *(_no_lens, _few_inliers, _chance, _implausible_focal_length, _swapped, _other_intrinsics),
    *(_imprecise, _no_agreement, _ambiguous, _mirrored),
)


def differ(other: Alternative, tolerance: Tolerance) -> bool:
    """Return whether a pose and an alternative differ by more than a tolerance."""
    return other.position > tolerance.position or other.rotation > tolerance.rotation


def is_doubtful(kind: str, other: Alternative) -> bool:
    """Return whether an alternative of a kind makes a pose doubtful."""
    limit = ALTERNATIVES[kind]
    return other.ratio > limit.ratio and differ(other, limit.tolerance)


def is_within(other: Alternative, uncertainty: Uncertainty) -> bool:
    """Return whether the uncertainty of a pose explains how far an alternative is."""
    explained = UNCERTAIN * uncertainty.position, UNCERTAIN * uncertainty.rotation
    return not differ(other, Tolerance(*explained))


def is_determined(uncropped: Uncertainty) -> bool:
    """Return whether inliers determine a pose although all intrinsics are unknown."""
    position, rotation = CROPPED[0] * MAX_POSITION, CROPPED[1] * MAX_ROTATION
    return uncropped.position <= position and uncropped.rotation <= rotation


def _doubtful(measures: Measures, of: Callable[[str], bool]) -> str | None:
    """Return the reason of the first alternative of some kinds that makes a pose doubtful."""
    for kind, other in measures.alternatives.items():
        if of(kind) and is_doubtful(kind, other):
            reason = ALTERNATIVES[kind].reason
            return reason.format(detail=other.detail, inliers=measures.num_inliers)
    return None


def _up_to(most: float, value: float) -> str:
    """Round up to tenths: what is above a limit is not to be printed as the limit."""
    return f"{np.ceil(10 * value) / 10:.1f}" if value < most else f"at least {most:.0f}"


def _down(value: float, digits: int) -> str:
    """Round down: what is below a limit is not to be printed as the limit."""
    return f"{np.floor(value * 10**digits) / 10**digits:.{digits}f}"


def may_be_mirrored(measures: Measures) -> bool:
    """Return whether a pose is so uncertain that that of the mirror image may be the right one."""
    return measures.agreement < DOUBTFUL[0] or measures.confidence < DOUBTFUL[1]


def focal_lengths(camera: pycolmap.Camera, guessed: bool) -> tuple[float, float]:
    """Return the range of plausible focal lengths in pixels.

    Args:
        camera: intrinsics before the estimation.
        guessed: their focal length is unknown rather than approximate.
    """
    size, given = max(camera.width, camera.height), camera.mean_focal_length()
    low, high = FOCAL_LENGTHS
    return (low * size, high * size) if guessed else (given / REFINED, given * REFINED)
