"""An extractor of an installed hloc as an extractor of this project."""

import torch
from torch.nn.functional import normalize

from ..utils.cli import InputError
from ..utils.hloc import make_extractor, reason
from . import Extractor

# keys of hloc's configurations that determine the descriptors
DETERMINING = ("descriptor", "model_name", "weights")
ROTATION_INVARIANT = {"dog"}


class HlocExtractor(Extractor):
    """The features of an extractor of an installed hloc.

    `conf` is hloc's configuration: `name` and the options of that extractor.
    """

    default_conf = {"conf": {}}

    def _init(self, conf: dict) -> None:
        self.model = make_extractor(conf["conf"])
        self.name = str(conf["conf"]["name"]).removeprefix("hloc.")
        self.detection_noise = getattr(self.model, "detection_noise", 1.0)
        self.rotation_invariant = self.is_rotation_invariant(conf)

    @classmethod
    def is_rotation_invariant(cls, conf: dict) -> bool:
        """Tell whether an extractor of hloc is one of `ROTATION_INVARIANT`."""
        return str(conf["conf"].get("name")).removeprefix("hloc.") in ROTATION_INVARIANT

    @property
    def descriptor(self) -> str:
        """The name of these descriptors in the metadata of projections, such as hloc.disk.depth."""
        chosen = [str(self.model.conf[key]) for key in DETERMINING if self.model.conf.get(key)]
        return ".".join(["hloc", self.name, *chosen])

    @torch.no_grad()
    def _forward(self, data: dict) -> dict:
        try:
            features = {key: value[0] for key, value in self.model(data).items()}
        except (torch.cuda.OutOfMemoryError, MemoryError):
            raise
        except Exception as error:
            raise InputError(
                f"hloc's extractor {self.name} fails ({reason(error)}). "
                "Does it need other preprocessing, such as grayscale?"
            ) from error
        if "descriptors" not in features:
            raise InputError(f"hloc's extractor {self.name} gives no local descriptors.")
        # some extractors return descriptors on the CPU
        descriptors = features["descriptors"].to(data["image"].device).float()
        features["descriptors"] = normalize(descriptors, dim=0)
        if "keypoint_scores" in features:
            features["scores"] = features.pop("keypoint_scores")
        return {key: value[None] for key, value in features.items()}
