"""VLAD: a global descriptor aggregated from local ones (Jégou et al., CVPR 2010)."""

import numpy as np
import torch

from ..retrieval.vlad import aggregate
from ..runtime import parallel
from . import Aggregator


class VLAD(Aggregator):
    """Sums of the residuals of local descriptors to the words of a vocabulary.

    Attributes:
        vocabulary: (words, D) float32.
    """

    default_conf = {"num_words": 64, "max_samples": 200_000, "seed": 0}

    def fit(self, descriptors: np.ndarray) -> None:
        """Learn the vocabulary from local descriptors (N, D), N > 0."""
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

    def _forward(self, data: dict) -> dict:
        """Compute `global_descriptor` (1, words * D); without local descriptors it is zero."""
        descriptors = data["descriptors"][0].T
        found = aggregate(descriptors.float().cpu().numpy(), self.vocabulary)
        return {"global_descriptor": torch.from_numpy(found)[None].to(descriptors.device)}
