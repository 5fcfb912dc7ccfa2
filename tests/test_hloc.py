"""The plugin: with a test double of what it needs of hloc, and with the real hloc (`-m hloc`)."""

import argparse
import importlib
import re
import sys
from importlib.machinery import ModuleSpec
from importlib.util import find_spec

import cv2
import h5py
import numpy as np
import pycolmap
import pytest
import torch
from packaging.version import Version
from scipy.io import savemat
from test_projections import trained
from torch.nn.functional import normalize

import hloc_reduce
from hloc_reduce import extractors, localize_sfm, match_features, projections, triangulation
from hloc_reduce import hloc as plugin
from hloc_reduce.confs import features
from hloc_reduce.confs.matchers import confs as matchers
from hloc_reduce.evaluation.poses import pose_error
from hloc_reduce.hloc import __main__ as command
from hloc_reduce.matchers.nearest_neighbor import NearestNeighbor
from hloc_reduce.projections import network
from hloc_reduce.training import __main__ as training
from hloc_reduce.training import tracks
from hloc_reduce.utils import cli, parsers
from hloc_reduce.utils.cli import InputError

# --- a test double: what the plugin needs of hloc, and no more

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
    "extract_features.py": EXTRACT_FEATURES,
    "match_features.py": 'confs = {"NN-ratio": {"output": "hlocs own"}}',
    "broken.py": "import not_there",
}


@pytest.fixture
def forgotten(monkeypatch):
    """Forget what was imported of hloc, before and after a test."""
    for name in [name for name in sys.modules if name.partition(".")[0] == "hloc"]:
        monkeypatch.delitem(sys.modules, name)
    yield
    for name in [name for name in sys.modules if name.partition(".")[0] == "hloc"]:
        del sys.modules[name]


@pytest.fixture
def double(tmp_path, monkeypatch, forgotten):
    """A package `hloc` to import, as a folder."""
    folder = tmp_path / "double/hloc"
    for name, source in MODULES.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(source)
    monkeypatch.syspath_prepend(str(folder.parent))
    return folder


def run(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["hloc", *map(str, arguments)])
    cli.run(command._main)


@pytest.fixture
def propagated(monkeypatch):
    monkeypatch.setattr(cli.logger, "propagate", True)  # for caplog


def test_registered_extractors_are_loaded_by_name(double):
    hloc_reduce.register()
    package = importlib.import_module("hloc.extractors")
    load = importlib.import_module("hloc.utils.base_model").dynamic_load
    conf = importlib.import_module("hloc.extract_features").confs["sift_sv16"]["model"]
    image = {"image": torch.rand(1, 1, 120, 160)}
    found = load(package, conf["name"])(conf).eval()(image)
    expected = extractors.load(features.confs["sift_sv16"]["model"]).eval()(image)
    torch.testing.assert_close(found["descriptors"], expected["descriptors"])
    # as float32 hloc would round them to float16
    assert found["keypoints"].dtype == torch.float64
    assert load(package, "reduced")({"name": "reduced"}).detection_noise == 1
    vlad = load(package, "vlad")({"name": "vlad"})(image)["global_descriptor"]
    assert vlad.shape == (1, 64 * 64) and vlad.norm() == pytest.approx(1, abs=1e-5)


def test_confs_are_added_once_and_none_is_replaced(double):
    added = hloc_reduce.register()
    confs = importlib.import_module("hloc.extract_features").confs
    assert confs["sift"]["output"] == "feats-sift" and "sift" not in added
    assert features.confs.keys() <= confs.keys() and {"vlad", "sift_nested@24"} < set(added)
    assert confs["mkd"]["model"] == {"name": "reduced", "base": features.base("mkd")}
    matcher_confs = importlib.import_module("hloc.match_features").confs
    assert matcher_confs["NN-ratio"] == {"output": "hlocs own"}
    assert matcher_confs["NN-mutual"] == matchers["NN-mutual"]
    before = {**confs}
    assert hloc_reduce.register() == [] and confs == before
    path = importlib.import_module("hloc.extractors").__path__
    assert len(path) == 2


