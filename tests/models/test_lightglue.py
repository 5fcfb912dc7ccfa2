"""LightGlue: published weights, adapters for projected descriptors, and what it refuses."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
import yaml
from command import outcome
from kornia.feature import LightGlue as KorniaLightGlue
from safetensors.torch import load_file, save_file
from torch.nn.functional import normalize

from hloc_reduce import Localizer, compact, extract_features, extractors, matchers, projections
from hloc_reduce.confs import features as features_confs
from hloc_reduce.confs import matchers as matchers_confs
from hloc_reduce.matchers.lightglue import CONSTANT, LightGlue
from hloc_reduce.networks import lightglue
from hloc_reduce.networks.lightglue import LIGHTGLUE
from hloc_reduce.training import adapters
from hloc_reduce.utils import downloads
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.parsers import parse_query_list
from pipelines import localize

PIPELINE = localize

CONF = {"name": "lightglue"}
SIZE = torch.tensor([640.0, 480.0])


def photos(descriptors: torch.Tensor) -> tuple[dict, dict, torch.Tensor]:
    """Two photos of a plane, the second turned by 20 degrees, its keypoints in another order.

    Returns:
        Their features, and for each keypoint of the first its number in the second.
    """
    generator = torch.Generator().manual_seed(0)
    number = descriptors.shape[0]
    first = 120 + torch.rand(number, 2, generator=generator) * torch.tensor([400.0, 240.0])
    matrix = torch.from_numpy(cv2.getRotationMatrix2D((320, 240), 20, 1)).float()
    second = first @ matrix[:, :2].T + matrix[:, 2]
    order = torch.randperm(number, generator=generator)
    noise = 0.02 * torch.randn(descriptors.shape, generator=generator)
    again = normalize(descriptors + noise, dim=1)[order]
    return (
        {"keypoints": first, "descriptors": descriptors.T, "image_size": SIZE},
        {"keypoints": second[order], "descriptors": again.T, "image_size": SIZE},
        order.argsort(),
    )


def drawn(number: int, dim: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(1)
    return normalize(torch.randn(number, dim, generator=generator), dim=1)


@pytest.fixture
def described(base_weights) -> torch.Tensor:
    """Descriptors (N, 64) by XFeat of a drawn photo."""
    base_weights("xfeat")
    generator = np.random.default_rng(0)
    pixels = cv2.resize(generator.integers(0, 255, (30, 40, 3), np.uint8), (640, 480))
    conf = features_confs.confs["xfeat"]
    found = extractors.extract(extractors.load(conf["model"]).eval(), pixels, conf["preprocessing"])
    return torch.from_numpy(found["descriptors"].T[:256])


@pytest.mark.parametrize("network", ["aliked", "xfeat"])
def test_it_is_kornias(base_weights, network):
    base_weights(f"{network}+lightglue")
    first, second, _ = photos(drawn(200, LIGHTGLUE[network].dim))
    ((matches, scores),) = LightGlue({"features": network}).match([(first, second)])
    given = {
        f"image{i}": {
            "keypoints": one["keypoints"][None],
            "descriptors": one["descriptors"].T[None],
            "image_size": one["image_size"][None],
        }
        for i, one in enumerate((first, second))
    }
    expected = KorniaLightGlue(network)(given)
    assert torch.equal(matches, expected["matches0"][0])
    assert torch.equal(scores, expected["matching_scores0"][0])


def test_keypoints_match_by_place_and_descriptor(base_weights):
    base_weights("aliked+lightglue")
    first, second, right = photos(drawn(200, 128))
    ((matches, scores),) = LightGlue({"features": "aliked"}).match([(first, second)])
    assert (matches == right).float().mean() > 0.95
    assert 0.9 < scores[matches >= 0].mean() <= 1
    few = LightGlue({"features": "aliked", "filter_threshold": 0.999}).match([(first, second)])
    assert (few[0][0] >= 0).sum() < (matches >= 0).sum()


@pytest.mark.parametrize("feature", ["xfeat_sv32", "xfeat_pca32", "xfeat_nested@32"])
@pytest.mark.parametrize("storage", ["float16", "uint4"])
def test_projected_descriptors_match_as_they_are(base_weights, described, feature, storage):
    """By an adapter, which takes codes, too."""
    base_weights("xfeat+lightglue")
    first, second, right = photos(described)
    ((expected, _),) = LightGlue({"features": "xfeat"}).match([(first, second)])
    project, conf = projections.load(feature), features_confs.confs[feature]
    pair = []
    for one in (first, second):
        small = adapters.rounded(project(one["descriptors"].T).numpy(), conf, storage)
        pair.append(one | {"descriptors": torch.from_numpy(small).T})
    matcher = LightGlue({"features": feature})
    assert matcher.net.input_proj.in_features == 32
    ((matches, _),) = matcher.match([pair])
    number = (expected == right).sum()
    assert number > 0.8 * len(right)
    assert (matches == right).sum() > 0.97 * number


def test_the_features_of_a_file_choose_the_weights(base_weights):
    base_weights("xfeat")
    base_weights("xfeat+lightglue")
    for feature in ("xfeat", "xfeat_sv32", "xfeat_nested@16", "mini32"):
        made_from = extract_features.provenance(features_confs.confs[feature])
        model = matchers.load(matchers_confs.for_features(CONF, made_from))
        assert model.conf["features"] == feature
    moved = json.loads(json.dumps(made_from))  # as a file has it
    assert matchers.load(matchers_confs.for_features(CONF, moved)).conf["features"] == "mini32"


def test_every_projection_of_its_networks_has_an_adapter(base_weights):
    for base in ("aliked", "xfeat"):
        base_weights(base)
    named = {name for base in ("aliked", "xfeat") for name in features_confs.names(base)}
    assert {*named, "mini32", "mini64"} == set(lightglue.fitted())
    for name in named:
        made_from = extract_features.provenance(features_confs.confs[name])
        assert lightglue.metadata_of(name)["made_from"] == lightglue.identity(made_from)


def test_matches_are_stale_if_the_adapter_has_changed(tmp_path, monkeypatch):
    made_from = extract_features.provenance(features_confs.confs["mini32"])
    known = {name: matchers_confs.provenance(CONF, made_from) for name in ("before", "again")}
    assert known["before"] == known["again"] != {}
    file = Path(shutil.copy(lightglue.file_of("mini32"), tmp_path))
    monkeypatch.setattr(lightglue, "WEIGHTS", tmp_path)
    tensors = {key: 2 * tensor for key, tensor in load_file(file).items()}
    save_file(tensors, file, {"network": "xfeat", "made_from": json.dumps({})})
    assert matchers_confs.provenance(CONF, made_from) != known["before"]
    assert not matchers_confs.provenance({"name": "nearest_neighbor"}, made_from)


def test_features_without_weights_are_refused():
    made_from = extract_features.provenance(features_confs.confs["colmap_sift_sv64"])
    message = "lightglue has no weights for colmap_sift_sv64, only for aliked, disk, mini32, "
    with pytest.raises(InputError, match=message):
        matchers_confs.for_features(CONF, made_from)
    with pytest.raises(InputError, match="no weights for features of unknown origin, only for"):
        matchers_confs.for_features(CONF, {})
    with pytest.raises(InputError, match="no weights for ../../secret, only for"):
        matchers.load({"name": "lightglue", "features": "../../secret"})


def test_an_adapter_of_another_projection_is_refused(base_weights, tmp_path):
    base_weights("xfeat")
    made_from = extract_features.provenance(features_confs.confs["xfeat_sv32"])
    other = made_from | {"projection_sha256": "0" * 64}
    with pytest.raises(InputError, match="are for the xfeat_sv32 that ships .*, not for this one"):
        matchers_confs.for_features(CONF, other)
    # a file of the same name and contents is the same
    file = shutil.copy(projections.find("xfeat_sv32"), tmp_path)
    conf = features_confs.get("xfeat", projection=file)[1]
    found = matchers_confs.for_features(CONF, extract_features.provenance(conf))
    assert found == {**CONF, "features": "xfeat_sv32"}


@pytest.mark.parametrize(
    "number0, number1", [(0, 5), (5, 0), (1, 5), (5, 1), (1, 1), (2, 2), (0, 0)]
)
def test_few_keypoints(base_weights, number0, number1):
    base_weights("xfeat+lightglue")
    pair = [
        {"keypoints": torch.rand(n, 2) * 400, "descriptors": drawn(n, 64).T, "image_size": SIZE}
        for n in (number0, number1)
    ]
    ((matches, scores),) = LightGlue({"features": "xfeat"}).match([pair])
    assert matches.shape == scores.shape == (number0,)
    assert matches.dtype == torch.int64 and (matches < number1).all()


def test_keypoints_beyond_the_border(base_weights):
    """Those of compact maps are projections, and may be a little outside."""
    base_weights("xfeat+lightglue")
    first, second, right = photos(drawn(50, 64))
    first["keypoints"][0], second["keypoints"][right[0]] = -3, torch.tensor([700.0, 500.0])
    ((matches, _),) = LightGlue({"features": "xfeat"}).match([(first, second)])
    assert len(matches) == 50


@pytest.mark.parametrize("change", ["truncated", "other", "missing"])
def test_broken_adapters(base_weights, change, tmp_path, monkeypatch):
    base_weights("xfeat+lightglue")
    file = Path(shutil.copy(lightglue.file_of("xfeat_sv32"), tmp_path))
    monkeypatch.setattr(lightglue, "WEIGHTS", tmp_path)
    if change == "truncated":
        file.write_bytes(file.read_bytes()[:-100])
        message = "The weights of lightglue for xfeat_sv32.* are broken"
    elif change == "other":
        tensors = load_file(file) | {"input_proj.weight": torch.zeros(7, 32)}
        made_from = json.dumps({})
        save_file(tensors, file, {"network": "xfeat", "made_from": made_from})
        message = "The weights of lightglue for xfeat_sv32 are those of another network"
    else:
        file.unlink()
        message = "lightglue has no weights for xfeat_sv32, only for"
    with pytest.raises(InputError, match=message):
        LightGlue({"features": "xfeat_sv32"})


def test_weights_that_are_missing_or_broken(tmp_path, monkeypatch):
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    monkeypatch.setattr(
        downloads, "urlopen", lambda *_, **__: (_ for _ in ()).throw(OSError("no network"))
    )
    with pytest.raises(InputError, match="The weights of lightglue for xfeat are missing and can"):
        LightGlue({"features": "xfeat"})
    file = downloads.cache() / LIGHTGLUE["xfeat"].file
    file.parent.mkdir(parents=True)
    file.write_bytes(b"PK")
    with pytest.raises(InputError, match="their sha256 is not"):
        LightGlue({"features": "xfeat"})


def test_weights_with_tensors_that_matching_does_not_use(tmp_path, monkeypatch):
    """Those of DISK have some, and were once refused as another network's."""
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    disk = replace(LIGHTGLUE["disk"], sha256=None)
    monkeypatch.setitem(LIGHTGLUE, "disk", disk)
    no_features: Any = None
    net = KorniaLightGlue(no_features, **KorniaLightGlue.features["disk"] | {"weights": None})
    weights = {key: value for key, value in net.state_dict().items() if key != CONSTANT}
    file = downloads.cache() / disk.file
    file.parent.mkdir(parents=True)
    torch.save(weights | {"log_assignment.0.r": torch.ones(())}, file)
    loaded = LightGlue({"features": "disk"}).net.state_dict()
    assert all(torch.equal(loaded[key], value) for key, value in weights.items())
    torch.save(weights | {"log_assignment.0.other": torch.ones(())}, file)
    with pytest.raises(InputError, match="those of another network"):
        LightGlue({"features": "disk"})


