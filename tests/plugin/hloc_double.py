"""A test double: what the plugin needs of hloc, and no more."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

INIT = """
from packaging import version
__version__ = "1.5"
min_version = version.parse("3.13.0")
"""
BASE_MODEL = """
import inspect
import torch

class BaseModel(torch.nn.Module):
    default_conf = {}
    required_inputs = []

    def __init__(self, conf):
        super().__init__()
        self.conf = {**self.default_conf, **conf}
        self._init(self.conf)

    def forward(self, data):
        return self._forward(data)

def dynamic_load(root, model):
    path = f"{root.__name__}.{model}"
    module = __import__(path, fromlist=[""])
    classes = [c for _, c in inspect.getmembers(module, inspect.isclass) if c.__module__ == path]
    (model,) = [c for c in classes if issubclass(c, BaseModel)]
    return model
"""
DOTS = """
import torch
from ..utils.base_model import BaseModel

class Dots(BaseModel):
    default_conf = {"number": 5}
    detection_noise = 2.0

    def _init(self, conf):
        self.number = conf.pop("number")
        assert conf.pop("name") == "dots"

    def _forward(self, data):
        assert data["image"].shape[1] == 3
        return {
            "keypoints": [torch.arange(2.0 * self.number).reshape(-1, 2)],
            "keypoint_scores": (torch.ones(self.number),),
            "descriptors": [2 * torch.eye(256)[:, : self.number]],
        }
"""
NETVLAD = """
from ..utils.base_model import BaseModel

class NetVLAD(BaseModel):
    def _init(self, conf):
        pass

    def _forward(self, data):
        assert data["image"].shape[1] == 3
        return {"global_descriptor": 3 * data["image"].mean(dim=(2, 3))}
"""
EXTRACT_FEATURES = """
import argparse

confs = {"sift": {"output": "feats-sift", "model": {"name": "dog"}, "preprocessing": {}}}

if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--conf", choices=list(confs))
    print(confs[parser.parse_args().conf]["output"])
"""
MODULES = {
    "__init__.py": INIT,
    "utils/__init__.py": "",
    "utils/base_model.py": BASE_MODEL,
    "extractors/__init__.py": "",
    "extractors/dots.py": DOTS,
    "matchers/__init__.py": "",
    "extractors/netvlad.py": NETVLAD,
    "extract_features.py": EXTRACT_FEATURES,
    "match_features.py": 'confs = {"NN-ratio": {"output": "hlocs own"}}',
    "broken.py": "import not_there",
}


def write(folder: Path) -> Path:
    """Write the package `hloc` into a folder; return its own."""
    for name, source in MODULES.items():
        path = folder / "hloc" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(source)
    return folder / "hloc"


@contextmanager
def forgotten() -> Iterator[None]:
    """Forget what was imported of hloc, before and after."""
    before = imported()
    for name in before:
        del sys.modules[name]
    yield
    for name in imported():
        del sys.modules[name]
    sys.modules.update(before)


def imported() -> dict:
    return {name: m for name, m in sys.modules.items() if name.partition(".")[0] == "hloc"}
