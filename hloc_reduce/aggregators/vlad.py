"""VLAD: a global descriptor aggregated from local ones (Jégou et al., CVPR 2010)."""

from pathlib import Path

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch.nn.functional import normalize, one_hot

from ..utils.cli import InputError
from . import Aggregator

# 64 words of sift_sv64, learned by aggregate_features from south-building
VOCABULARY = Path(__file__).parent / "vlad_sift_sv64.safetensors"


def read_vocabulary(path: Path | str | None = None) -> torch.Tensor:
    """Read a vocabulary (words, D) float32 of aggregate_features; default: the shipped one.

    Raises:
        InputError: when the file is missing or is not a vocabulary.
    """
    path = path or VOCABULARY
    try:
        vocabulary = load_file(path)["vocabulary"].float()
        if vocabulary.ndim != 2 or not len(vocabulary) or not vocabulary.isfinite().all():
            raise ValueError(f"shape {tuple(vocabulary.shape)}, or not finite")
        return vocabulary
    except (OSError, SafetensorError, KeyError, ValueError) as error:
        raise InputError(f"{path} is not a vocabulary ({error}).") from None


class VLAD(Aggregator):
    """Sums of the residuals of local descriptors to the words of a vocabulary.

    The sum of each word is normalized, so that a repeated texture does not outweigh the rest
    (intra-normalization, Arandjelovic and Zisserman, CVPR 2013), then the whole descriptor.
    """

    default_conf = {"num_words": 64, "max_samples": 200_000, "seed": 0}

    def _init(self, conf: dict) -> None:
        self.register_buffer("vocabulary", None)

    def fit(self, descriptors: np.ndarray) -> None:
        """Learn the vocabulary from local descriptors (N, D), N > 0."""
        from sklearn.cluster import MiniBatchKMeans  # takes a second to import

        generator = np.random.default_rng(self.conf["seed"])
        if len(descriptors) > self.conf["max_samples"]:
            chosen = generator.choice(len(descriptors), self.conf["max_samples"], replace=False)
            descriptors = descriptors[np.sort(chosen)]
        kmeans = MiniBatchKMeans(
            n_clusters=min(self.conf["num_words"], len(descriptors)),
            batch_size=4096,
            n_init=3,
            random_state=self.conf["seed"],
        ).fit(descriptors.astype(np.float32))
        self.vocabulary = torch.from_numpy(kmeans.cluster_centers_)

    @torch.no_grad()
    def _forward(self, data: dict) -> dict:
        """Compute `global_descriptor` (1, words * D); without local descriptors it is zero."""
        descriptors = data["descriptors"][0].T.float()
        if descriptors.shape[1] != self.vocabulary.shape[1]:
            raise InputError(
                f"The vocabulary is of {self.vocabulary.shape[1]}-D descriptors, those of the "
                f"image are {descriptors.shape[1]}-D."
            )
        words = torch.cdist(descriptors, self.vocabulary).argmin(dim=1)
        assigned = one_hot(words, len(self.vocabulary)).to(descriptors)
        sums = assigned.T @ descriptors - assigned.sum(0)[:, None] * self.vocabulary
        return {"global_descriptor": normalize(normalize(sums, dim=1).flatten(), dim=0)[None]}