def test_photos_are_localized_by_it(
    base_weights, place, aachen_layout, run, refused, tmp_path, monkeypatch
):
    """In files, in memory, and in a compact map; a feature without weights before any work."""
    base_weights("xfeat+lightglue")
    model = {"name": "lightglue", "max_keypoints": 512}
    monkeypatch.setitem(matchers_confs.confs["lightglue"], "model", model)
    build, images, outputs = place
    listed = aachen_layout / "queries/day_time_queries_with_intrinsics.txt"
    given = ("--matcher", "lightglue", "--query_images", images, "--queries", listed)
    run(*build, *given, "--feature", "mini32", "--storage", "uint2")
    _, rows = outcome(outputs / f"queries-{listed.stem}")
    name, camera = parse_query_list(listed)[0]
    row = rows[name]
    assert row["status"] == "localized" and int(row["num_inliers"]) > 100
    pose, info = Localizer(outputs / "map").localize(images / name, camera)
    assert pose is not None and info["num_matches"] == int(row["num_matches"])
    compact.main(tmp_path / "place.hlm", outputs / "map")
    pose, info = Localizer(tmp_path / "place.hlm").localize(images / name, camera)
    assert pose is not None and info["num_inliers"] > 50
    message = refused(*build[:-1], tmp_path / "o", *given, "--feature", "colmap_sift_sv32")
    assert message.startswith("lightglue has no weights for colmap_sift_sv32, only for aliked, ")
    assert not list((tmp_path / "o").rglob("*.h5"))


