"""A toy matcher, as CONTRIBUTING.md says: one file, one class, `_forward`."""

import torch

from hloc_reduce.matchers.base import Matcher


class InOrder(Matcher):
    """Matches the first descriptor with the first, the second with the second, and so on."""

    default_conf = {"number": 3}

    def _forward(self, data: dict) -> dict:
        n, m = (data[f"descriptors{i}"].shape[2] for i in (0, 1))
        number = min(n, m, self.conf["number"])
        matches = torch.arange(n, device=data["descriptors0"].device)[None]
        matches[:, number:] = -1
        return {"matches0": matches, "matching_scores0": (matches >= 0).float()}
