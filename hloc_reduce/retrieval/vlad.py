"""VLAD: a global descriptor aggregated from local ones (Jégou et al., CVPR 2010)."""

from pathlib import Path

import numpy as np

from ..runtime import parallel
from ..utils.arrays import unit
from ..utils.cli import InputError
from . import Retrieval

# 64 words of sift_sv64, learned by aggregate_features from south-building
VOCABULARY = Path(__file__).parent / "vlad_sift_sv64.safetensors"


class VLAD(Retrieval):
    """Sums of the residuals of local descriptors to the words of a vocabulary."""

    required_inputs = ("descriptors",)
    learns = True
    default_conf = {"num_words": 64, "max_samples": 200_000, "seed": 0}

    def fit(self, descriptors: np.ndarray) -> None:
        """Learn the words from local descriptors (N, D), N > 0."""
        from sklearn.cluster import MiniBatchKMeans  # takes a second to import
        from threadpoolctl import threadpool_limits

        generator = np.random.default_rng(self.conf["seed"])
        if len(descriptors) > self.conf["max_samples"]:
            chosen = generator.choice(len(descriptors), self.conf["max_samples"], replace=False)
            descriptors = descriptors[np.sort(chosen)]
        kmeans = MiniBatchKMeans(
            n_clusters=min(self.conf["num_words"], len(descriptors)),
            batch_size=4096,
            n_init=3,
            random_state=self.conf["seed"],
        )
        # more threads wait for each other in such small batches
        with parallel.one_thread(), threadpool_limits(1, "openmp"):
            kmeans.fit(descriptors.astype(np.float32))
        self.vocabulary = kmeans.cluster_centers_

    def describe(self, data: dict[str, np.ndarray]) -> np.ndarray:
        """Return the global descriptor (words * D,) of local `descriptors` (D, N)."""
        return aggregate(data["descriptors"].T, self.vocabulary)


def read_vocabulary(path: Path | str | None = None) -> np.ndarray:
    """Read a vocabulary (words, D) float32 of aggregate_features; default: the shipped one.

    Raises:
        InputError: when the file is missing or is not a vocabulary.
    """
    from safetensors import SafetensorError
    from safetensors.numpy import load_file

    path = path or VOCABULARY
    try:
        vocabulary = load_file(path)["vocabulary"].astype(np.float32)
        if vocabulary.ndim != 2 or not len(vocabulary) or not np.isfinite(vocabulary).all():
            raise ValueError(f"shape {vocabulary.shape}, or not finite")
        return vocabulary
    except (OSError, SafetensorError, KeyError, ValueError) as error:
        raise InputError(f"{path} is not a vocabulary ({error}).") from None


def aggregate(descriptors: np.ndarray, vocabulary: np.ndarray) -> np.ndarray:
    """Sum the residuals of local descriptors to the words of a vocabulary.

    The sum of each word is normalized, so that a repeated texture does not outweigh the rest
    (intra-normalization, Arandjelovic and Zisserman, CVPR 2013), then the whole descriptor. It is
    computed in float64, so that the result does not depend on the number of threads.

    Args:
        descriptors: (N, D) float32.
        vocabulary: (W, D) float32.

    Returns:
        (W * D,) float32 of unit norm, zero without local descriptors.

    Raises:
        InputError: when the vocabulary is of descriptors of another dimension.
    """
    if descriptors.shape[1] != vocabulary.shape[1]:
        raise InputError(
            f"The vocabulary is of {vocabulary.shape[1]}-D descriptors, those of the image are "
            f"{descriptors.shape[1]}-D."
        )
    descriptors, words = descriptors.astype(np.float64), vocabulary.astype(np.float64)
    nearest = (2 * descriptors @ words.T - (words**2).sum(1)).argmax(axis=1)
    assigned = (nearest == np.arange(len(words))[:, None]).astype(np.float64)
    sums = assigned @ descriptors - assigned.sum(1)[:, None] * words
    return unit(unit(sums).ravel()).astype(np.float32)
