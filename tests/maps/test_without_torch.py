"""Localization without torch: the same poses, and nothing that imports it."""

import os
import shutil
import subprocess
import sys
import venv
from importlib.metadata import packages_distributions
from pathlib import Path

import numpy as np
import pytest
import torch
from package_copy import ROOT, copy_package
from safetensors.numpy import load, save

from hloc_reduce import Localizer, compact, export, projections
from hloc_reduce.evaluation.poses import pose_error
from hloc_reduce.hlm.reader import CompactMap
from hloc_reduce.maps import contents
from hloc_reduce.matchers import integers
from hloc_reduce.networks import MINI
from hloc_reduce.projections.layers import project, read
from hloc_reduce.utils import match_files
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.codes import to_integers
from hloc_reduce.utils.images import read_image
from pipelines import localize

pytestmark = pytest.mark.check

PIPELINE = localize
REQUIREMENTS = ROOT / "requirements-light.txt"  # what docs/robot.md installs
BLOCK = """
import sys
from importlib.metadata import packages_distributions

class Absent:
    def find_spec(self, name, path=None, target=None):
        if name in BLOCKED:
            raise ModuleNotFoundError(f"{name} is not installed")

ALLOWED = sys.argv[4].split(",")
BLOCKED = {name for name, of in packages_distributions().items() if not {*of} & {*ALLOWED}}
sys.meta_path.insert(0, Absent())
"""
LOCALIZE = """
import sys

from hloc_reduce import Localizer
from hloc_reduce.utils.cli import InputError

try:
    localizer, camera = Localizer(sys.argv[1], onnx=sys.argv[3] or None), None
    if sys.argv[3]:  # a network's features in these few photos do not determine a focal length
        camera = localizer.reference.camera(localizer.names[0])
    pose, info = localizer.localize(sys.argv[2], camera)
    print(*pose.rotation.quat, *pose.translation, info["num_inliers"], info["confidence"])
except InputError as error:
    print(error)
"""


def without_torch(path: Path, photo: Path, onnx: Path | None = None, threads: int = 1) -> str:
    """Localize a photo in a process where only what `REQUIREMENTS` names can be imported.

    With an ONNX file, onnxruntime can be, too.
    """
    lines = [line for line in REQUIREMENTS.read_text().splitlines() if not line.startswith("#")]
    names = {line.partition(">")[0].lower() for line in lines}
    known = {of for every in packages_distributions().values() for of in every}
    names |= {"cloudpickle", "hloc-reduce", *(["onnxruntime"] if onnx else [])}
    allowed = ",".join(name for name in known if name.lower() in names)
    command = [sys.executable, "-c", BLOCK + LOCALIZE, path, photo, onnx or "", allowed]
    env = os.environ | {"OMP_NUM_THREADS": str(threads)}
    found = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, env=env, timeout=60)
    assert found.returncode == 0, found.stderr
    return found.stdout


@pytest.fixture
def file(place, build_map, tmp_path):
    """A compact map of the plane, and a photo of it."""
    compact.main(tmp_path / "place.hlm", build_map("--feature", "colmap_sift_sv32"))
    return tmp_path / "place.hlm", place[1] / "query/day/a.png"


def test_localization_without_torch(file, monkeypatch):
    """The pose and its confidence are those that torch gives."""
    path, photo = file
    *values, inliers, confidence = map(float, without_torch(path, photo).split())

    monkeypatch.setattr(contents, "is_integer_matcher", lambda matcher: False)
    localizer = Localizer(path)
    assert type(localizer.engine).__name__ == "TorchEngine"
    pose, info = localizer.localize(photo)
    np.testing.assert_allclose([*pose.rotation.quat, *pose.translation], values, atol=1e-9)
    assert (info["num_inliers"], info["confidence"]) == (inliers, confidence)