def test_confs_are_copies(double):
    """hloc's users change an entry in place, for themselves only."""
    hloc_reduce.register()
    confs = importlib.import_module("hloc.extract_features").confs
    confs["sift_sv64"]["preprocessing"]["resize_max"] = 7
    for conf in (confs["sift_sv32"], confs["vlad"], features.confs["sift_sv64"]):
        assert conf["preprocessing"]["resize_max"] == 1600


def test_a_broken_hloc_and_a_folder_of_its_name(double, monkeypatch):
    (double / "__init__.py").write_text("import not_there")
    with pytest.raises(InputError, match="hloc cannot be imported .*not_there"):
        hloc_reduce.register()
    # what Python finds where a folder has the name but is no package
    monkeypatch.setattr("hloc_reduce.utils.hloc.find_spec", lambda name: ModuleSpec(name, None))
    with pytest.raises(InputError, match="hloc is not installed"):
        hloc_reduce.register()


def test_features_of_files_are_registered_by_their_names(double, tmp_path):
    (tmp_path / "mine.yaml").write_text("model: {name: dog, max_keypoints: 7}")
    assert "mine" in hloc_reduce.register([tmp_path / "mine.yaml"])
    conf = importlib.import_module("hloc.extract_features").confs["mine"]
    base = {"name": "dog", "max_keypoints": 7, "keypoints": "adaptive"}
    assert conf["model"] == {"name": "reduced", "base": base}
    assert hloc_reduce.register([tmp_path / "mine.yaml"]) == []
    (tmp_path / "sift.yaml").write_text("model: {name: dog, max_keypoints: 7}")
    with pytest.raises(InputError, match="has a feature sift already: rename .*sift.yaml"):
        hloc_reduce.register([tmp_path / "sift.yaml"])


def test_a_missing_hloc_is_named(monkeypatch, forgotten):
    for module in ("utils.hloc", "extractors"):
        monkeypatch.setattr(f"hloc_reduce.{module}.is_installed", lambda: False)
    with pytest.raises(InputError, match="hloc is not installed: pip install"):
        hloc_reduce.register()
    with pytest.raises(InputError, match="Unknown extractor 'disk'"):
        extractors.load({"name": "disk"})
    with pytest.raises(InputError, match="hloc is not installed"):
        extractors.load({"name": "hloc.dog"})


@pytest.mark.parametrize(
    "init",
    [
        '__version__ = "1.4"',
        '__version__ = "1.5"',
        INIT.replace("3.13.0", "3.12.6"),
    ],
)
def test_an_old_hloc_is_refused(double, init):
    (double / "__init__.py").write_text(init)
    with pytest.raises(InputError, match="too old.*--upgrade"):
        hloc_reduce.register()


@pytest.mark.parametrize("init", ['__version__ = "1.6"', INIT.replace("3.13.0", "4.2.2")])
def test_a_newer_hloc_is_taken(double, init):
    (double / "__init__.py").write_text(init)
    assert "sift_sv64" in hloc_reduce.register()


@pytest.mark.parametrize(("version", "warned"), [("4.2.1", True), ("4.2.0", False), ("dev", True)])
def test_a_pycolmap_without_points_is_warned_of_once(
    double, version, warned, monkeypatch, caplog, propagated
):
    monkeypatch.setattr(pycolmap, "__version__", version)
    hloc_reduce.register()
    hloc_reduce.register()
    warnings = [record for record in caplog.records if record.levelname == "WARNING"]
    assert len(warnings) == warned
    assert all("\n" not in record.getMessage() for record in warnings)


def test_modules_run_with_the_confs(double, monkeypatch, capsys):
    run(monkeypatch, "extract_features", "--conf", "sift_sv64")
    assert capsys.readouterr().out == "feats-dog-sift_sv64\n"


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("extract", "hloc.extract cannot be imported"),
        ("broken", "hloc.broken cannot be imported .*not_there"),
        ("match_features", "hloc.match_features has no command line"),
        ("extractors", "hloc.extractors has no command line"),
    ],
)
def test_what_cannot_run_is_one_clear_line(double, name, message, monkeypatch, caplog, propagated):
    with pytest.raises(SystemExit) as exit:
        run(monkeypatch, name)
    assert exit.value.code == 2
    (error,) = [r.getMessage() for r in caplog.records if r.levelname == "ERROR"]
    assert re.search(message, error)


