"""hloc's extractor `vlad`: global descriptors aggregated from local ones, for retrieval."""

import torch
from hloc.utils.base_model import BaseModel

from hloc_reduce.extractors import load
from hloc_reduce.retrieval.vlad import aggregate, read_vocabulary


class VLAD(BaseModel):
    """Local features of an image, aggregated with the words of a vocabulary.

    `features` is the model configuration of an extractor, `vocabulary` a file that
    hloc_reduce.aggregate_features wrote for such features; default: the shipped one.
    """

    default_conf = {
        "features": {
            "name": "reduced",
            "base": {"name": "dog", "descriptor": "sift"},
            "projection": "sift_sv64",
        },
        "vocabulary": None,
    }
    required_inputs = ["image"]

    def _init(self, conf: dict) -> None:
        self.extract = load(conf["features"])
        self.vocabulary = read_vocabulary(conf["vocabulary"])

    def _forward(self, data: dict) -> dict:
        descriptors = self.extract(data)["descriptors"][0].T
        found = aggregate(descriptors.float().cpu().numpy(), self.vocabulary)
        return {"global_descriptor": torch.from_numpy(found)[None].to(descriptors.device)}
