"""Draw batches of matching descriptors from the tracks of several maps."""

import numpy as np
import torch

from .tracks import Tracks


class PairSampler:
    """Draws pairs of observations of the same point in different images.

    Args:
        maps: tracks of one or more maps.
        augment: the share of views that are photometric variants, in [0, 1]; if it is not 0, half
            of the pairs are mirrored too.
        balanced: draw a map with a probability proportional to the square root of its number of
            tracks, not to the number, so that no large place outweighs the others.
        maps_per_batch: draw each batch from so many maps, whose points look more alike than those
            of many; None draws from all.
        seed: a batch depends on it and on its number only.
    """

    def __init__(
        self,
        maps: list[Tracks],
        augment: float,
        balanced: bool,
        maps_per_batch: int | None,
        seed: int,
    ):
        self.augment, self.maps_per_batch, self.seed = augment, maps_per_batch, seed
        self.maps, self.starts, self.lengths = [], [], []
        for tracks in maps:
            kept, starts, lengths = matchable(tracks)
            self.maps.append((tracks.descriptors, kept))
            self.starts.append(starts)
            self.lengths.append(lengths)
        sizes = np.array([len(starts) for starts in self.starts], float)
        weights = np.sqrt(sizes) if balanced else sizes
        self.shares = weights / weights.sum()
        self.num_observations = sum(len(kept) for _, kept in self.maps)

    def batch(self, number: int, size: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Draw batch `number`: anchors and positives, each (at most size, 128) float32.

        Every point is drawn once at most, so that the other rows are negatives.
        """
        generator = np.random.default_rng([self.seed, number])
        shares = self.shares
        if self.maps_per_batch:
            drawn = generator.choice(len(shares), self.maps_per_batch, p=shares)
            shares = np.bincount(drawn, minlength=len(shares)) / len(drawn)
        counts = generator.multinomial(size, shares)
        parts = [self._draw(i, count, generator) for i, count in enumerate(counts) if count]
        anchors, positives = (np.concatenate(part) for part in zip(*parts, strict=True))
        return torch.from_numpy(anchors).float(), torch.from_numpy(positives).float()

    def _draw(
        self, i: int, count: int, generator: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        (descriptors, kept), starts, lengths = self.maps[i], self.starts[i], self.lengths[i]
        track = generator.choice(len(starts), min(count, len(starts)), replace=False)
        first = generator.integers(lengths[track])
        second = (first + generator.integers(1, lengths[track])) % lengths[track]
        mirrored = generator.integers(2, size=len(track)) * (self.augment > 0)
        views = []
        for which in (first, second):
            variants = generator.integers(1, descriptors.shape[2], size=len(track))
            variants *= generator.random(len(track)) < self.augment  # 0 is the photo itself
            views.append(descriptors[kept[starts[track] + which], mirrored, variants])
        return views[0], views[1]


def matchable(tracks: Tracks) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find the observations that have a match: one for each point and image, two for each point.

    Returns:
        Their indices, in the order of the tracks; and for each track the first and the number.
    """
    _, kept = np.unique(np.stack([tracks.track, tracks.image], 1), axis=0, return_index=True)
    _, starts, lengths = np.unique(tracks.track[kept], return_index=True, return_counts=True)
    return kept, starts[lengths > 1], lengths[lengths > 1]
