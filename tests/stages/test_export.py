"""ONNX files: they compute what torch computes, for inputs of every size, and say what they are."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.nn.functional import normalize

import hloc_reduce
from hloc_reduce import export, extractors, projections
from hloc_reduce.confs import features
from hloc_reduce.matchers.lightglue import LightGlue
from hloc_reduce.projections import network
from hloc_reduce.utils.cli import InputError

pytestmark = pytest.mark.check

PIPELINE = export
WHOLE = {"depth_confidence": -1, "width_confidence": -1}


@pytest.fixture(scope="module", autouse=True)
def onnx():
    for name in ("onnxruntime", "onnxscript"):
        pytest.importorskip(name)
    return pytest.importorskip("onnx")


def session(path: Path):
    import onnxruntime

    return onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])


def check_network(path: Path, conf: dict, most: int) -> None:
    """Compare a file with its extractor, which computes the same in another way."""
    extractor = extractors.load(conf["model"]).eval()
    extractor.base.conf["denoise"] = False
    loaded = session(path)
    numbers = []
    for height, width in ((96, 160), (352, 256), (32, 64)):
        image = export._image(height, width)
        outputs = [torch.from_numpy(x) for x in loaded.run(None, {"image": image.numpy()})]
        keypoints, scores, descriptors = outputs
        with torch.no_grad():
            expected = {key: value[0] for key, value in extractor({"image": image}).items()}
        nearest = torch.cdist(expected["keypoints"], keypoints).argmin(dim=1)
        numbers.append(len(keypoints))
        assert len(nearest) == len(nearest.unique()) == len(keypoints) <= most
        for found, wanted in (
            (keypoints, expected["keypoints"]),
            (scores, expected["scores"]),
            (descriptors, expected["descriptors"].T),
        ):
            assert found.dtype == torch.float32
            torch.testing.assert_close(found[nearest], wanted, atol=1e-4, rtol=1e-4)
        torch.testing.assert_close(descriptors.norm(dim=1), torch.ones(len(keypoints)))
    assert numbers[1] > numbers[2] > 0


@pytest.mark.parametrize(
    "name", ["xfeat", "mini64", pytest.param("aliked_t16", marks=pytest.mark.long)]
)
def test_a_network(name, onnx, run, base_weights, tmp_path):
    base_weights(name)
    path = tmp_path / "network.onnx"
    run("--feature", name, "--output", path)
    check_network(path, features.confs[name], 4096)
    loaded = session(path)
    (image,) = loaded.get_inputs()
    assert (image.name, image.shape) == ("image", [1, 3, "height", "width"])
    shapes = {output.name: output.shape for output in loaded.get_outputs()}
    assert shapes == {"keypoints": ["N", 2], "scores": ["N"], "descriptors": ["N", 64]}
    assert loaded.get_modelmeta().custom_metadata_map == {
        "feature": name,
        "dim": "64",
        "hloc_reduce": hloc_reduce.__version__,
        "stride": "32",
        "max_keypoints": "4096",
        "left_out": "resizing to at most 1600 pixels, noise reduction",
    }
    assert loaded.get_modelmeta().producer_name == "hloc-reduce"
    assert str(Path(export.__file__).parent).encode() not in path.read_bytes()
    # sizes but for one NonZero at the end are constants, see docs/export.md on TensorRT
    graph = onnx.load(path).graph
    constants = {value.name for value in graph.initializer}
    (top,) = (node for node in graph.node if node.op_type == "TopK")
    assert top.input[1] in constants
    assert [node.op_type for node in graph.node].count("NonZero") == 1


def test_a_network_with_options_and_a_projection(run, base_weights, tmp_path):
    base_weights("edgepoint2_t32")
    (tmp_path / "few.yaml").write_text(
        "model: {name: edgepoint2, model_name: T32, max_keypoints: 100, denoise: false}\n"
        "preprocessing: {resize_max: null}\n"
    )
    torch.manual_seed(0)
    mlp = network.MLP((32, 48, 16)).eval()
    network.save(mlp, {"descriptor": "edgepoint2_t32"}, tmp_path / "own.safetensors")
    options = ("--feature", tmp_path / "few.yaml", "--projection", tmp_path / "own.safetensors")
    path = tmp_path / "own.onnx"
    run(*options, "--output", path)
    _, conf = features.get(str(options[1]), options[3])
    check_network(path, conf, 100)
    metadata = session(path).get_modelmeta().custom_metadata_map
    assert metadata["feature"] == "own" and metadata["dim"] == "16"
    assert metadata["max_keypoints"] == "100" and metadata["left_out"] == ""
    content = export._network("own", conf)
    keypoints, scores, descriptors = content.expected
    order = torch.randperm(100)
    expected = keypoints[order], scores[order], descriptors[order]
    assert export._check(replace(content, expected=expected), path) < 1e-4
    for expected in (
        (keypoints + 2e-4, scores, descriptors),
        (keypoints, scores.roll(1), descriptors),
        (keypoints, scores, -descriptors),
        (keypoints[1:], scores[1:], descriptors[1:]),
    ):
        with pytest.raises(InputError, match="does not compute what torch computes"):
            export._check(replace(content, expected=expected), path)


@pytest.mark.parametrize("name", ["sift_sv64", "sift_nested@24"])
def test_a_projection(name, run, tmp_path):
    path = tmp_path / "folder/projection.onnx"
    run("--feature", name, "--output", path, "--projection_only")
    project, loaded = projections.load(name), session(path)
    assert loaded.get_inputs()[0].shape == ["N", 128]
    for number in (1, 37, 3000, 0):
        descriptors = torch.nn.functional.normalize(torch.randn(number, 128), dim=1)
        (reduced,) = loaded.run(["reduced"], {"descriptors": descriptors.numpy()})
        np.testing.assert_allclose(reduced, project(descriptors).numpy(), atol=1e-5)
    metadata = loaded.get_modelmeta().custom_metadata_map
    assert metadata["feature"] == name and metadata["dim"] == str(project.dim)
    assert [file.name for file in path.parent.iterdir()] == [path.name]


def test_a_file_that_computes_something_else_is_not_kept(refused, tmp_path, monkeypatch):
    path, write = tmp_path / "projection.onnx", export._write
    path.write_text("before")

    def write_another(content, path):
        write(replace(content, module=projections.load("sift_pca64")), path)

    monkeypatch.setattr(export, "_write", write_another)
    options = ("--feature", "sift_sv64", "--projection_only", "--output", path)
    assert "does not compute what torch computes" in refused(*options)
    assert path.read_text() == "before" and list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("name", ["xfeat_sv32", pytest.param("aliked", marks=pytest.mark.long)])
def test_lightglue(name, onnx, run, base_weights, tmp_path):
    """It computes what the matcher does with all layers and keypoints."""
    base_weights(name.partition("_")[0])
    base_weights(f"{name.partition('_')[0]}+lightglue")
    path = tmp_path / "lightglue.onnx"
    run("--feature", name, "--matcher", "lightglue", "--output", path)
    loaded, matcher = session(path), LightGlue({"features": name, **WHOLE})
    dim, generator = features.dimension(name), torch.Generator().manual_seed(0)
    sizes = torch.tensor([[480.0, 640.0], [900.0, 520.0]])
    for number0, number1 in ((150, 90), (1, 2)):
        described = normalize(torch.randn(150, dim, generator=generator), dim=1)
        places = torch.rand(150, 2, generator=generator) * 500 - 5  # some are outside
        given, pair = {}, {}
        for i, number in enumerate((number0, number1)):
            one = {"keypoints": places[:number], "descriptors": described[:number]}
            given |= {f"{key}{i}": part.numpy() for key, part in one.items()}
            given[f"image_size{i}"] = sizes[i].numpy()
            pair |= {f"keypoints{i}": one["keypoints"][None], f"image_size{i}": sizes[i][None]}
            pair[f"descriptors{i}"] = one["descriptors"].T[None]
        matches, scores = loaded.run(["matches0", "matching_scores0"], given)
        expected = matcher(pair)
        np.testing.assert_array_equal(matches, expected["matches0"][0])
        np.testing.assert_allclose(scores, expected["matching_scores0"][0], atol=1e-4)
        assert (matches >= 0).sum() > 0.5 * number1 or number0 == 1


@pytest.mark.parametrize(
    "options, message",
    [
        (("--feature", "xfeat", "--output", "xfeat.pt"), "xfeat.pt: .* ends with .onnx"),
        (("--feature", "xfaet"), "Unknown feature 'xfaet'.*xfeat"),
        (
            ("--feature", "sift_sv64"),
            "sift_sv64 has the keypoints of DoG.*xfeat, aliked can.*--projection_only",
        ),
        (("--feature", "few.yaml"), "few.yaml"),
        (("--feature", "sift", "--projection_only"), "sift has no projection"),
        (
            ("--feature", "sift_sv64", "--matcher", "lightglue"),
            "lightglue has no weights for sift_sv64",
        ),
        (("--feature", "mini32", "--matcher", "lightglue", "--projection_only"), "not both"),
        (("--feature", "xfeat", "--projection", "no.safetensors"), "no projection file no"),
        (("--feature", "hardnet_pca64", "--projection_only"), "hardnet_pca64 does not ship"),
    ],
)
def test_wrong_input(options, message, refused, tmp_path, monkeypatch, base_weights):
    base_weights("xfeat")
    monkeypatch.chdir(tmp_path)
    if "--output" not in options:
        options = (*options, "--output", "file.onnx")
    assert re.search(message, refused(*options))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "option, preprocessing, message",
    [
        ("max_keypoints: -1", "", "mine: ONNX needs max_keypoints of at least 1, not -1"),
        ("max_keypoints: 9", "preprocessing: {grayscale: true}", "mine takes gray images.*RGB"),
        ("detection_threshold: 0.9999", "", "mine finds no keypoints to check the file with"),
    ],
)
def test_what_a_file_cannot_express_is_refused(
    option, preprocessing, message, refused, tmp_path, base_weights
):
    base_weights("xfeat")
    path = tmp_path / "mine.yaml"
    path.write_text(f"model: {{name: xfeat, {option}}}\n{preprocessing}\n")
    assert re.search(message, refused("--feature", path, "--output", tmp_path / "mine.onnx"))


def test_missing_weights(refused, tmp_path, monkeypatch):
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    monkeypatch.setattr(hloc_reduce.utils.downloads, "urlopen", unreachable)
    message = refused("--feature", "xfeat", "--output", tmp_path / "xfeat.onnx")
    assert "The weights of xfeat are missing" in message


def unreachable(url, timeout):
    raise OSError("unreachable")


def test_missing_packages(refused, tmp_path, monkeypatch):
    monkeypatch.setattr(export, "find_spec", lambda name: None)
    message = refused("--feature", "xfeat", "--output", tmp_path / "xfeat.onnx")
    assert "needs onnx, onnxruntime, onnxscript: pip install 'hloc-reduce[export]'" in message
