"""What the pipeline for Aachen says to wrong input."""

import io
import shutil

import cv2
import numpy as np
import pytest
import torch
from command import outcome, results

from hloc_reduce import demo, projections
from pipelines import aachen

PIPELINE = aachen


def released_file():
    """A model as the paper's authors released theirs, untrained."""
    layers = torch.nn.Sequential(torch.nn.Linear(128, 96), torch.nn.BatchNorm1d(96))
    layers.append(torch.nn.Linear(96, 16))
    buffer = io.BytesIO()
    torch.save(layers.state_dict(), buffer)
    return buffer.getvalue()


def test_a_wrong_configuration_touches_no_results(aachen_layout, tmp_path, run, refused):
    """It is refused before a finished run is overwritten, and before it claims a new folder."""
    outputs, new = tmp_path / "outputs", tmp_path / "new"
    place = ("--dataset", aachen_layout, "--feature", "sift", "--outputs")
    run(*place, outputs)
    before = {path: path.read_bytes() for path in outputs.rglob("*") if path.is_file()}
    (tmp_path / "typo.yaml").write_text("model: {name: dog, options: {peak_treshold: 1}}")
    (tmp_path / "bare.yaml").write_text("model: {name: reduced, base: {name: dog}}")
    (tmp_path / "no.safetensors").write_text("no projection")
    (tmp_path / "HardNet_sv.pth").write_bytes(released_file())
    (tmp_path / "pairs.txt").write_text("other/a.png db/1.png\nquery/day/a.png other/1.png\n")
    for message, *wrong in (
        ("The DoG options", "--feature", tmp_path / "typo.yaml"),
        ("needs a projection", "--feature", tmp_path / "bare.yaml"),
        ("not a projection", "--projection", tmp_path / "no.safetensors"),
        ("is for mkd, not for sift", "--projection", projections.find("mkd_sv16")),
        ("is for hardnet, not for sift", "--projection", tmp_path / "HardNet_sv.pth"),
        ("no pair of a query and a map image", "--retrieval", tmp_path / "pairs.txt"),
    ):
        for folder in (outputs, new):
            arguments = (*place, folder, *wrong, "--overwrite")
            assert message in refused(*arguments)
    assert {path: path.read_bytes() for path in before} == before and not new.exists()


def test_wrong_input(aachen_layout, tmp_path, refused):
    outputs = tmp_path / "outputs"
    arguments = ("--dataset", aachen_layout, "--outputs", outputs)
    message = refused(*arguments, "--feature", "sift_sv46")
    assert "sift_sv46" in message and message.index("sift_sv64") < message.index("sift_us64")
    message = refused(*arguments, "--matcher", "NN")
    assert "NN-ratio" in message
    message = refused("--dataset", tmp_path / "nowhere")
    for part in ("images_upright", "3D-models/aachen_v_1_1", "queries", "visuallocalization.net"):
        assert part in message
    truth = tmp_path / "truth.txt"
    truth.write_text("a.png 1 0 0 0 0 0 0\n")
    message = refused(*arguments, "--ground_truth", truth)
    assert "the pose of no query" in message
    truth.unlink()
    file = tmp_path / "file"
    file.touch()
    message = f"{file} is a file: choose a folder for the results."
    assert refused(*arguments[:2], "--outputs", file) == message
    assert refused(*arguments[:2], "--outputs", file / "a/b") == message
    assert "--num_loc 0" in refused(*arguments, "--num_loc", 0)
    message = refused(*arguments, "--ground_truth", tmp_path / "truth.txt")
    assert "truth.txt" in message
    assert not outputs.exists()

    (aachen_layout / "images_upright/db/2.png").rename(tmp_path / "2.png")
    message = refused(*arguments)
    assert "1 of 4 images" in message and "db/2.png" in message and "--accept_partial" in message
    shutil.move(tmp_path / "2.png", aachen_layout / "images_upright/db/2.png")

    queries = aachen_layout / "queries/night_time_queries_with_intrinsics.txt"
    text = queries.read_text()
    queries.write_text(text + "query/night/b.png PINHOLE 1\n")
    message = refused(*arguments)
    assert f"{queries}:2" in message
    queries.write_text(text)
    model = aachen_layout / "3D-models/aachen_v_1_1/images.bin"
    content = model.read_bytes()
    model.write_bytes(content[: len(content) // 2])
    assert "not a COLMAP model" in refused(*arguments)
    model.write_bytes(content)


def test_outputs_of_another_configuration_are_refused(aachen_layout, tmp_path, run, refused):
    outputs = tmp_path / "outputs"
    place = ("--dataset", aachen_layout, "--outputs", outputs, "--feature")
    run(*place, "sift_sv16")
    before = results(outputs)
    for others, named in (
        (["sift_sv16", "--num_loc", 3], "differs: num_loc (50 before, 3 now). "),
        (["sift_sv16", "--storage", "uint8"], "differs: feature (storage "),
        (["sift_sv16", "--matcher", "NN-mutual"], "differs: matcher ("),
        (
            ["sift_sv32", "--matcher", "NN-mutual"],
            "differs: feature (projection sift_sv16 before, sift_sv32 now, projection_sha256) and",
        ),
    ):
        message = refused(*place, *others)
        assert f"What {outputs} was made from {named}" in message
        assert "Choose other --outputs" in message and "--overwrite" in message
    assert results(outputs) == before
    foreign = ("settings.json", "sfm_notes.txt", "my-feats-1.h5", ".mine.tmp", "sfm_old/a.bin")
    for name in foreign:
        (outputs / name).parent.mkdir(exist_ok=True)
        (outputs / name).write_text("mine")
    left = outputs / ".summary.json.123.tmp"  # of a killed run
    left.write_text("{")
    run(*place, "sift_sv16", "--matcher", "NN-mutual", "--overwrite")
    assert outcome(outputs)[0]["matcher"] == "NN-mutual" and not left.exists()
    assert all((outputs / name).read_text() == "mine" for name in foreign)
    assert not list(outputs.glob("*_NN-mutual-ratio.8_*")) and not list(outputs.glob("sfm_*ratio"))


def test_grey_photos_only_give_an_empty_map(aachen_layout, tmp_path, refused):
    for path in (aachen_layout / "images_upright").rglob("*.png"):
        cv2.imwrite(str(path), np.full((270, 360), 128, np.uint8))
    arguments = ("--dataset", aachen_layout, "--outputs", tmp_path / "o", "--feature", "sift")
    assert "The map is empty" in refused(*arguments)


def test_a_wrong_feature_is_found_before_the_demo_is_rendered(tmp_path, monkeypatch, refused):
    monkeypatch.setattr(demo, "main", lambda dataset: pytest.fail("rendered"))
    given = ("--demo", "--dataset", tmp_path / "town", "--feature", "edgepoint2_m33")
    assert "Unknown feature 'edgepoint2_m33'" in refused(*given)


def test_a_number_of_demo_photos(tmp_path, monkeypatch, capsys, run, refused):
    monkeypatch.setattr(demo, "take", None)  # nothing is rendered
    town = ("--demo", "--dataset", tmp_path / "town", "--demo_photos", "5")
    assert "at least 32 photos, not 5" in refused(*town)
    assert not (tmp_path / "town").exists()
    with pytest.raises(SystemExit) as exit:
        run("--demo_photos", "40")
    assert exit.value.code == 2 and "--demo_photos needs --demo" in capsys.readouterr().err
