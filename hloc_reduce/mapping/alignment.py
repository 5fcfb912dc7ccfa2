"""Align a model with GPS positions: metres east, north and up.

GPS is off by metres, which moves a small place, scales it and turns it. So an alignment is used
only if the positions determine it, by their own residuals. If they do not tell the tilt, as those
on a line, the upright cameras do.
"""

from collections.abc import Callable, Iterator, Mapping
from itertools import combinations
from math import comb
from typing import NamedTuple

import numpy as np
import pycolmap

from ..localization.frame import METRES, Frame
from ..utils import colmap
from ..utils.cli import InputError
from .gravity import Gravity

FEWEST = 3  # positions
DISTINCT = 0.02  # metres: positions that are nearer are the same
# Photos that are farther from their GPS positions than this, in metres or as a share of the extent
# (maps of long streets bend), contradict the others; and so do those that are farther than these
# standard deviations of the others, but not nearer ones than this in metres.
GROSS, GROSS_SHARE = 10.0, 0.02
OUTLYING, NEAR = 5.0, 0.5
MAX_SCALE_ERROR = 0.05  # of distances in the map
MAX_TURN = 3.0  # degrees, around the axis that positions tell least
CONFIDENCE = 0.95  # of these two
MEDIANS = {2: 1.177, 3: 1.538}  # of the norms of two or three normal numbers
MAX_SAMPLES, ROUNDS = 500, 10


class NotAligned(InputError):
    """Positions do not tell the frame of a map, or contradict each other."""


class _NoTilt(NotAligned):
    """Positions do not tell how a map is tilted, but may tell the rest."""


class Alignment(NamedTuple):
    """A similarity to a frame in metres.

    Args:
        metric_from_map: the similarity.
        frame: the frame.
        residuals: distance of each photo from its GPS position, in metres, by name; horizontal if
            the upright cameras told the tilt.
        wrong: the photos whose positions contradict the others, and were ignored.
        scale_error: half of the 95 % confidence interval of the scale, as a share of it.
    """

    metric_from_map: pycolmap.Sim3d
    frame: Frame
    residuals: dict[str, float]
    wrong: list[str]
    scale_error: float


def align(
    model: pycolmap.Reconstruction,
    positions: Mapping[str, np.ndarray],
    gravity: Gravity | None,
) -> Alignment:
    """Align a model with the GPS positions of its photos.

    Args:
        model: the model, which is not changed.
        positions: (3,) latitude, longitude and altitude of each photo by name, see `gps.position`;
            those of photos that are not in the model are ignored.
        gravity: which way is up in the model, if its cameras tell.

    Raises:
        NotAligned: if the positions do not determine the alignment, or are not credible.
    """
    images = [model.images[i] for i in sorted(model.reg_image_ids())]
    of_frames: dict[int, pycolmap.Image] = {}  # photos of a frame have one position
    for image in images:
        if image.name in positions:
            of_frames.setdefault(image.frame_id, image)
    images = [*of_frames.values()]
    check_number([image.name for image in images])
    source = np.array([image.projection_center() for image in images])
    given = np.array([positions[image.name] for image in images])
    origin = _origin(given)
    target = colmap.enu_from_ellipsoid(np.nan_to_num(given), np.nan_to_num(origin))
    if len(np.unique(np.rint(target[:, :2] / DISTINCT), axis=0)) < FEWEST:
        raise NotAligned(f"The photos have fewer than {FEWEST} different GPS positions.")
    target[np.isnan(given[:, 2]), 2] = np.nan
    problems: list[NotAligned] = []
    for way in WAYS if gravity else WAYS[:1]:
        try:
            found = _solve(way, source, target, gravity)
        except NotAligned as problem:
            problems.append(problem)
            continue
        names = [image.name for image, used in zip(images, found.used, strict=True) if used]
        return Alignment(
            found.metric_from_map,
            Frame(METRES, way.told_by, tuple(origin.tolist())),
            dict(zip(names, found.distances.tolist(), strict=True)),
            [name for name, fits in zip(names, found.fitting, strict=True) if not fits],
            found.scale_error,
        )
    told = problems[-1] if isinstance(problems[0], _NoTilt) else problems[0]
    if isinstance(told, _NoTilt):
        raise NotAligned(f"{told} Nor do the cameras, which do not agree on which way is up.")
    raise told


