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
            tracks, not to that number, so that no large place outweighs the others.
        maps_per_batch: number of maps per batch at most, whose points look more alike than those
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
        self.maps = [(tracks.descriptors, *matchable(tracks)) for tracks in maps]
        sizes = np.array([len(starts) for _, _, starts, _ in self.maps], float)
        weights = np.sqrt(sizes) if balanced else sizes
        self.shares = weights / weights.sum()
        self.num_observations = int(sum(lengths.sum() for *_, lengths in self.maps))

    def batch(self, number: int, size: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Draw anchors and positives, each (at most size, D) float32, of different points."""
        generator = np.random.default_rng([self.seed, number])
        shares = self.shares
        if self.maps_per_batch:
            drawn = generator.choice(len(shares), self.maps_per_batch, p=shares)
            shares = np.bincount(drawn, minlength=len(shares)) / len(drawn)
        counts = generator.multinomial(size, shares)
        parts = [self._draw(i, count, generator) for i, count in enumerate(counts) if count]
        anchors, positives = (np.concatenate(part) for part in zip(*parts, strict=True))
        return torch.from_numpy(anchors).float(), torch.from_numpy(positives).float()

    def _draw(self, i: int, count: int, generator: np.random.Generator) -> list[np.ndarray]:
        descriptors, kept, starts, lengths = self.maps[i]
        track = generator.choice(len(starts), min(count, len(starts)), replace=False)
        first = generator.integers(lengths[track])
        second = (first + generator.integers(1, lengths[track])) % lengths[track]
        mirrored = generator.integers(2, size=len(track)) * (self.augment > 0)
        views = []
        for which in (first, second):
            variants = generator.integers(1, descriptors.shape[2], size=len(track))
            variants *= generator.random(len(track)) < self.augment  # 0 is the photo itself
            views.append(descriptors[kept[starts[track] + which], mirrored, variants])
        return views


class DescriptorSampler:
    """Draws single observations.

    Args:
        maps: tracks of one or more maps.
        augment: the share of views that are photometric variants, in [0, 1].
        mirror: mirror half of the views.
        balanced: draw maps with probabilities proportional to the square root of their numbers of
            observations; otherwise an epoch goes once through all observations.
        seed: a batch depends on it and on its number only.
    """

    def __init__(self, maps: list[Tracks], augment: float, mirror: bool, balanced: bool, seed: int):
        self.maps, self.augment, self.mirror = maps, augment, mirror
        self.balanced, self.seed = balanced, seed
        sizes = np.array([len(tracks.track) for tracks in maps])
        self.starts = np.concatenate([[0], sizes.cumsum()])
        self.shares = np.sqrt(sizes) / np.sqrt(sizes).sum()
        self.num_observations = int(sizes.sum())

    def batch(self, number: int, size: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Draw a batch as `views` returns it."""
        generator = np.random.default_rng([self.seed, number])
        return self.views(self.indices(number, size), generator)

    def indices(self, number: int, size: int) -> np.ndarray:
        """Draw the observations (N,) of a batch, counted through all maps."""
        if self.balanced:
            generator = np.random.default_rng([self.seed, number, 1])
            place = generator.choice(len(self.maps), size, p=self.shares)
            return generator.integers(self.starts[place], self.starts[place + 1])
        epoch, number = divmod(number, self.per_epoch(size))
        order = np.random.default_rng([self.seed, epoch]).permutation(self.num_observations)
        return order[number * size : (number + 1) * size]

    def per_epoch(self, size: int) -> int:
        """Return the number of batches of an epoch."""
        full, rest = divmod(self.num_observations, size)
        return full + (rest > 1)  # batch normalization cannot learn from a single observation

    def views(
        self, indices: np.ndarray, generator: np.random.Generator
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return views (N, D), augmented or not, and the same unaugmented, both float32."""
        variant = generator.random(len(indices)) < self.augment
        mirrored = generator.integers(2, size=len(indices)) * self.mirror
        shape = len(indices), self.maps[0].descriptors.shape[-1]
        seen, plain = np.empty(shape, np.float32), np.empty(shape, np.float32)
        for start, end, tracks in zip(self.starts, self.starts[1:], self.maps, strict=False):
            rows = np.flatnonzero((indices >= start) & (indices < end))
            chosen = generator.integers(1, tracks.descriptors.shape[2], size=len(rows))
            chosen = chosen * variant[rows]
            inside = indices[rows] - start
            seen[rows] = tracks.descriptors[inside, mirrored[rows], chosen]
            plain[rows] = tracks.descriptors[inside, mirrored[rows], 0]
        return torch.from_numpy(seen), torch.from_numpy(plain)


def matchable(tracks: Tracks) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find the points that are seen in several images, and one observation for each image.

    Returns:
        Indices of observations, sorted by track; and for each track of two or more, where its
        observations start in these indices, and their number.
    """
    _, kept = np.unique(np.stack([tracks.track, tracks.image], 1), axis=0, return_index=True)
    _, starts, lengths = np.unique(tracks.track[kept], return_index=True, return_counts=True)
    return kept, starts[lengths > 1], lengths[lengths > 1]
