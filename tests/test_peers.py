"""The benchmark of other projects' code, with doubles of their clones."""

import os
import subprocess
import sys
from functools import partial
from importlib import import_module
from pathlib import Path

import command
import h5py
import numpy as np
import pytest
import torch

from hloc_reduce import extractors
from hloc_reduce.confs import features

ROOT = Path(__file__).parents[1]
# like the originals, they take weights from the working folder, import a module beside them, and
# return what they return
EDGEPOINT2 = """
import cv2
import torch
from model.model import scale

class EdgePoint2Wrapper(torch.nn.Module):
    def __init__(self, cfg, top_k):
        super().__init__()
        self.load_state_dict(torch.load(f"./weights/{cfg}.pth", "cpu"))
        self.top_k = top_k

    @torch.inference_mode()
    def forward(self, x):
        assert x.shape[:2] == (1, 3)
        grey = (scale * x[0].mean(dim=0)).round().byte().numpy()
        found, descriptors = cv2.SIFT_create(self.top_k).detectAndCompute(grey, None)
        if not found:
            return [{"keypoints": x.new_zeros(0, 2), "scores": x.new_zeros(0),
                     "descriptors": x.new_zeros(0, 128)}]
        descriptors = torch.nn.functional.normalize(torch.from_numpy(descriptors))
        return [{"keypoints": torch.tensor([point.pt for point in found]),
                 "scores": torch.tensor([point.response for point in found]),
                 "descriptors": descriptors}]
"""
FEATUREBOOSTER = """
import math
import torch

class FeatureBooster(torch.nn.Module):
    def __init__(self, config):
        super().__init__()
        self.last = torch.nn.Linear(128, config["output_dim"], bias=False)

    def forward(self, desc, kpts):
        assert kpts.shape == (len(desc), 4)
        if len(desc):
            # one side is shorter; coordinates of the longer one fill -1/1.4 to 1/1.4
            assert 0.5 < kpts[:, 0].abs().max() < 1 / 1.4 and kpts[:, 1].abs().max() < 0.6
            assert 1 < kpts[:, 3].abs().max() <= 2 * math.pi
            torch.testing.assert_close(desc.norm(dim=1), torch.ones(len(desc)))
        return self.last(desc - 128**-0.5)
"""


@pytest.fixture
def edgepoint2(tmp_path) -> Path:
    folder = tmp_path / "EdgePoint2"
    for part in ("model", "weights"):
        (folder / part).mkdir(parents=True)
    (folder / "edgepoint2.py").write_text(EDGEPOINT2)
    (folder / "model/model.py").write_text("scale = 255\n")
    torch.save({}, folder / "weights/M32.pth")
    return folder


@pytest.fixture
def featurebooster(tmp_path) -> Path:
    folder = tmp_path / "FeatureBooster"
    (folder / "models").mkdir(parents=True)
    (folder / "featurebooster.py").write_text(FEATUREBOOSTER)
    (folder / "config.yaml").write_text("SIFT+Boost-B: {output_dim: 256}\n")
    generator = torch.Generator().manual_seed(0)
    weights = {"last.weight": torch.randn(256, 128, generator=generator)}
    torch.save(weights, folder / "models/SIFT+Boost-B.pth")
    return folder


def test_peers_localize_beside_this_project(aachen_layout, edgepoint2, featurebooster, tmp_path):
    outputs = tmp_path / "outputs"
    clones = ("--edgepoint2", edgepoint2, "--weights", "M32", "--featurebooster", featurebooster)
    ours = ("--feature", "colmap_sift_sv64:uint4", "--photos", 2, "--threads", 1)
    options = ("--dataset", aachen_layout, *clones, *ours, "--outputs", outputs)
    # in a process of its own, because it sets the number of threads
    given = [sys.executable, ROOT / "benchmarks/peers.py", *map(str, options)]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(given, capture_output=True, text=True, env=environment, timeout=300)
    assert done.returncode == 0, done.stderr
    lines = [line.strip("| ").split(" | ") for line in done.stdout.splitlines()]
    header, _, *rows = (dict(zip(lines[0], line, strict=True)) for line in lines)
    assert "recall [%] at 1 / 2 / 5 / 25 cm" in header and "extraction [s]" in header
    names = ["`colmap_sift_sv64`, `uint4`", "`EdgePoint2-M32`", "`SIFT+Boost-B`"]
    assert [row["feature"] for row in rows] == [name for name in names for _ in range(2)]
    assert [row["bytes"] for row in rows[::2]] == ["32", "256", "32"]
    assert rows[0]["list"] == f"{aachen_layout}, day"
    for day, night in zip(rows[::2], rows[1::2], strict=True):
        assert day["localized"] == "1 of 2" and night["localized"] == "1 of 1"
        assert night["recall [%] at 1 / 2 / 5 / 25 cm"].endswith("100.0 / 100.0")
        assert int(night["points"].replace(",", "")) > 100 and float(night["extraction [s]"]) > 0

    (written,) = outputs.rglob("feats-SIFT+Boost-B.h5")
    with h5py.File(written) as file:
        (bits, keypoints) = (file["db/0.png"][key][()] for key in ("descriptors", "keypoints"))
    assert bits.shape == (256, len(keypoints)) and np.unique(np.abs(bits)).tolist() == [1 / 16]
    (same,) = outputs.rglob("feats-dog-colmap_sift_sv64.h5")
    with h5py.File(same) as file:
        np.testing.assert_array_equal(keypoints, file["db/0.png/keypoints"])


def test_what_peers_refuses(
    aachen_layout, edgepoint2, featurebooster, tmp_path, monkeypatch, caplog, capsys
):
    """A missing or an empty folder, unknown weights, other code, and data that is not there."""
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    monkeypatch.setattr(extractors, "__path__", list(extractors.__path__))
    monkeypatch.setattr(features, "confs", dict(features.confs))
    refused = partial(command.refused, monkeypatch, caplog, import_module("peers"))
    none, empty, here = tmp_path / "none", tmp_path / "empty", ("--dataset", aachen_layout)
    empty.mkdir()
    (featurebooster / "config.yaml").write_text("ORB+Boost-B: {output_dim: 256}\n")
    for options, expected in (
        ((*here, "--edgepoint2", none), f"There is no folder {none}."),
        ((*here, "--edgepoint2", empty), f"{empty} has no edgepoint2.py: clone github.com/HITCSC"),
        ((*here, "--edgepoint2", edgepoint2), "Unknown weights 'M64'. There are: M32."),
        ((*here, "--featurebooster", featurebooster), "SIFT+Boost-B cannot be loaded (KeyError"),
        (here, "Nothing to compare"),
        (("--dataset", none), f"There is no folder {none}."),
        (("--dataset", empty), f"{empty} has neither of the folders 3D-models and database."),
    ):
        assert expected in refused(*options)
    assert not capsys.readouterr().out