def check_number(names: list[str]) -> None:
    """Raise a NotAligned unless there are enough photos, with these names, with positions."""
    if len(names) < FEWEST:
        which = f" ({', '.join(names)})" * bool(names)
        raise NotAligned(
            f"Photos of the map with a GPS position: {len(names)}{which}. At least {FEWEST} are "
            "needed."
        )


def _origin(given: np.ndarray) -> np.ndarray:
    """Return the position (3,) near the centre, with an altitude if there is any."""
    has_altitude = ~np.isnan(given[:, 2])
    known = given[has_altitude] if has_altitude.any() else given
    points = colmap.enu_from_ellipsoid(np.nan_to_num(known), np.nan_to_num(known[0]))[:, :2]
    return known[np.argmin(np.linalg.norm(points - np.median(points, axis=0), axis=1))]


def fit_similarity(source: np.ndarray, target: np.ndarray) -> pycolmap.Sim3d:
    """Fit a similarity to points (N, 3) by least squares (Umeyama).

    Unlike COLMAP's, it may be of points in a plane.
    """
    centre, true_centre = source.mean(axis=0), target.mean(axis=0)
    source, target = source - centre, target - true_centre
    u, s, vt = np.linalg.svd(target.T @ source)
    signs = np.array([1, 1, np.linalg.det(u @ vt)])
    scale = (s * signs).sum() / max((source**2).sum(), 1e-300)
    return _similarity(scale, (u * signs) @ vt, centre, true_centre)


def fit_level(source: np.ndarray, target: np.ndarray) -> pycolmap.Sim3d:
    """Fit a similarity that keeps z up to points (N, 3), whose altitudes only shift them."""
    centre, true_centre = source.mean(axis=0), target.mean(axis=0)
    plane, true_plane = (
        points[:, 0] + 1j * points[:, 1] for points in (source - centre, target - true_centre)
    )
    factor = np.vdot(plane, true_plane) / max(np.vdot(plane, plane).real, 1e-300)
    scale, yaw = abs(factor), np.angle(factor)
    turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    heights = (target - scale * source)[:, 2]
    known = heights[~np.isnan(heights)]
    true_centre[2] = scale * centre[2] + (np.median(known) if len(known) else 0)
    return _similarity(scale, turn, centre, true_centre)


def _similarity(
    scale: float, turn: np.ndarray, centre: np.ndarray, true_centre: np.ndarray
) -> pycolmap.Sim3d:
    shift = true_centre - scale * turn @ centre
    return pycolmap.Sim3d(scale, pycolmap.Rotation3d(turn), shift)


class _Way(NamedTuple):
    """A way to align: what tells the frame, a fit, its coordinates and its parameters."""

    told_by: tuple[str, ...]
    fit: Callable[[np.ndarray, np.ndarray], pycolmap.Sim3d]
    dims: int
    freedom: int


WAYS = (_Way(("gps",), fit_similarity, 3, 7), _Way(("gps", "gravity"), fit_level, 2, 4))


class _Solution(NamedTuple):
    metric_from_map: pycolmap.Sim3d
    used: np.ndarray  # (N,) bool
    distances: np.ndarray  # (M,) metres, of those used
    fitting: np.ndarray  # (M,) bool
    scale_error: float