def test_an_extractor_of_hlocs_is_a_base(double, tmp_path):
    model = extractors.load({"name": "reduced", "base": {"name": "dots", "number": 3}})
    assert model.detection_noise == 2 and model.base.descriptor == "hloc.dots"
    found = model({"image": torch.rand(1, 3, 40, 40)})
    assert found["keypoints"].shape == (1, 3, 2) and found["scores"].shape == (1, 3)
    torch.testing.assert_close(found["descriptors"], torch.eye(256)[None, :, :3])
    with pytest.raises(InputError, match="for sift, not for hloc.dots"):
        extractors.load({"name": "reduced", "base": {"name": "dots"}, "projection": "sift_sv16"})
    with pytest.raises(InputError, match="hloc's extractor dots fails .*grayscale"):
        model({"image": torch.rand(1, 1, 40, 40)})
    with pytest.raises(InputError, match="Unknown extractor 'dosts'. There are: dots"):
        extractors.load({"name": "dosts"})


def test_descriptors_that_are_not_on_the_device_of_the_image(double):
    """As those of hloc's dog are not, which describes on the CPU."""
    model = extractors.load({"name": "dots"})
    found = model({"image": torch.empty(1, 3, 40, 40, device="meta")})
    assert found["descriptors"].device.type == "meta"


def test_what_determines_descriptors_is_in_their_name(double):
    model = extractors.load({"name": "dots", "weights": "indoor"})
    assert model.descriptor == "hloc.dots.indoor"


def test_projections_of_other_dimensions_are_refused_with_both(double, tmp_path):
    file = tmp_path / "p.safetensors"
    network.save(trained((128, 16)), {}, file)
    conf = {"name": "reduced", "base": {"name": "dots"}, "projection": str(file)}
    with pytest.raises(InputError, match="for 128-D .* have 256"):
        extractors.load(conf)({"image": torch.rand(1, 3, 40, 40)})


def test_a_base_of_hlocs_is_trained_on(double, tmp_path, monkeypatch):
    """The command line: the name of the file, the dimensions, and what the metadata say."""
    (tmp_path / "mine.yaml").write_text(
        "model: {name: dots, number: 3}\npreprocessing: {grayscale: false}"
    )
    maps = tmp_path / "town/images", tmp_path / "town/sparse"
    for folder in maps:
        folder.mkdir(parents=True)
    found = np.random.default_rng(0).standard_normal((90, 2, 2, 256)).astype(np.float16)
    columns = np.arange(90) // 3, np.arange(90), np.zeros((90, 2), np.float32), np.ones(90, bool)
    asked = []
    monkeypatch.setattr(tracks, "main", lambda *given: asked.append(given) or tmp_path / "t")
    monkeypatch.setattr(tracks, "load", lambda _: tracks.Tracks(found, *columns))
    (tmp_path / "t").touch()
    arguments = "--base", tmp_path / "mine.yaml", "--scheme", "pca", "--output", tmp_path
    arguments = *arguments, "--map", ":".join(map(str, maps))
    train(monkeypatch, *arguments, "--dim", 16)
    assert asked[0][3] == "mine" and asked[0][-1]["preprocessing"]["grayscale"] is False
    file = tmp_path / "mine_pca16.safetensors"
    projection = projections.load(file)
    assert projection.sizes == (256, 16)
    assert projection.metadata["descriptor"] == "hloc.dots"
    assert projection.metadata["base"]["model"] == {"name": "dots", "number": 3}
    _, conf = features.get(str(tmp_path / "mine.yaml"), file)
    reduced = extractors.load(conf["model"])({"image": torch.rand(1, 3, 40, 40)})
    assert reduced["descriptors"].shape == (1, 16, 3)
    with pytest.raises(InputError, match="for hloc.dots, not for sift"):
        extractors.load({**conf["model"], "base": features.base("sift")})
    with pytest.raises(InputError, match="mine descriptors are 256-D: --dim 300 is too large"):
        train(monkeypatch, *arguments, "--dim", 300)
    with pytest.raises(InputError, match="not the patches of PhotoTour"):
        train(monkeypatch, *arguments, "--phototour", tmp_path)


