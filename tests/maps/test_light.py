"""Localization without torch: the same poses, and nothing that imports it."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.numpy import load, save

from hloc_reduce import Localizer, compact, projections
from hloc_reduce.light import projection
from hloc_reduce.maps import contents
from hloc_reduce.maps.compact import CompactMap
from hloc_reduce.utils.cli import InputError
from pipelines import localize

PIPELINE = localize
ROOT = Path(__file__).parents[2]
# what docs/robot.md installs, with what these need themselves
INSTALLED = {
    *("cloudpickle", "cv2", "h5py", "loky", "numpy", "packaging", "PIL", "pycolmap", "safetensors"),
    *("scipy", "tqdm", "yaml"),
}
PROGRAM = """
import sys
from importlib.metadata import packages_distributions

class Absent:
    def find_spec(self, name, path=None, target=None):
        if name in BLOCKED:
            raise ModuleNotFoundError(f"{name} is not installed")

BLOCKED = set(packages_distributions()) - set(sys.argv[3].split(","))
sys.meta_path.insert(0, Absent())
from hloc_reduce import Localizer

pose, info = Localizer(sys.argv[1]).localize(sys.argv[2])
print(*pose.rotation.quat, *pose.translation, info["num_inliers"], info["confidence"])
"""


@pytest.fixture
def file(place, run, tmp_path):
    """A compact map of the plane, and a photo of it."""
    build, images, outputs = place
    run(*build, "--feature", "colmap_sift_sv32")
    compact.main(tmp_path / "place.hlm", outputs / "map")
    return tmp_path / "place.hlm", images / "query/day/a.png"


def test_localization_without_torch(file, monkeypatch):
    """The pose and its confidence are those that torch gives."""
    path, photo = file
    allowed = ",".join({*INSTALLED, "hloc_reduce", "confs", "pipelines"})
    command = [sys.executable, "-c", PROGRAM, path, photo, allowed]
    found = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=60)
    assert found.returncode == 0, found.stderr
    *values, inliers, confidence = map(float, found.stdout.split())

    monkeypatch.setattr(contents, "takes", lambda *models: False)
    localizer = Localizer(path)
    assert type(localizer.engine).__name__ == "TorchEngine"
    pose, info = localizer.localize(photo)
    np.testing.assert_allclose([*pose.rotation.quat, *pose.translation], values, atol=1e-9)
    assert (info["num_inliers"], info["confidence"]) == (inliers, confidence)


def test_features_retrieval_and_matches_are_those_of_torch(file, monkeypatch):
    path, photo = file
    light = contents.read(path)
    monkeypatch.setattr(contents, "takes", lambda *models: False)
    heavy = contents.read(path)
    found = [one.engine.extract(photo, one.preprocessing) for one in (light, heavy)]
    for key in ("keypoints", "image_size", "uncertainty", "blur"):
        np.testing.assert_array_equal(*(one[key] for one in found))
    rounded = [one["descriptors"].T.astype(np.float16) for one in found]
    np.testing.assert_array_equal(*rounded)
    query = rounded[0].astype(np.float32)
    np.testing.assert_array_equal(*(one.engine.aggregate(query) for one in (light, heavy)))
    for name in light.names:
        matched = [
            one.engine.match(
                one.engine.prepare(query), one.engine.prepare(one.describe(name)), one.shown[name]
            )
            for one in (light, heavy)
        ]
        np.testing.assert_array_equal(*matched)
    assert any(len(pairs) > 50 for pairs in matched)


def test_features_that_need_torch(place, run, tmp_path):
    """Patches are described by kornia."""
    build, images, outputs = place
    run(*build, "--feature", "sift_sv32")
    compact.main(tmp_path / "place.hlm", outputs / "map")
    localizer = Localizer(tmp_path / "place.hlm")
    assert type(localizer.engine).__name__ == "TorchEngine"
    pose, _ = localizer.localize(images / "query/day/a.png")
    assert pose is not None


NAMES = ["sift_sv64", "mkd_us16", "colmap_sift_sv32", "xfeat_pca24", "sift_nested@24"]


@pytest.mark.parametrize("name", NAMES)
def test_projections_agree_with_torch(name):
    file, prefix = projections.find(name), projections.split_prefix(name)[1]
    layers = projection.read(file.read_bytes(), prefix)
    expected = projections.load(name)
    generator = np.random.default_rng(0)
    descriptors = generator.standard_normal((500, expected.sizes[0])).astype(np.float32)
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    found = projection.project(descriptors, layers)
    assert found.shape == (500, expected.dim) and found.dtype == np.float32
    of_torch = expected(torch.from_numpy(descriptors)).numpy()
    np.testing.assert_array_equal(found.astype(np.float16), of_torch.astype(np.float16))
    assert projection.project(descriptors[:0], layers).shape == (0, expected.dim)


@pytest.mark.parametrize("prefix", ["0", "65", "x", "-1"])
def test_prefixes_that_a_projection_does_not_have(prefix):
    content = projections.find("sift_nested").read_bytes()
    with pytest.raises(ValueError, match="of no use"):
        projection.read(content, prefix)
    with pytest.raises(ValueError, match="of no use"):
        projection.read(projections.find("sift_sv64").read_bytes(), "24")


def _without_a_layer(tensors):
    del tensors["linears.1.weight"]


def _cut(tensors):
    tensors["linears.1.weight"] = tensors["linears.1.weight"][:, :-1].copy()


def _not_finite(tensors):
    tensors["linears.0.bias"][0] = np.nan


def _without_norms(tensors):
    del tensors["norms.0.running_var"]


@pytest.mark.parametrize("change", [_without_a_layer, _cut, _not_finite, _without_norms, None])
def test_broken_projections_of_a_file_are_refused(file, change, monkeypatch):
    """Such as one that its user trained."""
    path, _ = file
    content = projections.find("colmap_sift_sv32").read_bytes()
    tensors = load(content)
    if change:
        change(tensors)
    broken = save(tensors) if change else content[:-10]
    monkeypatch.setattr(CompactMap, "_read_projection", lambda self, *parts: None)
    monkeypatch.setattr(CompactMap, "projection", broken, raising=False)
    monkeypatch.setattr(CompactMap, "_suffix", ".safetensors", raising=False)
    with pytest.raises(InputError, match="its projection is broken") as error:
        Localizer(path)
    assert str(error.value).count("\n") == 0