def _solve(way: _Way, source: np.ndarray, target: np.ndarray, gravity: Gravity | None) -> _Solution:
    """Align positions (N, 3) in the map with others in metres.

    Raises:
        NotAligned: see `align`.
    """
    level = pycolmap.Sim3d()
    if gravity is not None and "gravity" in way.told_by:
        level = pycolmap.Sim3d(1.0, gravity.level(), np.zeros(3))
    used = ~np.isnan(target[:, : way.dims]).any(axis=1)
    if used.sum() < FEWEST:
        raise _NoTilt("The GPS positions have no altitudes, so they do not tell the tilt.")
    source, target = apply(level, source[used]), target[used]
    fitting = _agreeing(way, source, target)
    if fitting.sum() < FEWEST or 2 * fitting.sum() <= len(fitting):
        raise NotAligned(
            f"Most GPS positions contradict each other or the map: only {fitting.sum()} of "
            f"{len(fitting)} agree."
        )
    fit = way.fit(source[fitting], target[fitting])
    moved = apply(fit, source)
    scale_error = _check(way, moved[fitting], target[fitting])
    distances = _distances(way, moved, target)
    return _Solution(fit * level, used, distances, fitting, scale_error)


def apply(similarity: pycolmap.Sim3d, points: np.ndarray) -> np.ndarray:
    """Return moved points (N, 3) float64."""
    turn = similarity.rotation.matrix()
    return similarity.scale * points @ turn.T + similarity.translation


def _distances(way: _Way, moved: np.ndarray, target: np.ndarray) -> np.ndarray:
    return np.linalg.norm((moved - target)[:, : way.dims], axis=1)


def _agreeing(way: _Way, source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return which points (N,) bool agree on a similarity: RANSAC, then by their own deviation."""
    plane = target[:, :2]
    extent = 2 * np.median(np.linalg.norm(plane - np.median(plane, axis=0), axis=1))
    gross = max(GROSS, GROSS_SHARE * extent)

    def measure(rows: np.ndarray) -> np.ndarray:
        return _distances(way, apply(way.fit(source[rows], target[rows]), source), target)

    def cost(rows: np.ndarray) -> float:
        return float(np.minimum(measure(rows), gross).sum())

    size = -(-way.freedom // way.dims)
    best = min(_samples(len(source), size), key=cost)
    fitting = measure(best) <= gross
    for _ in range(ROUNDS):
        if fitting.sum() < FEWEST:
            break
        distances = measure(np.flatnonzero(fitting))
        spare = fitting.sum() - size
        few = 1 + 5 / spare if spare else np.inf  # Rousseeuw's correction for few points
        deviation = few * np.median(distances[fitting]) / MEDIANS[way.dims]
        before, fitting = fitting, distances <= np.clip(OUTLYING * deviation, NEAR, gross)
        if np.array_equal(before, fitting):
            break
    return fitting


def _samples(number: int, size: int) -> Iterator[np.ndarray]:
    """Yield all points, and samples of them: all of a size, or `MAX_SAMPLES` random ones."""
    yield np.arange(number)
    if comb(number, size) <= MAX_SAMPLES:
        yield from map(np.array, combinations(range(number), size))
        return
    generator = np.random.default_rng(0)
    for _ in range(MAX_SAMPLES):
        yield generator.choice(number, size, replace=False)


def _check(way: _Way, moved: np.ndarray, target: np.ndarray) -> float:
    """Return half of the confidence interval of the scale, as a share.

    Raises:
        NotAligned: if the scale, or a turn, is not determined.
    """
    from scipy.stats import t

    errors, inside = (moved - target)[:, : way.dims], (moved - moved.mean(axis=0))[:, : way.dims]
    left = errors.size - way.freedom
    deviation = np.sqrt((errors**2).sum() / left)
    half = deviation * t.ppf(0.5 + CONFIDENCE / 2, left)
    squares = (inside**2).sum()
    scale_error = half / np.sqrt(squares) if squares > 0 else np.inf
    if not scale_error <= MAX_SCALE_ERROR:
        raise NotAligned(
            f"The GPS positions are too inexact for this place: they differ from the map by about "
            f"{deviation:.2g} m in each coordinate, so that distances may be wrong by "
            f"{100 * scale_error:.0f} % (at most {100 * MAX_SCALE_ERROR:.0f} % are accepted)."
        )
    if way.dims == 3:
        least = np.linalg.eigvalsh(squares * np.eye(3) - inside.T @ inside)[0]
        if not half <= np.deg2rad(MAX_TURN) * np.sqrt(max(least, 0.0)):
            raise _NoTilt("The GPS positions, nearly on a line, do not tell the tilt.")
    return float(scale_error)
