"""VLAD: a global descriptor made of local ones (Jégou et al., CVPR 2010)."""

from pathlib import Path

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch.nn.functional import normalize, one_hot

from ..utils.base_model import BaseModel
from ..utils.cli import InputError

# 64 words of sift_sv64, learned by aggregate_features from south-building
VOCABULARY = Path(__file__).parent / "vlad_sift_sv64.safetensors"


def read_vocabulary(path: Path | str | None = None) -> torch.Tensor:
    """Read a vocabulary (words, D) float32 that aggregate_features wrote; default: one that ships.

    Raises:
        InputError: when the file is not there or is none.
    """
    path = path or VOCABULARY
    try:
        vocabulary = load_file(path)["vocabulary"].float()
        if vocabulary.ndim != 2 or not len(vocabulary) or not vocabulary.isfinite().all():
            raise ValueError(f"{tuple(vocabulary.shape)} numbers, or not finite ones")
        return vocabulary
    except (OSError, SafetensorError, KeyError, ValueError) as error:
        raise InputError(f"{path} is not a vocabulary ({error}).") from None


class VLAD(BaseModel):
    """Sums of the residuals of local descriptors to the words of a vocabulary.

    Each word's sum is normalized by itself, so that a repeated texture does not outweigh the rest
    (intra-normalization, Arandjelovic and Zisserman, CVPR 2013), then the whole.
    """

    default_conf = {"num_words": 64, "max_samples": 200_000, "seed": 0}
    required_inputs = ("descriptors",)

    def _init(self, conf: dict) -> None:
        self.register_buffer("vocabulary", None)

    def fit(self, descriptors: np.ndarray) -> None:
        """Learn the vocabulary from local descriptors (N, D), N > 0."""
        from sklearn.cluster import MiniBatchKMeans  # a second to import, for this only

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
        """Map local descriptors (1, D, N) to `global_descriptor` (1, words * D) of unit norm.

        Without local descriptors it is zero.
        """
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