def test_only_projections_and_minis_need_adapters(base_weights, tmp_path):
    base_weights("xfeat")
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((64, 64, 3), np.uint8))
    with pytest.raises(InputError, match="xfeat needs no adapter: LightGlue has weights for it"):
        adapters.main(["xfeat"], [tmp_path], tmp_path)
    with pytest.raises(InputError, match="no weights for the base of sift_sv64, sift"):
        adapters.main(["sift_sv64"], [tmp_path], tmp_path)


def test_an_adapter_of_a_projection_of_the_user(base_weights, tmp_path, monkeypatch):
    base_weights("xfeat")
    base_weights("xfeat+lightglue")
    home = tmp_path / "hub/checkpoints"
    home.mkdir(parents=True)
    for file in downloads.cache().iterdir():
        (home / file.name).symlink_to(file)
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    photo = tmp_path / "photos/a.png"
    photo.parent.mkdir()
    cv2.imwrite(str(photo), np.zeros((64, 64, 3), np.uint8))
    shutil.copy(projections.find("xfeat_sv32"), tmp_path / "own.safetensors")
    file = tmp_path / "feature.yaml"
    model = {"name": "reduced", "base": {"name": "xfeat"}}
    model["projection"] = str(tmp_path / "own.safetensors")
    file.write_text(yaml.safe_dump({"model": model}))
    conf = features_confs.get(str(file))[1]
    made_from = extract_features.provenance(conf)
    assert matchers_confs.all_of(conf) == ["NN-mutual"]
    with pytest.raises(InputError, match="no weights for own, only for"):
        matchers_confs.for_features(CONF, made_from)
    with pytest.raises(InputError, match="The photos have no keypoints"):
        adapters.main([str(file)], [photo.parent])
    wrong = tmp_path / "wrong.yaml"
    projection = str(projections.find("aliked_sv32"))
    wrong.write_text(yaml.safe_dump({"model": model | {"projection": projection}}))
    with pytest.raises(InputError, match="is for aliked, not for xfeat"):
        adapters.main([str(wrong)], [photo.parent], tmp_path)
    with pytest.raises(InputError, match="weights for xfeat_sv32 already: rename your projection"):
        adapters.main(["xfeat_sv32"], [photo.parent])
    noise = np.random.default_rng(0).integers(256, size=(40, 40, 3), dtype=np.uint8)
    cv2.imwrite(str(photo), cv2.resize(noise, (320, 320), interpolation=cv2.INTER_CUBIC))
    assert adapters.main([str(file)], [photo.parent]) == [home / "lightglue/own.safetensors"]
    assert matchers_confs.all_of(conf) == ["NN-mutual", "lightglue", "NN+lightglue"]
    chosen = matchers_confs.for_features(CONF, made_from)
    assert matchers.load(chosen).net.input_proj.in_features == 32
    assert matchers_confs.provenance(CONF, made_from)["weights_sha256"]
    other = made_from | {"projection_sha256": "0" * 64}
    with pytest.raises(InputError, match="own.safetensors was fitted to another own: fit it again"):
        matchers_confs.for_features(CONF, other)


def test_the_folder_of_weights_is_that_of_torch(monkeypatch):
    for name, value in (("TORCH_HOME", "~/weights"), ("XDG_CACHE_HOME", "/caches"), ("HOME", "/a")):
        for other in ("TORCH_HOME", "XDG_CACHE_HOME"):
            monkeypatch.delenv(other, raising=False)
        monkeypatch.setenv(name, value)
        assert downloads.cache() == Path(torch.hub.get_dir()) / "checkpoints"
