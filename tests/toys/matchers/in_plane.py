"""A toy matcher that needs keypoints, as CONTRIBUTING.md says: one file, one class, `_forward`."""

import torch

from hloc_reduce.matchers.base import Matcher


class InPlane(Matcher):
    """Mutual nearest neighbours among keypoints at nearly the same place of both images."""

    required_inputs = tuple(
        f"{key}{i}" for key in ("keypoints", "descriptors", "image_size") for i in (0, 1)
    )
    default_conf = {"radius": 0.5}  # of the longer side

    def _forward(self, data: dict) -> dict:
        places = [data[f"keypoints{i}"][0] / data[f"image_size{i}"].max() for i in (0, 1)]
        matches = torch.full((len(places[0]),), -1, device=places[0].device)
        if min(map(len, places)):
            similarity = data["descriptors0"][0].T @ data["descriptors1"][0]
            similarity[torch.cdist(*places) > self.conf["radius"]] = -1
            best, index = similarity.max(1)
            mutual = similarity.argmax(0)[index] == torch.arange(len(index), device=index.device)
            matches = torch.where(mutual & (best > 0.8), index, -1)
        return {"matches0": matches[None], "matching_scores0": (matches >= 0).float()[None]}