@pytest.mark.long
def test_the_documented_installation_localizes(file, tmp_path):
    """In a new environment, with the commands of docs/robot.md, without torch."""
    path, photo = file
    source = copy_package(tmp_path / "source")
    for name in ("requirements-light.txt", "constraints.txt"):
        shutil.copy(ROOT / name, source)
    documented = (ROOT / "docs/robot.md").read_text().splitlines()
    install = [line.split()[1:] for line in documented if line.startswith("    pip install")][:2]
    assert len(install) == 2
    venv.create(tmp_path / "venv", with_pip=True)
    python = tmp_path / "venv/bin/python"
    for command in install:
        subprocess.run([python, "-m", "pip", *command], cwd=source, check=True, timeout=900)
    assert subprocess.run([python, "-c", "import torch"], capture_output=True).returncode == 1
    command = [python, "-c", LOCALIZE, path, photo, ""]
    found = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, timeout=60)
    assert found.stdout == without_torch(path, photo), found.stderr


def test_one_and_two_threads_give_the_same_pose(file):
    """To the last digit, without torch and with it."""
    path, photo = file
    one, two = (without_torch(path, photo, threads=number) for number in (1, 2))
    assert one == two and len(one.split()) == 9
    before, found = torch.get_num_threads(), []
    try:
        for number in (1, 2):
            torch.set_num_threads(number)
            localizer = Localizer(path)
            assert localizer.workers == number
            pose, info = localizer.localize(photo)
            values = *pose.rotation.quat, *pose.translation, info["num_inliers"]
            found.append((*map(float, values), float(info["confidence"])))
    finally:
        torch.set_num_threads(before)
    assert found[0] == found[1]


def test_features_retrieval_and_matches_are_those_of_torch(file, monkeypatch):
    path, photo = file
    light = contents.read(path)
    monkeypatch.setattr(contents, "is_integer_matcher", lambda matcher: False)
    heavy = contents.read(path)
    found = [one.engine.extract(photo, one.preprocessing) for one in (light, heavy)]
    for key in ("keypoints", "image_size", "uncertainty", "blur"):
        np.testing.assert_array_equal(*(one[key] for one in found))
    rounded = [one["descriptors"].T.astype(np.float16) for one in found]
    np.testing.assert_array_equal(*rounded)
    query = rounded[0].astype(np.float32)
    both = light, heavy
    described = light.describe({"descriptors": query.T}, photo, 0)
    assert light.retrieve(described, 9) == heavy.retrieve(described, 9)
    matched = [one.steps[0].match({"descriptors": query.T}, one.names) for one in both]
    for name in light.names:
        np.testing.assert_array_equal(*(pairs[name] for pairs in matched))
    assert any(len(pairs) > 50 for pairs in matched[0].values())


