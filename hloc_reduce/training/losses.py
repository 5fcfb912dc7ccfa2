"""Losses of the schemes."""

import torch
from torch.nn.functional import cross_entropy

NEVER = -1e4  # similarity of what is not compared
DUPLICATE_DISTANCE = 0.008  # nearer descriptors count as the same patch, as in HardNet


def triplet_loss(anchors: torch.Tensor, positives: torch.Tensor, margin: float) -> torch.Tensor:
    """Compute the triplet margin loss of Eq. 5 with HardNet's hardest-in-batch negatives.

    Args:
        anchors: (N, D) of unit norm.
        positives: (N, D) of unit norm, row i matching anchor i only.
        margin: m.

    Returns:
        The mean over i of max(0, m + d(a_i, p_i) - d(a_i, n_i)), a scalar, where d(a_i, n_i) is
        the least distance of anchor i or positive i to a row of the other side other than i.
    """
    distances = (2 - 2 * anchors @ positives.T).clamp(min=1e-8).sqrt()
    positive = distances.diagonal()
    same = torch.eye(len(anchors), dtype=torch.bool, device=anchors.device)
    others = distances.masked_fill(same | (distances < DUPLICATE_DISTANCE), torch.inf)
    negative = torch.minimum(others.amin(dim=0), others.amin(dim=1))
    return (margin + positive - negative).clamp(min=0).mean()


def contrastive_loss(
    anchors: torch.Tensor,
    positives: torch.Tensor,
    temperature: float,
    compared: torch.Tensor | None = None,
) -> torch.Tensor:
    """Compute InfoNCE (van den Oord et al., 2018) in both directions, with all rows as negatives.

    Args:
        anchors: (N, D) or (B, N, D) of unit norm; B sets that are not compared with each other.
        positives: the same, row i matching anchor i only.
        temperature: by which cosines are divided; the lower, the more the nearest rows count.
        compared: (B, N, N) bool, symmetric: which rows are negatives of which. A row that is not
            compared with itself does not count. Default: all are.

    Returns:
        The mean cross entropy of finding positive i from anchor i, and the reverse, a scalar.
    """
    similarities = anchors @ positives.mT / temperature
    number = similarities.shape[-1]
    if compared is None:
        compared = torch.ones_like(similarities, dtype=torch.bool)
    similarities = similarities.masked_fill(~compared, NEVER)
    counts = compared.diagonal(dim1=-2, dim2=-1)
    right = torch.arange(number, device=anchors.device).expand(counts.shape)[counts]
    there, back = (cross_entropy(rows[counts], right) for rows in (similarities, similarities.mT))
    return (there + back) / 2


def distance_loss(descriptors: torch.Tensor, embedded: torch.Tensor) -> torch.Tensor:
    """Measure how much a projection changes the distances between descriptors (Eq. 2).

    Args:
        descriptors: (N, 128) of unit norm.
        embedded: (N, D) of unit norm, their projections.

    Returns:
        sqrt(sum over i, j != i of (d(x_i, x_j) - d(y_i, y_j))^2) / (N (N - 1)), a scalar.
    """
    before, after = (
        (2 - 2 * rows @ rows.T).clamp(min=1e-8).sqrt() for rows in (descriptors, embedded)
    )
    changes = (before - after).square()
    total = changes.sum() - changes.diagonal().sum()
    return total.clamp(min=1e-12).sqrt() / (len(descriptors) * (len(descriptors) - 1))
