"""Whether to trust a pose: every limit of the verdict, and the verdict on what `measures` tells."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated, NamedTuple

import numpy as np
import pycolmap

from ..utils.cli import InputError, choose
from ..utils.options import Option
from .measures import INDEPENDENT, Alternative, Measures, Uncertainty

FOCAL_LENGTHS = 0.3, 5.0  # range of estimated ones, in longer sides: 11 to 180 mm on 35 mm film
# that of fisheyes whose image of 180 degrees fills half of the longer side
SHORTEST_OF_FISHEYES = 0.15
PERSPECTIVE = "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV"
REFINED = 2.0  # factor by which a focal length from EXIF data may change
LISTED = 0.1, 50.0  # range of listed focal lengths, in longer sides
# distances of the principal point from the centre, as shares of the size
OFF_CENTRE, CENTRED = 0.15, 0.02
ZOOMED = 1.05  # times the map's focal lengths: beyond, a photo may be cropped and enlarged


class Tolerance(NamedTuple):
    """How far apart two poses may be that count as one, or how uncertain one may be.

    Args:
        position: in units of the inliers' median depth.
        rotation: in degrees.
    """

    position: float
    rotation: float


SAME_POSE = Tolerance(0.06, 2.4)  # a focal length 5 % off, as many listed ones are, moves it by 5 %
RIVALS = Tolerance(0.25, 10.0)  # of poses by other matches
# standard deviations of a pose; one error in ten is more than 1.9 times as large
PRECISE = Tolerance(0.03, 2.0)
CROPPED = Tolerance(0.15, 2.0)  # with unknown intrinsics, of a photo that may be cropped
# another focal length does not contradict that of a map's own lens if it moves the pose by fewer
# standard deviations: photos of a flat scene hardly tell one, and errors of the map decide
WITHIN_DEVIATIONS = 1.5

# ratios of the confidences of two poses
AS_LIKELY, LIKELIER, MUCH_LIKELIER = 0.8, 1.0, 1.1
STRETCHED = (
    "it may be cropped or stretched: another principal point and aspect ratio fit about as well, "
    "and the pose differs; known intrinsics would help"
)


class Limit(NamedTuple):
    """When another pose makes one doubtful: it is nearly as likely, and differs.

    Args:
        ratio: of both confidences, above which it is.
        found: how the other pose is found, in words.
        reason: the message; {detail:.0f} is that of the `Alternative`, {inliers} of the pose.
        tolerance: beyond it, the poses differ.
    """

    ratio: float
    found: str
    reason: str
    tolerance: Tolerance = SAME_POSE


ALTERNATIVES = {
    # with a skew, which no lens has
    "skew": Limit(
        LIKELIER,
        "a skew, which no lens has",
        "it may be warped, or a photo of a picture: a skew fits better",
    ),
    # for given intrinsics
    "focal_length": Limit(
        LIKELIER,
        "another focal length than the given one",
        "its intrinsics contradict the map: other ones, as a focal length of {detail:.0f} pixels, "
        "fit better, and the pose differs",
    ),
    "principal_point": Limit(
        MUCH_LIKELIER,
        "another principal point and aspect ratio than the given ones",
        "its intrinsics contradict the map: another principal point and aspect ratio fit much "
        "better, and the pose differs",
    ),
    # for those of a lens of the map's photos that may have taken it
    "lens_by_size": Limit(
        AS_LIKELY,
        "other parameters than those of the map's lens for its size",
        "another lens than that of the map's photos of its size may have taken it: other "
        "parameters fit about as well, and the pose differs; known intrinsics would help",
    ),
    "lens": Limit(
        AS_LIKELY,
        "another of the map's lenses for its size",
        "another lens of the map's photos of its size fits about as well, and the pose differs; "
        "known intrinsics would help",
    ),
    # for estimated ones: with another principal point and aspect ratio, of a photo that may be
    # cropped and of another one; and with the map's lens
    "cropped": Limit(
        AS_LIKELY, "another principal point and aspect ratio, if it may be cropped", STRETCHED
    ),
    "stretched": Limit(LIKELIER, "the same, if it is not cropped", STRETCHED),
    "typical_lens": Limit(AS_LIKELY, "the map's typical lens", STRETCHED),
    # by other matches; right poses of a statue on a symmetric pedestal have rivals of up to 0.46
    "rival": Limit(
        0.5,
        "other matches (a rival)",
        "ambiguous: another pose has {detail:.0f} inliers, this one {inliers}",
        RIVALS,
    ),
    # by other images that do not see those of the pose, as on another floor; of their inliers
    "other_images": Limit(
        AS_LIKELY,
        "other images, as of another floor",
        "ambiguous: a pose by other images has {detail:.0f} inliers, this one {inliers}",
        RIVALS,
    ),
}


class Evidence(NamedTuple):
    """What speaks for the matches of a pose: the larger, the better.

    Args:
        log10_confidence: the decimal logarithm of `Measures.confidence`, of at most MOST_TELLING.
        agreement: see `measures.agreement`.
    """

    log10_confidence: float
    agreement: float


class MatchKind(NamedTuple):
    """What depends on the kind of the matches.

    Args:
        weights: of the evidence. With the bias, the weighted sum is the log odds of a right pose,
            as opposed to one of a photo that does not belong, if both are as frequent.
        bias: the constant term.
        default_min_probability: the least of a pose that is trusted. With a strict ratio test,
            wrong poses at copies of repeated structures may come near it. Without, right poses in
            the dark have less; wrong ones of mirrored photos, which have more, are refuted by
            `max_mirrored`. Of the matches of LightGlue, which filters them, more agree: in 98 % of
            the right poses 0.77 or more, in wrong ones of mirrored photos up to 0.88.
        max_mirrored: the largest confidence of the mirror image, as a share of its own. Right poses
            by networks on symmetric facades have up to 0.73. Wrong ones of seven mirrored photos of
            a castle by SIFT have 0.47 to 0.97.
    """

    weights: Evidence
    bias: float
    default_min_probability: float
    max_mirrored: float


MOST_TELLING = 20.0  # confidence: more does not count
BEST = Evidence(float(np.log10(MOST_TELLING)), 1.0)
STRICT = 0.8  # the largest ratio of a strict ratio test
FEW = 32  # dimensions of descriptors: with fewer, fewer matches are right
# with a strict ratio test, also of few dimensions, and without; and of LightGlue; weights and
# biases by `python -m benchmarks.fit_gate`
MATCH_KINDS = {
    "ratio": MatchKind(Evidence(4.03, 18.08), -17.74, 0.8, 0.4),
    "few": MatchKind(Evidence(2.72, 14.71), -8.2, 0.8, 0.4),
    "mutual": MatchKind(Evidence(3.81, 11.87), -8.71, 0.3, 0.8),
    "lightglue": MatchKind(Evidence(4.4, 27.51), -26.96, 0.5, 0.8),
}
NEAREST_NEIGHBOR = "nearest_neighbor"  # whose kind its ratio test tells
KINDS_OF_MATCHERS = {"adalam": "mutual", "lightglue": "lightglue", "superglue": "lightglue"}
# probability from which on mirror images are not tried; the wrong pose of a mirrored photo of a
# castle has 0.986
SURE = 0.99


@dataclass(frozen=True)
class Gate:
    """What a pose must have for the query to be called localized.

    Args:
        min_confidence: minimum confidence of a localized query: -log10 of the number of poses with
            as many inliers that are expected by chance.
        min_inliers: minimum number of RANSAC's inliers of a localized query.
        min_probability: minimum probability of a localized query, see `gate.probability`; default:
            0.8 with a strict ratio test, 0.5 for LightGlue, else 0.3.
        match_kind: what the limits are for: mutual nearest neighbours with a strict ratio test,
            the same with few dimensions, or without; or those of LightGlue; default: the matcher's.

    Raises:
        InputError: for a confidence that is not finite, a negative number of inliers, a probability
            that is none, or an unknown kind.
    """

    min_confidence: float = 8.0
    min_inliers: int = 8
    min_probability: float | None = None
    match_kind: Annotated[str, Option("match_kind", MATCH_KINDS)] | None = None

    def __post_init__(self) -> None:
        if not 0 <= self.min_confidence < np.inf:
            raise InputError(
                f"min_confidence is {self.min_confidence}: it must be finite and at least 0."
            )
        if self.min_inliers < 0:
            raise InputError(f"min_inliers is {self.min_inliers}: at least 0.")
        if self.match_kind is not None:
            choose("match_kind", self.match_kind, MATCH_KINDS)
        if self.min_probability is not None and not 0 <= self.min_probability <= 1:
            raise InputError(f"min_probability is {self.min_probability}: from 0 to 1.")

    def of_matches(self, matcher: dict, dim: int) -> "Gate":
        """Return the gate for a matcher and descriptors, unless its kind of matches is given.

        Args:
            matcher: configuration of the matcher's model, which may have a `match_kind`.
            dim: dimension of the descriptors.

        Raises:
            InputError: for a matcher without limits.
        """
        name = matcher.get("name", NEAREST_NEIGHBOR)
        if self.match_kind is not None:
            return self
        if name != NEAREST_NEIGHBOR:
            kind = matcher.get("match_kind", KINDS_OF_MATCHERS.get(name))
            if kind is None:
                raise InputError(
                    f"The matcher {name} has no limits for trusting poses: add `match_kind` to the "
                    f"model in its configuration, or give --match_kind, {' or '.join(MATCH_KINDS)}."
                )
            return replace(self, match_kind=kind)
        if (matcher.get("ratio_threshold") or 1) > STRICT:
            return replace(self, match_kind="mutual")
        return replace(self, match_kind="few" if dim < FEW else "ratio")

    @property
    def kind(self) -> MatchKind:
        """What depends on the kind of the matches."""
        return MATCH_KINDS[self.match_kind or "mutual"]

    @property
    def least_probability(self) -> float:
        """The minimum probability of a localized query."""
        given = self.min_probability
        return self.kind.default_min_probability if given is None else given


DEFAULT_GATE = Gate()


def evidence(measures: Measures) -> Evidence:
    """Return what speaks for the matches of a pose."""
    telling = min(max(1.0, measures.confidence), MOST_TELLING)
    return Evidence(float(np.log10(telling)), measures.agreement)


def probability(measures: Measures, gate: Gate) -> float:
    """Return the probability that the matches of a pose are right, if half of all poses' are.

    It does not tell whether the intrinsics are right, nor how precise the pose is: other rules do.
    """
    log_odds = np.dot(gate.kind.weights, evidence(measures)) + gate.kind.bias
    return float(1 / (1 + np.exp(-log_odds)))


def refusal(measures: Measures, gate: Gate) -> str | None:
    """Return why a pose is not trusted, None if it is."""
    return next((reason for rule in RULES if (reason := rule.refusal(measures, gate))), None)


def verdict(measures: Measures, gate: Gate) -> dict:
    """Return the `reason` why a pose is not trusted, its `probability`, and its `measures`."""
    found = round(probability(measures, gate), 3)
    return {"reason": refusal(measures, gate), "probability": found, "measures": measures}


def may_be_mirrored(measures: Measures, gate: Gate) -> bool:
    """Return whether the mirror image of a photo, whose pose is trusted, is to be tried.

    Photos of a calibrated camera are not mirrored.
    """
    return not measures.is_camera_given and probability(measures, gate) < SURE


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


def _another_pose(measures: Measures, _: Gate) -> str | None:
    for kind, limit in ALTERNATIVES.items():
        other = measures.alternatives.get(kind)
        if other and is_doubtful(kind, other):
            return limit.reason.format(detail=other.detail, inliers=measures.num_inliers)
    return None


def _imprecise(measures: Measures, _: Gate) -> str | None:
    limits = [(measures.uncertainty, PRECISE, "the inliers do not fix the pose: its")]
    if measures.may_be_cropped:
        reason = "it may be cropped, and without its intrinsics its"
        limits.append((measures.uncropped, CROPPED, reason))
    elif measures.off_centre > OFF_CENTRE:
        reason = "its principal point is far from the centre, and without its intrinsics its"
        limits.append((measures.uncropped, CROPPED, reason))
    for found, most, reason in limits:
        hint = "; known intrinsics would help" if measures.is_focal_length_free else ""
        if found.position > most.position or found.rotation > most.rotation:
            return (
                f"{reason} position is uncertain by {_up_to(100, 100 * found.position)} % of the "
                f"distance (at most {100 * most.position:.0f} %), its rotation by "
                f"{_up_to(180, found.rotation)} degrees (at most {most.rotation:.0f}){hint}"
            )
    return None


def _improbable(measures: Measures, gate: Gate) -> str | None:
    found = probability(measures, gate)
    if found >= gate.least_probability:
        return None
    lacking = np.subtract(BEST, evidence(measures)) * gate.kind.weights
    confidence, agreement = _down(measures.confidence, 1), _down(measures.agreement, 2)
    reason = (
        f"its confidence of {confidence} is low"
        if lacking[0] > lacking[1]
        else f"too few matches of any image agree with the pose: agreement {agreement}"
    )
    least = f"at least {gate.least_probability:g} is needed"
    return f"{reason} (probability {_down(found, 2)}, {least})"


def _mirrored(measures: Measures, gate: Gate) -> str | None:
    most = gate.kind.max_mirrored * measures.confidence
    if measures.mirror_image is None or measures.mirror_image <= most:
        return None
    return (
        f"it may be mirrored: the confidence is {measures.confidence:.1f}, that of its mirror "
        f"image {measures.mirror_image:.1f}"
    )


class Rule(NamedTuple):
    """What a pose must have.

    Args:
        refusal: returns why a pose does not have it, None if it does.
        text: completes "a pose must".
        limit: in words.
        parts: further lines of the table: what is meant, and its limit.
    """

    refusal: Callable[[Measures, Gate], str | None]
    text: str
    limit: str
    parts: tuple[tuple[str, str], ...] = ()


def _words(most: Tolerance) -> str:
    return f"{100 * most.position:g} % of the distance to the scene, {most.rotation:g}°"


RULES = (
    Rule(
        _no_lens,
        "have a focal length that lenses have, if it is listed",
        f"{LISTED[0]:g} to {LISTED[1]:g} longer sides",
    ),
    Rule(_few_inliers, "have inliers", f"{DEFAULT_GATE.min_inliers} (`--min_inliers`)"),
    Rule(
        _chance,
        "be unlikely by chance: `confidence`, -log10 of how many poses as good are expected if all "
        "matches are wrong",
        f"{DEFAULT_GATE.min_confidence:g} (`--min_confidence`)",
    ),
    Rule(
        _implausible_focal_length,
        "have a plausible focal length, if it is estimated",
        f"{FOCAL_LENGTHS[0]:g} to {FOCAL_LENGTHS[1]:g} longer sides, or within a factor of "
        f"{REFINED:g} of EXIF data",
    ),
    Rule(
        _swapped,
        "have a listed principal point in the order x, y",
        f"refused if more than {200 * CENTRED:g} % of the size off the centre, but less than "
        f"{100 * CENTRED:g} % with x and y swapped",
    ),
    Rule(
        _another_pose,
        "not be contradicted by another pose",
        f"another is farther away than {_words(SAME_POSE)} ({_words(RIVALS)} by other matches or "
        "images), and has more than a share of its confidence:",
        tuple((f"... by {one.found}", f"{100 * one.ratio:g} %") for one in ALTERNATIVES.values()),
    ),
    Rule(
        _imprecise,
        "be fixed by its inliers even without the keypoint that tells most; at most "
        f"{INDEPENDENT} keypoints count, because neighbours err alike",
        f"standard deviations, and moves without it, of at most {_words(PRECISE)}",
        (
            (
                "... also with all intrinsics free, if the photo may be cropped or its listed "
                f"principal point is more than {100 * OFF_CENTRE:g} % of the size off the centre",
                _words(CROPPED),
            ),
        ),
    ),
    Rule(
        _improbable,
        "come from the right matches: `probability`, computed from its confidence and its "
        "`agreement`, the largest share of a map image's matches that are inliers, less a standard "
        "deviation",
        f"{MATCH_KINDS['ratio'].default_min_probability:g} with a strict ratio test, "
        f"{MATCH_KINDS['lightglue'].default_min_probability:g} for LightGlue, else "
        f"{MATCH_KINDS['mutual'].default_min_probability:g} (`--min_probability`)",
    ),
    Rule(
        _mirrored,
        f"fit much better than its mirror image, if its probability is below {SURE:g} and its "
        "intrinsics are not given",
        f"the mirror image has at most {100 * MATCH_KINDS['ratio'].max_mirrored:g} % of its "
        "confidence with a strict ratio test, else "
        f"{100 * MATCH_KINDS['mutual'].max_mirrored:g} %",
    ),
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
    explained = WITHIN_DEVIATIONS * uncertainty.position, WITHIN_DEVIATIONS * uncertainty.rotation
    return not differ(other, Tolerance(*explained))


def is_determined(uncropped: Uncertainty) -> bool:
    """Return whether inliers determine a pose although all intrinsics are unknown."""
    return uncropped.position <= CROPPED.position and uncropped.rotation <= CROPPED.rotation


def _up_to(most: float, value: float) -> str:
    """Round up to tenths: what is above a limit is not to be printed as the limit."""
    return f"{np.ceil(10 * value) / 10:.1f}" if value < most else f"at least {most:.0f}"


def _down(value: float, digits: int) -> str:
    """Round down: what is below a limit is not to be printed as the limit."""
    return f"{np.floor(value * 10**digits) / 10**digits:.{digits}f}"


def focal_lengths(camera: pycolmap.Camera, guessed: bool) -> tuple[float, float]:
    """Return the range of plausible focal lengths in pixels.

    Args:
        camera: intrinsics before the estimation.
        guessed: their focal length is unknown rather than approximate.
    """
    size, given = max(camera.width, camera.height), camera.mean_focal_length()
    low, high = FOCAL_LENGTHS
    low = low if camera.model.name in PERSPECTIVE else SHORTEST_OF_FISHEYES
    return (low * size, high * size) if guessed else (given / REFINED, given * REFINED)
