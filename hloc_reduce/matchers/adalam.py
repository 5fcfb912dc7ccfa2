"""AdaLAM: nearest neighbours that move as others around them do, by kornia, as in hloc."""

from typing import Any

import torch
from kornia.feature.adalam import AdalamFilter

from .base import Matcher


class AdaLAM(Matcher):
    """The matches of hloc's `adalam`, with its options, which are those of kornia.

    Several keypoints0 may match the same keypoint1.
    """

    required_inputs = tuple(
        f"{key}{i}"
        for i in (0, 1)
        for key in ("keypoints", "descriptors", "scales", "oris", "image_size")
    )
    default_conf = {
        "area_ratio": 100,
        "search_expansion": 4,
        "ransac_iters": 128,
        "min_inliers": 6,
        "min_confidence": 200,
        "orientation_difference_threshold": 30,
        "scale_rate_threshold": 1.5,
        "detected_scale_rate_threshold": 5,
        "refit": True,
        "force_seed_mnn": True,
    }

    def _forward(self, data: dict) -> dict:
        device = data["descriptors0"].device
        options: Any = {key: self.conf[key] for key in self.default_conf} | {"device": device}
        given: dict[str, Any] = {}
        for i in (0, 1):
            given[f"k{i + 1}"] = data[f"keypoints{i}"][0]
            given[f"d{i + 1}"] = data[f"descriptors{i}"][0].T
            given[f"o{i + 1}"] = data[f"oris{i}"][0]
            given[f"s{i + 1}"] = data[f"scales{i}"][0]
            given[f"im{i + 1}shape"] = data[f"image_size{i}"][0].tolist()
        found, _ = AdalamFilter(options).match_and_filter(**given, return_dist=True)
        rows0, rows1 = found.T
        cosine = (given["d1"][rows0] * given["d2"][rows1]).sum(1)
        matches = torch.full((len(given["k1"]),), -1, device=device)
        scores = torch.zeros(len(matches), device=device)
        matches[rows0], scores[rows0] = rows1, (cosine.clamp(max=1) + 1) / 2
        return {"matches0": matches[None], "matching_scores0": scores[None]}