def train(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["training", *map(str, arguments)])
    training._main()


# --- the real hloc


@pytest.fixture
def registered(forgotten):
    if find_spec("hloc") is None:
        pytest.skip("hloc is not installed")
    hloc_reduce.register()


STAGES = [
    "extract_features",
    "pairs_from_covisibility",
    "match_features",
    "triangulation",
    "pairs_from_retrieval",
    "localize_sfm",
]


def modules(*of_hloc):
    """The modules of the stages, of hloc or of this project."""
    return {
        name: importlib.import_module(f"{'hloc' if name in of_hloc else 'hloc_reduce'}.{name}")
        for name in STAGES
    }


def localized(stages, dataset, outputs, feature):
    """Run a chain of stages; return the pose errors of the queries (metres, degrees) by name."""
    images, model = dataset / "images_upright", dataset / "3D-models/aachen_v_1_1"
    conf, matcher = stages["extract_features"].confs[feature], matchers["NN-ratio"]
    sfm_pairs, loc_pairs = outputs / "pairs-db.txt", outputs / "pairs-query.txt"
    local = stages["extract_features"].main(conf, images, outputs)
    stages["pairs_from_covisibility"].main(model, sfm_pairs, 3)
    sfm_matches = stages["match_features"].main(matcher, sfm_pairs, local.stem, outputs)
    stages["triangulation"].main(outputs / "sfm", model, images, sfm_pairs, local, sfm_matches)
    vlad = importlib.import_module("hloc.extract_features")
    retrieved = vlad.main(vlad.confs["vlad"], images, outputs)
    stages["pairs_from_retrieval"].main(
        retrieved, loc_pairs, 4, query_prefix=["query"], db_prefix=["db"]
    )
    loc_matches = stages["match_features"].main(matcher, loc_pairs, local.stem, outputs)
    stages["localize_sfm"].main(
        outputs / "sfm",
        dataset / "queries/*_time_queries_with_intrinsics.txt",
        loc_pairs,
        local,
        loc_matches,
        outputs / "poses.txt",
        prepend_camera_name=True,
    )
    return errors(outputs / "poses.txt", dataset)


def errors(poses, dataset):
    """The errors (metres, degrees) of the poses that are in a file, by folder/basename."""
    truth = parsers.parse_poses(dataset / "queries/ground_truth_poses.txt")
    truth = {"/".join(name.split("/")[-2:]): pose for name, pose in truth.items()}
    estimates = parsers.parse_poses(poses)
    return {name: pose_error(pose, truth[name]) for name, pose in estimates.items()}


HLOCS_TRIANGULATION = Version(pycolmap.__version__) < plugin.NO_POINTS
HLOCS_SIFT = "hloc's own features"  # float16 keypoints
CHAINS = {
    HLOCS_SIFT: ["extract_features"],
    "hloc's": [name for name in STAGES if name != "triangulation" or HLOCS_TRIANGULATION],
    "hloc's features and map": ["extract_features"] + ["triangulation"] * HLOCS_TRIANGULATION,
    "hloc's matches": ["match_features"],
    "hloc's localization": ["pairs_from_retrieval", "localize_sfm"],
    "hloc's features and matches": ["extract_features", "match_features"],
}


