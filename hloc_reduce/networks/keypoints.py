"""Keypoints of a score map."""

import torch
from kornia.geometry.subpix import nms2d


def limit(max_keypoints: int) -> int:
    """Return a number of keypoints for kornia: one that no photo has for -1, which keeps all."""
    return max_keypoints if max_keypoints >= 0 else 1 << 30


def strongest(
    scores: torch.Tensor, radius: int, min_score: float, border: int, max_keypoints: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """Find the highest maxima of a score map.

    Args:
        scores: (H, W) float.
        radius: a maximum is above all other scores in the square of side 2 radius + 1 around it.
        min_score: lower ones are dropped.
        border: number of pixels at each border without keypoints.
        max_keypoints: how many are kept; -1 for all.

    Returns:
        Keypoints (N, 2) float x, y, and their scores (N,), highest first.
    """
    side = 2 * radius + 1
    maxima = nms2d(scores[None, None], (side, side), mask_only=True)[0, 0]
    inside = torch.zeros_like(maxima)
    inside[border : scores.shape[0] - border, border : scores.shape[1] - border] = True
    y, x = torch.nonzero(maxima & inside & (scores > min_score), as_tuple=True)
    found = scores[y, x]
    number = len(found) if max_keypoints < 0 else min(max_keypoints, len(found))
    found, order = found.topk(number)
    return torch.stack([x, y], dim=1)[order].to(scores.dtype), found
