"""PhotoTour sequences, synthesized in the layout of the real ones."""

import shutil

import cv2
import kornia
import numpy as np
import pytest
import torch
from command import refused
from interruption import interrupted

from hloc_reduce import projections
from hloc_reduce.datasets import phototour as layout
from hloc_reduce.descriptors import DESCRIPTORS, Base
from hloc_reduce.descriptors.model import Descriptor
from hloc_reduce.training import __main__ as training
from hloc_reduce.training import patch_tracks, tracks
from hloc_reduce.utils.cli import InputError


@pytest.fixture
def sequence(tmp_path):
    """300 patches on two sheets: 100 points, three noisy patches of each, in random order."""
    generator = np.random.default_rng(0)
    folder = tmp_path / "town"
    folder.mkdir()
    points = generator.permutation(np.repeat(np.arange(100), 3))
    textures = [
        cv2.resize(generator.uniform(0, 255, (8, 8)), (64, 64), interpolation=cv2.INTER_CUBIC)
        for _ in range(100)
    ]
    noisy = [textures[point] + 8 * generator.standard_normal((64, 64)) for point in points]
    patches = np.zeros((512, 64, 64), np.uint8)
    patches[:300] = np.clip(noisy, 0, 255)
    for number, sheet in enumerate(patches.reshape(2, 16, 16, 64, 64)):
        image = sheet.swapaxes(1, 2).reshape(1024, 1024)
        cv2.imwrite(str(folder / f"patches{number:04}.bmp"), image)
    (folder / "info.txt").write_text("".join(f"{10 * point} 0\n" for point in points))
    lines = []
    for i in range(300):
        same = np.flatnonzero(points == points[i])
        for j in (same[same != i][0], (i + 1) % 300):
            lines.append(f"{i} {10 * points[i]} 0 {j} {10 * points[j]} 0 0")
    (folder / layout.PREFERRED_PAIRS).write_text("\n".join(lines))
    return folder, patches, points


def test_patches_are_read_row_by_row(sequence):
    folder, patches, _ = sequence
    read = layout.read_sheet(folder / "patches0001.bmp")
    expected = cv2.resize(patches[256 + 17], (32, 32), interpolation=cv2.INTER_AREA) / 255
    np.testing.assert_allclose(read[17], expected, atol=1e-6)


def test_patches_of_a_point_are_a_track(sequence, tmp_path):
    folder, patches, points = sequence
    data = tracks.load(patch_tracks.main(folder, tmp_path / "cache"))
    assert data.num_tracks == 100 and len(data.track) == 300
    assert (points[data.image] == data.track).all()  # an image of its own each, by its number
    first = torch.from_numpy(layout.read_sheet(folder / "patches0000.bmp")[:1, None])
    row = data.descriptors[np.flatnonzero(data.image == 0)[0], 0, 0]
    assert Descriptor("sift")(first)[0].numpy() @ row.astype(np.float32) > 0.999


def test_description_goes_on_after_an_interruption_between_sheets(sequence, tmp_path, monkeypatch):
    folder, _, _ = sequence
    shutil.copy(folder / "patches0001.bmp", folder / "patches0002.bmp")  # of no listed patch
    expected = patch_tracks.main(folder, tmp_path / "whole").read_bytes()
    sheets = interrupted(monkeypatch, patch_tracks, "read_sheet", 2)
    with pytest.raises(KeyboardInterrupt):
        patch_tracks.main(folder, tmp_path / "cache")
    path = patch_tracks.main(folder, tmp_path / "cache")
    assert [sheet.stem for (sheet,) in sheets] == ["patches0000", "patches0001", "patches0001"]
    assert path.read_bytes() == expected
    assert {p.name for p in path.parent.iterdir()} == {path.name, f"{path.stem}.json"}


def test_training_and_validation(sequence, tmp_path, monkeypatch, capsys):
    folder, _, _ = sequence
    small = {**training.sv.RECIPES["best"], "steps": 20, "batch_size": 64}
    monkeypatch.setitem(training.sv.RECIPES, "best", small)
    paths = training.main({}, [folder], "sift", "sv", [16], tmp_path / "w", tmp_path / "cache")
    training.validate(folder, tmp_path / "cache", "sift", paths)
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(" on ")[0] for line in lines] == ["FPR95 of sift", "FPR95 of sift_sv16"]
    assert lines[0].endswith("on town: 0.00 %")  # noise of 3 % is nothing to sift


def test_hardnet_is_trained_with_the_distance_loss(sequence, tmp_path, monkeypatch):
    """Every scheme, a few steps, on what a random network describes."""
    folder, _, _ = sequence
    torch.manual_seed(0)
    network = kornia.feature.HardNet(pretrained=False)
    base = Base(lambda: network, hidden=DESCRIPTORS["hardnet"].hidden)
    monkeypatch.setitem(DESCRIPTORS, "hardnet", base)
    weights = {"pca": None, "us": 1000.0, "ss": 0.0, "sv": 3.0, "nested": 3.0}
    assert weights.keys() == training.SCHEMES.keys() - {"raw"}
    for scheme, weight in weights.items():
        if weight is not None:
            recipes = training.SCHEMES[scheme].RECIPES
            short = {"steps": 4, "batch_size": 64}
            monkeypatch.setitem(recipes, "best", {**recipes["best"], **short})
        (path,) = training.main({}, [folder], "hardnet", scheme, [24], tmp_path / "w", tmp_path)
        project = projections.load(path)
        assert project.sizes[0] == 128 and project.dim == (64 if scheme == "nested" else 24)
        assert project.sizes[1:-1] == (() if scheme == "pca" else (96,))
        assert project.metadata["recipe"].get("distance_weight") == weight
    assert (
        training.complete_recipe("us", "paper", "hardnet", "hardnet_us64")["distance_weight"] == 0.1
    )


def test_descriptors_of_photos_are_refused(sequence, monkeypatch, caplog):
    for option in ("--phototour", "--validate"):
        message = refused(
            monkeypatch, caplog, training, "--descriptor", "colmap_sift", option, sequence[0]
        )
        assert message == "colmap_sift describes photos, not the patches of PhotoTour."


def test_broken_sequences_are_refused(sequence, tmp_path):
    folder, _, _ = sequence
    with pytest.raises(InputError, match="not a PhotoTour sequence"):
        patch_tracks.main(tmp_path, tmp_path / "cache")
    (folder / "patches0001.bmp").unlink()
    with pytest.raises(InputError, match="300 patches, 1 sheets are missing"):
        patch_tracks.main(folder, tmp_path / "cache")
    (folder / "info.txt").write_text("1 0\nx 0\n")
    with pytest.raises(InputError, match="info.txt, line 2"):
        patch_tracks.main(folder, tmp_path / "cache")
    (folder / layout.PREFERRED_PAIRS).write_text("1 2 3\n")
    with pytest.raises(InputError, match="line 1: not a pair"):
        layout.read_pairs(folder)
    (folder / layout.PREFERRED_PAIRS).write_text("0 5 0 1 5 0\n")
    with pytest.raises(InputError, match="both matching pairs and others"):
        layout.read_pairs(folder)
    cv2.imwrite(str(folder / "patches0000.bmp"), np.zeros((64, 64), np.uint8))
    (folder / "info.txt").write_text("1 0\n2 0\n")
    with pytest.raises(InputError, match="no two patches"):
        patch_tracks.main(folder, tmp_path / "cache")
    (folder / "info.txt").write_text("1 0\n1 0\n")
    with pytest.raises(InputError, match="not a sheet"):
        patch_tracks.main(folder, tmp_path / "cache")
