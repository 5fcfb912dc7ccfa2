"""hloc's SuperPoint with random weights: with the test double of hloc, and with the real one."""

import sys
from importlib.util import find_spec

import cv2
import h5py
import hloc_double
import numpy as np
import pytest
import torch
from torch.nn.functional import normalize

from hloc_reduce import extract_features, extractors
from hloc_reduce.confs import features
from hloc_reduce.projections import network
from hloc_reduce.utils.cli import InputError

# the submodule of hloc that has the network: the same input, options and output, a smaller encoder
NETWORK = """
import torch
from torch.nn.functional import grid_sample, max_pool2d, normalize, pixel_shuffle, softmax

class SuperPoint(torch.nn.Module):
    def __init__(self, conf):
        super().__init__()
        self.conf = conf
        torch.manual_seed(0)
        self.encoder = torch.nn.Sequential(torch.nn.Conv2d(1, 16, 8, stride=8), torch.nn.ReLU())
        self.scores = torch.nn.Conv2d(16, 65, 3, padding=1)
        self.descriptors = torch.nn.Conv2d(16, 256, 3, padding=1)

    def forward(self, data):
        dense = self.encoder(data["image"])
        scores = pixel_shuffle(softmax(self.scores(dense), 1)[:, :64], 8)[0, 0]
        near = 2 * self.conf["nms_radius"] + 1
        highest = max_pool2d(scores[None, None], near, 1, near // 2)[0, 0]
        inside, border = torch.zeros_like(scores, dtype=bool), self.conf["remove_borders"]
        inside[border:-border, border:-border] = True
        kept = inside & (scores == highest) & (scores > self.conf["keypoint_threshold"])
        y, x = torch.nonzero(kept, as_tuple=True)
        best = scores[y, x].argsort(descending=True)[: self.conf["max_keypoints"]]
        keypoints = torch.stack([x, y], 1)[best].float()
        size = torch.tensor(scores.shape[::-1])
        grid = ((keypoints + 0.5) / size * 2 - 1)[None, None]
        sampled = grid_sample(self.descriptors(dense), grid, align_corners=False)[0, :, 0]
        return {
            "keypoints": [keypoints],
            "scores": (scores[y, x][best],),
            "descriptors": [normalize(sampled, dim=0)],
        }
"""
EXTRACTOR = """
from ..utils.base_model import BaseModel
from SuperGluePretrainedNetwork.models import superpoint

class SuperPoint(BaseModel):
    default_conf = {
        "nms_radius": 4, "keypoint_threshold": 0.005, "max_keypoints": -1, "remove_borders": 4,
    }
    required_inputs = ["image"]
    detection_noise = 2.0

    def _init(self, conf):
        self.net = superpoint.SuperPoint(conf)

    def _forward(self, data):
        return self.net(data)
"""
SUBMODULE = "SuperGluePretrainedNetwork"


@pytest.fixture(params=["double", pytest.param("real", marks=pytest.mark.hloc)])
def hloc(request, tmp_path, monkeypatch):
    if request.param == "real" and find_spec("hloc") is None:
        pytest.skip("hloc is not installed")
    monkeypatch.syspath_prepend(str(tmp_path / "third_party"))
    models = tmp_path / "third_party" / SUBMODULE / "models"
    models.mkdir(parents=True)
    (models / "superpoint.py").write_text(NETWORK)
    if request.param == "double":
        (hloc_double.write(tmp_path / "double") / "extractors/superpoint.py").write_text(EXTRACTOR)
        monkeypatch.syspath_prepend(str(tmp_path / "double"))
    with hloc_double.forgotten():
        yield
    for name in [name for name in sys.modules if name.partition(".")[0] == SUBMODULE]:
        del sys.modules[name]


@pytest.mark.parametrize("name", ["superpoint", "hloc.superpoint"])
def test_superpoint_is_extracted(hloc, name, tmp_path, textured):
    """The features that are stored are those of the network."""
    images, yaml = tmp_path / "images", tmp_path / "superpoint.yaml"
    images.mkdir()
    cv2.imwrite(str(images / "a.png"), textured)
    yaml.write_text(f"model: {{name: {name}, max_keypoints: 40}}\n")
    feature, conf = features.get(str(yaml))
    model = extractors.load(conf["model"]).eval()
    assert feature == "superpoint" and model.descriptor == "hloc.superpoint"
    assert model.detection_noise == 2
    image = torch.from_numpy(textured / np.float32(255))[None, None]
    with torch.no_grad():
        expected = {key: value[0].numpy() for key, value in model.model({"image": image}).items()}
    path = extract_features.main(conf, images, tmp_path)
    assert path.name == "feats-superpoint.h5"
    with h5py.File(path) as file:
        found = {key: file["a.png"][key][()] for key in file["a.png"]}
    assert found["keypoints"].shape == (40, 2) and found["descriptors"].shape == (256, 40)
    np.testing.assert_allclose(found["keypoints"], expected["keypoints"], atol=1e-4)
    for key in ("scores", "descriptors"):
        np.testing.assert_allclose(found[key], expected[key], atol=1e-3)
    norms = np.linalg.norm(found["descriptors"].astype(np.float32), axis=0)
    np.testing.assert_allclose(norms, 1, atol=1e-3)


def test_superpoint_is_projected(hloc, tmp_path, textured):
    torch.manual_seed(0)
    projection = network.MLP((256, 32)).eval()
    network.save(projection, {"descriptor": "hloc.superpoint"}, tmp_path / "p.safetensors")
    cv2.imwrite(str(tmp_path / "a.png"), textured)
    yaml = tmp_path / "superpoint.yaml"
    yaml.write_text("model: {name: superpoint, max_keypoints: 40}\n")
    _, conf = features.get(str(yaml), tmp_path / "p.safetensors")
    path = extract_features.main(conf, tmp_path, tmp_path, image_list=["a.png"])
    base = extractors.load(conf["model"]["base"]).eval()
    raw = extractors.extract(base, textured, conf["preprocessing"])
    with torch.no_grad():
        expected = normalize(projection(torch.from_numpy(raw["descriptors"].T))).T
    with h5py.File(path) as file:
        np.testing.assert_allclose(file["a.png/descriptors"][()], expected, atol=2e-3)


def test_superpoint_says_that_it_wants_grey_photos(hloc, tmp_path, textured):
    cv2.imwrite(str(tmp_path / "a.png"), textured)
    yaml = tmp_path / "superpoint.yaml"
    yaml.write_text("model: {name: superpoint}\npreprocessing: {grayscale: false}\n")
    conf = features.get(str(yaml))[1]
    with pytest.raises(InputError, match="hloc's extractor superpoint fails .*such as grayscale"):
        extract_features.main(conf, tmp_path, tmp_path, image_list=["a.png"])
