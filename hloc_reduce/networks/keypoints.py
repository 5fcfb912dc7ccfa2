"""Keypoints of a score map."""

from functools import reduce

import torch
from torch.nn.functional import interpolate, pad

# A maximum is above its neighbors by more than this: scores of one colour differ by rounding.
MARGIN = 1e-6

Keypoints = tuple[torch.Tensor, torch.Tensor]  # x, y (N, 2), and their scores (N,)


def limit(max_keypoints: int) -> int:
    """Return a number of keypoints for kornia: one that no photo has for -1, which keeps all."""
    return max_keypoints if max_keypoints >= 0 else 1 << 30


def strongest(
    scores: torch.Tensor,
    radius: int,
    min_score: float,
    border: int,
    max_keypoints: int,
    mask: torch.Tensor | None = None,
) -> Keypoints:
    """Find the highest maxima of a score map.

    Args:
        scores: (H, W) float.
        radius: a maximum is above all other scores in the square of side 2 radius + 1 around it.
        min_score: lower ones are dropped.
        border: number of pixels at each border without keypoints, at least `radius`.
        max_keypoints: how many are kept; -1 for all.
        mask: bool, of any size, where keypoints may be; default: everywhere.

    Returns:
        Keypoints (N, 2) float x, y, and their scores (N,), highest first.
    """
    y, x = torch.nonzero(_maxima(scores, radius, min_score, border), as_tuple=True)
    y, x = y + border, x + border
    if mask is not None:
        share = interpolate(mask[None, None].float(), scores.shape, mode="area")
        kept = share[0, 0, y, x] > 0
        y, x = y[kept], x[kept]
    found = scores[y, x]
    number = len(found) if max_keypoints < 0 else min(max_keypoints, len(found))
    found, order = found.topk(number)
    return torch.stack([x, y], dim=1)[order].to(scores.dtype), found


def strongest_fixed(
    scores: torch.Tensor,
    radius: int,
    min_score: float,
    border: int,
    number: int,
    weights: torch.Tensor | None = None,
) -> Keypoints:
    """Find the keypoints of `strongest` in tensors of fixed length, which ONNX needs.

    Args:
        scores: (H, W) float.
        radius: a maximum is above all other scores in the square of side 2 radius + 1 around it.
        min_score: lower ones are dropped.
        border: number of pixels at each border without keypoints, at least `radius`.
        number: of keypoints, at least 1.
        weights: (H, W) float above 0, which the scores of maxima are multiplied by.

    Returns:
        Keypoints (number, 2) float x, y, and their scores (number,), highest first. Rows without a
        keypoint have the score -inf, and any position at which a keypoint may be.
    """
    height, width = scores.shape
    inner = slice(border, height - border), slice(border, width - border)
    weighted = scores if weights is None else scores * weights
    maxima = _maxima(scores, radius, min_score, border)
    found = torch.where(maxima, weighted[inner], -torch.inf).flatten()
    # small images have fewer pixels than rows
    highest, index = pad(found, (0, number), value=-torch.inf).topk(number)
    index, columns = index.clamp(max=found.shape[0] - 1), width - 2 * border
    y = index // columns
    return torch.stack([index - y * columns, y], dim=1).to(scores.dtype) + border, highest


def refined(keypoints: torch.Tensor, scores: torch.Tensor) -> torch.Tensor:
    """Move maxima of a score map to those of the parabolas through their neighbors.

    Args:
        keypoints: (N, 2) float x, y in whole pixels, none of them in the outermost ones.
        scores: (H, W) float.

    Returns:
        (N, 2) float x, y, each at most half a pixel away.
    """
    x, y = keypoints.long().unbind(dim=1)
    middle = scores[y, x]
    shifts = []
    for dx, dy in ((1, 0), (0, 1)):
        before, after = scores[y - dy, x - dx], scores[y + dy, x + dx]
        curvature = (2 * middle - before - after).clamp(min=1e-6)
        shifts.append((after - before) / 2 / curvature)
    return keypoints + torch.stack(shifts, dim=1).clamp(-0.5, 0.5)


def _maxima(scores: torch.Tensor, radius: int, min_score: float, border: int) -> torch.Tensor:
    """Return which scores are keypoints, (H - 2 border, W - 2 border) bool, see `strongest`."""
    height, width = scores.shape
    edge = border - radius
    around = _highest_around(scores[edge : height - edge, edge : width - edge], radius)
    inner = scores[border : height - border, border : width - border]
    return (inner > around + MARGIN) & (inner > min_score)


def _highest_around(scores: torch.Tensor, radius: int) -> torch.Tensor:
    """Return the highest score around each one (H - 2 radius, W - 2 radius), itself excluded."""
    rows = _highest(scores, 2 * radius + 1).mT
    beside = scores[radius:-radius]
    above, below = _highest(rows[:, : -radius - 1], radius), _highest(rows[:, radius + 1 :], radius)
    left, right = (
        _highest(part, radius) for part in (beside[:, : -radius - 1], beside[:, radius + 1 :])
    )
    return torch.maximum(torch.maximum(above, below).mT, torch.maximum(left, right))


def _highest(scores: torch.Tensor, number: int) -> torch.Tensor:
    """Return the highest one of each number of successive scores of a row (H, W - number + 1)."""
    width = scores.shape[1] - number + 1
    return reduce(torch.maximum, (scores[:, i : i + width] for i in range(number)))