@pytest.mark.hloc
@pytest.mark.parametrize("ratio_threshold", [None, 0.9])
@pytest.mark.parametrize("distance_threshold", [None, 1.1])
@pytest.mark.parametrize("do_mutual_check", [True, False])
def test_matches_are_hlocs(registered, ratio_threshold, distance_threshold, do_mutual_check):
    conf = {
        "name": "nearest_neighbor",
        "ratio_threshold": ratio_threshold,
        "distance_threshold": distance_threshold,
        "do_mutual_check": do_mutual_check,
    }
    theirs = importlib.import_module("hloc.matchers.nearest_neighbor").NearestNeighbor(conf)
    ours = NearestNeighbor(conf)
    generator = torch.Generator().manual_seed(0)
    for n, m in ((300, 200), (200, 1), (1, 7)):
        first, second = (torch.randn(1, 8, k, generator=generator) for k in (n, m))
        data = {"descriptors0": normalize(first, dim=1), "descriptors1": normalize(second, dim=1)}
        expected = theirs(data)["matches0"]
        assert torch.equal(ours(data)["matches0"], expected)
        assert (expected >= 0).any()


@pytest.mark.hloc
@pytest.mark.parametrize("chain", CHAINS)
def test_any_chain_of_stages_localizes(registered, aachen_layout, tmp_path, chain):
    feature = "sift" if chain == HLOCS_SIFT else "sift_sv32"
    found = localized(modules(*CHAINS[chain]), aachen_layout, tmp_path / "outputs", feature)
    if chain == HLOCS_SIFT:
        with h5py.File(tmp_path / "outputs/feats-sift.h5") as file:
            assert file["db/1.png/keypoints"].dtype == np.float16
    for name in ("day/a.png", "night/a.png"):
        assert found[name][0] < 0.02 and found[name][1] < 0.5


@pytest.mark.hloc
def test_hlocs_aachen_pipeline(registered, aachen_layout, tmp_path, monkeypatch):
    """The code of hloc's pipeline, whose three confs are this project's."""
    extract = importlib.import_module("hloc.extract_features")
    match = importlib.import_module("hloc.match_features")
    monkeypatch.setitem(extract.confs, "netvlad", extract.confs["vlad"])
    monkeypatch.setitem(extract.confs, "superpoint_max", extract.confs["sift_sv64"])
    monkeypatch.setitem(match.confs, "superglue", match.confs["NN-ratio"])
    pipeline = importlib.import_module("hloc.pipelines.Aachen_v1_1.pipeline")
    if not HLOCS_TRIANGULATION:  # the modules to exchange with such a pycolmap
        monkeypatch.setattr(pipeline, "triangulation", triangulation)
        monkeypatch.setattr(pipeline, "localize_sfm", localize_sfm)
    outputs = tmp_path / "outputs"
    outputs.mkdir()
    pipeline.run(argparse.Namespace(dataset=aachen_layout, outputs=outputs, num_covis=3, num_loc=4))
    (poses,) = outputs.glob("Aachen-v1.1_hloc_*.txt")
    truth = parsers.parse_poses(aachen_layout / "queries/ground_truth_poses.txt")
    found = []
    for line in poses.read_text().splitlines():
        (tmp_path / "one.txt").write_text(line)
        ((name, pose),) = parsers.parse_poses(tmp_path / "one.txt").items()
        found.append((name, pose_error(pose, truth["query/day/a.png"])[0] < 0.02))
    assert sorted(found) == [("a.png", True), ("a.png", True), ("grey.png", False)]


@pytest.mark.hloc
def test_a_module_of_hlocs_runs_from_the_shell(registered, aachen_layout, tmp_path, monkeypatch):
    (tmp_path / "mine.yaml").write_text(
        "model: {name: reduced, base: {name: dog, max_keypoints: 50}, projection: sift_sv16}"
    )
    images = aachen_layout / "images_upright"
    run(
        monkeypatch,
        *("--feature", tmp_path / "mine.yaml"),
        *("extract_features", "--conf", "mine", "--image_dir", images, "--export_dir", tmp_path),
    )
    with h5py.File(tmp_path / "feats-mine.h5") as file:
        assert file["db/1.png/descriptors"].shape == (16, 50)
        assert file["db/1.png/keypoints"].dtype == np.float64


