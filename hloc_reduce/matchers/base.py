"""The base class of matchers."""

from collections.abc import Mapping, Sequence

import torch

from ..utils.base_model import BaseModel

GPU_BYTES = 2**30  # of GPU memory that a matcher may use at once

# hloc's dictionary of the features of an image, without a batch dimension
Features = Mapping[str, torch.Tensor]
Tensors = tuple[torch.Tensor, torch.Tensor]


class Matcher(BaseModel):
    """Matches the features of two images.

    A subclass names in `required_inputs` what it needs of both, and only that is read, and writes
    `_forward`: from these to `matches0` (1, N) int64, the index in 1 or -1, and `matching_scores0`
    (1, N) in [0, 1]. With 0 or 1 appended, the names are

    * `keypoints` (1, N, 2) x, y in pixels of the original image, centres at integers;
    * `descriptors` (1, D, N) of unit norm;
    * `scores`, `scales` (pixels), `oris` (degrees) (1, N), of features that have them;
    * `image_size` (1, 2) width, height;

    all float32. A compact map has keypoints, the projections of its points, descriptors and image
    sizes.

    A subclass sets `takes_codes` if its `match` and `match_rows` also take unbiased codes, whose
    norms are above 1 (`utils.codes.restore`), and, on a CPU, int16 descriptors (`to_integers`).
    """

    takes_codes = False

    required_inputs: tuple[str, ...] = ("descriptors0", "descriptors1")

    @classmethod
    def feature_keys(cls) -> tuple[str, ...]:
        """Return what it needs of the features of an image, such as descriptors."""
        return tuple(dict.fromkeys(name.rstrip("01") for name in cls.required_inputs))

    @torch.no_grad()
    def match(
        self, pairs: Sequence[tuple[Features, Features]], gpu_bytes: int = GPU_BYTES
    ) -> list[Tensors]:
        """Match several pairs; a subclass may match them at once.

        Args:
            pairs: the features of both images, at least those that `feature_keys` names: as in
                `_forward`, without the batch dimension, all on one device.
            gpu_bytes: GPU memory to use at once.

        Returns:
            matches0 (N,) and matching_scores0 (N,) of each pair.
        """
        found = [
            self({f"{key}{i}": part[None] for i in (0, 1) for key, part in pair[i].items()})
            for pair in pairs
        ]
        return [(one["matches0"][0], one["matching_scores0"][0]) for one in found]

    def match_rows(
        self, features0: Features, features1: Features, rows1: torch.Tensor
    ) -> torch.Tensor:
        """Match a pair and keep the matches of some keypoints1; a subclass may skip the others.

        Args:
            features0: as in `match`.
            features1: as in `match`.
            rows1: (K,) int64, ascending indices of keypoints1.

        Returns:
            Matches (L, 2) int64, indices of keypoints0 and keypoints1, the most similar first, in
            the order that `utils.match_files.most_similar_first` gives.
        """
        ((matches0, scores),) = self.match([(features0, features1)])
        rows0 = torch.nonzero(torch.isin(matches0, rows1))[:, 0]
        # as float16, as a match file has them
        rows0 = rows0[scores[rows0].half().float().argsort(descending=True, stable=True)]
        return torch.stack([rows0, matches0[rows0]], dim=1)