@pytest.mark.parametrize("ratio_threshold", [None, 0.8])
@pytest.mark.parametrize("number", [0, 1, 2, 300])
@pytest.mark.parametrize("products", [700, 2**23])
def test_images_of_points_are_matched_one_by_one(ratio_threshold, number, products, monkeypatch):
    """What images share is searched once, in parts, or at once where that is faster."""
    monkeypatch.setattr(integers, "PRODUCTS_PER_TASK", products)
    generator = np.random.default_rng(0)
    drawn = generator.standard_normal((100 + number, 16)).astype(np.float32)
    drawn[100 : 100 + number // 2] = drawn[: number // 2] + 0.02 * drawn[-(number // 2) or 100 :]
    drawn = to_integers(drawn / np.linalg.norm(drawn, axis=1, keepdims=True))
    points, query = drawn[:100], drawn[100:]
    images = [np.sort(generator.permutation(100)[:size]) for size in (0, 1, 2, 40, 100)]
    found = integers.match_images_of_points(points, query, images, ratio_threshold, 0.7)
    assert len(found) == len(images)
    for rows, pairs in zip(images, found, strict=True):
        matches, cosine = integers.mutual_nearest(points[rows], query, ratio_threshold, None, 0.7)
        own = np.flatnonzero(matches >= 0)
        expected = integers.most_similar_first(matches[own], own, cosine[own])
        np.testing.assert_array_equal(pairs, expected)
    assert len(found[-1]) >= number // 3


def test_matches_are_in_the_order_of_a_match_file():
    """Localizer ordered them by exact cosines, and found another confidence than the pipeline."""
    generator = np.random.default_rng(0)
    cosine = (0.9 + 1e-4 * generator.random(200)).astype(np.float32)  # many equal as float16
    rows0, rows1 = generator.permutation(500)[:200], generator.permutation(300)[:200]
    found = integers.most_similar_first(rows0, rows1, cosine)
    by_query = np.argsort(rows0)
    pairs = np.stack([rows0, rows1], axis=1)[by_query]
    scores = ((cosine[by_query] + 1) / 2).astype(np.float16)
    assert len(np.unique(scores)) < 20
    np.testing.assert_array_equal(found, match_files.most_similar_first(pairs, scores))


def test_features_that_need_torch(place, run, tmp_path):
    """Patches are described by kornia."""
    build, images, outputs = place
    run(*build, "--feature", "sift_sv32")
    compact.main(tmp_path / "place.hlm", outputs / "map")
    localizer = Localizer(tmp_path / "place.hlm")
    assert type(localizer.engine).__name__ == "TorchEngine"
    pose, _ = localizer.localize(images / "query/day/a.png")
    assert pose is not None
    for path, said in ((tmp_path / "place.hlm", "the feature sift_sv32"), (outputs / "map", "map")):
        message = without_torch(path, images / "query/day/a.png")
        assert said in message and "needs torch. Without torch, compact maps" in message


@pytest.mark.parametrize("feature", [MINI[0], pytest.param(MINI[1], marks=pytest.mark.long)])
def test_networks_run_by_onnx_runtime(feature, place, run, tmp_path):
    """Their poses are those of torch, but for rounding; also where the sides are no multiples."""
    build, images, outputs = place
    run(*build, "--feature", feature)
    path, photo = tmp_path / "place.hlm", images / "query/day/a.png"
    compact.main(path, outputs / "map")
    onnx = export.main(feature, tmp_path / "network.onnx")
    expected, found = Localizer(path), Localizer(path, onnx=onnx)
    assert type(found.engine).__name__ == "NumpyEngine"
    pixels, camera = read_image(photo), expected.reference.camera(expected.names[0])
    for image in (pixels, pixels[:-7, :-19]):
        camera.height, camera.width = image.shape[:2]
        pose, info = found.localize(image, camera)
        other, its_info = expected.localize(image, camera)
        assert info["num_inliers"] > 0.9 * its_info["num_inliers"] > 50
        assert pose_error(pose, other)[1] < 1
    if feature == MINI[0]:
        pose, info = found.localize(photo, found.reference.camera(found.names[0]))
        *values, inliers, _ = map(float, without_torch(path, photo, onnx).split())
        np.testing.assert_allclose([*pose.rotation.quat, *pose.translation], values, atol=1e-6)
        assert info["num_inliers"] == inliers
        assert "needs torch" in without_torch(path, photo)
    for wrong, message in (
        (path.with_name("none.onnx"), "There is no file"),
        (path, "is not a feature of hloc_reduce.export"),
    ):
        with pytest.raises(InputError, match=message) as error:
            Localizer(path, onnx=wrong)
        assert str(error.value).count("\n") == 0
    with pytest.raises(InputError, match="needs a compact map"):
        Localizer(path.parent / "outputs/map", onnx=onnx)


def test_lightglue_run_by_onnx_runtime(place, run, tmp_path, base_weights, monkeypatch):
    """In a map that was matched by nearest neighbours, for a photo that these do not localize."""
    base_weights("xfeat+lightglue")
    build, images, outputs = place
    run(*build, "--feature", "mini32", "--storage", "uint2")
    path, photo = tmp_path / "place.hlm", images / "query/day/a.png"
    compact.main(path, outputs / "map")
    onnx = export.main("mini32", tmp_path / "mini32.onnx")
    lightglue = export.main("mini32", tmp_path / "lightglue.onnx", matcher="lightglue")
    files = {"onnx": onnx, "matcher_onnx": lightglue}
    found, expected = (
        Localizer(path, matcher="lightglue", **given) for given in (files, {"onnx": None})
    )
    assert type(found.engine).__name__ == "NumpyEngine"
    assert type(expected.engine).__name__ == "TorchEngine"
    camera = found.reference.camera(found.names[0])
    (pose, info), (other, its_info) = (one.localize(photo, camera) for one in (found, expected))
    assert info["num_inliers"] > 0.9 * its_info["num_inliers"] > 50 and not info["again"]
    assert pose_error(pose, other)[1] < 1
    both = Localizer(path, matcher="NN+lightglue", **files)
    assert not both.localize(photo, camera)[1]["again"]
    (nearest, gate), second = both.steps
    nothing = {name: np.zeros((0, 2), np.int64) for name in both.names}
    monkeypatch.setattr(both, "steps", [(lambda *_: nothing, gate), second])
    again, its_info = both.localize(photo, camera)
    assert its_info["again"] and its_info["num_inliers"] == info["num_inliers"]
    np.testing.assert_array_equal(again.matrix(), pose.matrix())
    black = np.zeros((240, 320, 3), np.uint8)
    assert found.localize(black)[0] is None
    other_feature = export.main("mini64", tmp_path / "mini64.onnx", matcher="lightglue")
    for wrong, message in (
        ({**files, "matcher_onnx": onnx}, "is not a matcher of hloc_reduce.export"),
        ({**files, "matcher_onnx": other_feature}, "matches mini64, the map has mini32"),
        ({"onnx": onnx}, "needs torch or, if it is lightglue, an ONNX file of its own"),
        ({"matcher_onnx": lightglue}, "needs one of the feature, too"),
        ({**files, "matcher": "NN-mutual"}, "needs no .*lightglue.onnx: give the matcher"),
    ):
        with pytest.raises(InputError, match=message):
            Localizer(path, **{"matcher": "lightglue", **wrong})
    with pytest.raises(InputError, match="Unknown matcher 'glue'"):
        Localizer(path, matcher="glue")


NAMES = ["sift_sv64", "mkd_us16", "colmap_sift_sv32", "xfeat_pca24", "sift_nested@24"]


@pytest.mark.parametrize("name", NAMES)
def test_projections_agree_with_torch(name):
    file, prefix = projections.find(name), projections.split_prefix(name)[1]
    layers = read(file.read_bytes(), prefix)
    expected = projections.load(name)
    generator = np.random.default_rng(0)
    descriptors = generator.standard_normal((500, expected.sizes[0])).astype(np.float32)
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    found = project(descriptors, layers)
    assert found.shape == (500, expected.dim) and found.dtype == np.float32
    of_torch = expected(torch.from_numpy(descriptors)).numpy()
    np.testing.assert_array_equal(found.astype(np.float16), of_torch.astype(np.float16))
    assert project(descriptors[:0], layers).shape == (0, expected.dim)


@pytest.mark.parametrize("prefix", ["0", "65", "x", "-1"])
def test_prefixes_that_a_projection_does_not_have(prefix):
    content = projections.find("sift_nested").read_bytes()
    with pytest.raises(ValueError, match="of no use"):
        read(content, prefix)
    with pytest.raises(ValueError, match="of no use"):
        read(projections.find("sift_sv64").read_bytes(), "24")


def _without_a_layer(tensors):
    del tensors["linears.1.weight"]


def _cut(tensors):
    tensors["linears.1.weight"] = tensors["linears.1.weight"][:, :-1].copy()


def _not_finite(tensors):
    tensors["linears.0.bias"][0] = np.nan


def _without_norms(tensors):
    del tensors["norms.0.running_var"]


def test_broken_projections_of_a_file_are_refused(file, monkeypatch):
    """Such as one that its user trained."""
    path, _ = file
    content = projections.find("colmap_sift_sv32").read_bytes()
    broken = [content[:-10]]
    for change in (_without_a_layer, _cut, _not_finite, _without_norms):
        tensors = load(content)
        change(tensors)
        broken.append(save(tensors))
    monkeypatch.setattr(CompactMap, "_read_projection", lambda self, *parts: None)
    monkeypatch.setattr(CompactMap, "_suffix", ".safetensors", raising=False)
    for one in broken:
        monkeypatch.setattr(CompactMap, "projection", one, raising=False)
        with pytest.raises(InputError, match="its projection is broken") as error:
            Localizer(path)
        assert str(error.value).count("\n") == 0
