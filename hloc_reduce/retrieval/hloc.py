"""Global descriptors by an extractor of an installed hloc, such as NetVLAD or MegaLoc."""

from threading import Lock

import numpy as np
import torch

from ..utils.arrays import unit
from ..utils.cli import InputError
from ..utils.hloc import make_extractor, reason
from . import Retrieval


class HlocRetrieval(Retrieval):
    """The global descriptors of an extractor of hloc, on a GPU if there is one.

    `conf` is hloc's configuration: `name` and the options of that extractor.
    """

    required_inputs = ("image",)
    default_conf = {"conf": {}}

    def _init(self, conf: dict) -> None:
        self._device = "cuda" if torch.cuda.is_available() else "cpu"
        self._name = str(conf["conf"].get("name")).removeprefix("hloc.")
        self._model = make_extractor(conf["conf"]).eval().to(self._device)
        self._lock = Lock()  # memory must not depend on the number of threads

    @torch.no_grad()
    def describe(self, data: dict[str, np.ndarray]) -> np.ndarray:
        """Return the global descriptor (G,) of an `image` (H, W, 3)."""
        channels = np.ascontiguousarray(np.atleast_3d(data["image"]).transpose(2, 0, 1))
        try:
            with self._lock:
                image = torch.from_numpy(channels)[None].to(self._device)
                found = self._model({"image": image})
        except (torch.cuda.OutOfMemoryError, MemoryError):
            raise
        except Exception as error:  # whatever hloc and its third parties raise
            raise InputError(f"hloc's extractor {self._name} fails ({reason(error)}).") from error
        if "global_descriptor" not in found:
            raise InputError(f"hloc's extractor {self._name} gives no global descriptor.")
        return unit(found["global_descriptor"][0].float().cpu().numpy())