@pytest.mark.hloc
@pytest.mark.parametrize("name", ["hloc.dog", "hloc.disk"])
def test_an_extractor_of_the_real_hlocs_is_a_base(registered, name, monkeypatch, textured):
    if name == "hloc.disk":  # whose weights need a network
        from kornia.feature import DISK

        monkeypatch.setattr(DISK, "from_pretrained", lambda _: DISK())
    file = {"name": name, **({"max_keypoints": 40} if name == "hloc.disk" else {})}
    model = extractors.load({"name": "reduced", "base": file}).eval()
    assert (
        model.base.descriptor
        == {
            "hloc.dog": "hloc.dog.rootsift",
            "hloc.disk": "hloc.disk.depth",
        }[name]
    )
    channels = 3 if name == "hloc.disk" else 1
    image = torch.from_numpy(textured / np.float32(255)).expand(1, channels, -1, -1)
    found = model({"image": image})
    number = found["keypoints"].shape[1]
    assert number > 10 and found["descriptors"].shape == (1, 128, number)
    torch.testing.assert_close(found["descriptors"].norm(dim=1), torch.ones(1, number))
    with pytest.raises(InputError, match="for sift, not for hloc"):
        extractors.load({"name": "reduced", "base": file, "projection": "sift_sv64"})


@pytest.mark.hloc
def test_hlocs_inloc_reads_features_and_matches(registered, tmp_path):
    """A query and two scans with known points, matched by this project."""
    generator = np.random.default_rng(0)
    size, focal, number = (640, 480), 4032 * 28 / 36, 120
    pixels = np.array([3, 5]) + np.column_stack(
        np.unravel_index(generator.choice(600 * 400, 2 * number, replace=False), (600, 400))
    )
    points = np.column_stack([generator.uniform(-0.5, 0.5, (2 * number, 2)), np.zeros(2 * number)])
    points[:, 2] = generator.uniform(5, 6, 2 * number)
    rotation = pycolmap.Rotation3d(np.array([0.02, -0.01, 0.03, 1]) / 1.0007)
    truth = pycolmap.Rigid3d(rotation, np.array([0.1, -0.2, 0.3]))
    camera = pycolmap.Camera(
        model="SIMPLE_PINHOLE", width=size[0], height=size[1], params=[focal, 320, 240]
    )
    seen = camera.img_from_cam((truth.rotation.matrix() @ points.T).T + truth.translation)
    descriptors = generator.standard_normal((64, 2 * number))
    descriptors = (descriptors / np.linalg.norm(descriptors, axis=0)).astype(np.float16)
    query = "query/iphone7/IMG_0.JPG"
    scans = [f"database/cutouts/DUC1/02{i}/DUC_cutout_02{i}_0_0.jpg" for i in range(2)]
    for name in (query, *scans):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(tmp_path / name), np.zeros((480, 640), np.uint8))
    poses = tmp_path / "database/alignments/DUC1/transformations"
    poses.mkdir(parents=True)
    with h5py.File(tmp_path / "features.h5", "w") as file:
        file[f"{query}/keypoints"] = seen.astype(np.float32)
        file[f"{query}/descriptors"] = descriptors
        for i, name in enumerate(scans):
            half = slice(i * number, (i + 1) * number)
            file[f"{name}/keypoints"] = pixels[half].astype(np.float32)
            file[f"{name}/descriptors"] = descriptors[:, half]
            scan = np.full((480, 640, 3), np.nan)
            scan[pixels[half, 1], pixels[half, 0]] = points[half]
            savemat(tmp_path / f"{name}.mat", {"XYZcut": scan})
            rows = "\n".join(" ".join(map(str, row)) for row in np.eye(4))
            (poses / f"DUC_trans_02{i}.txt").write_text("\n" * 7 + rows + "\n")
    pairs = tmp_path / "pairs.txt"
    pairs.write_text("".join(f"{query} {name}\n" for name in scans))
    matches = tmp_path / "matches.h5"
    match_features.main(matchers["NN-mutual"], pairs, tmp_path / "features.h5", matches=matches)
    inloc = importlib.import_module("hloc.localize_inloc")
    inloc.main(tmp_path, pairs, tmp_path / "features.h5", matches, tmp_path / "poses.txt")
    estimate = parsers.parse_poses(tmp_path / "poses.txt")["IMG_0.JPG"]
    metres, degrees = pose_error(estimate, truth)
    assert metres < 0.01 and degrees < 0.1
