"""FPR95 on sequences of PhotoTour."""

import cv2
import numpy as np
import pytest
from command import refused, run

from hloc_reduce.evaluation import __main__ as evaluation
from hloc_reduce.evaluation.patch_verification import fpr95


def test_fpr95_by_hand():
    distances = np.concatenate([np.arange(100) / 100, [0.5, 0.935, 0.94, 2.0]])
    matches = np.arange(104) < 100
    # 95 of 100 are within 0.94
    assert fpr95(distances, matches) == 0.75
    with pytest.raises(ValueError, match="Both"):
        fpr95(distances, np.ones(104, bool))


def test_phototour(tmp_path, monkeypatch, capsys, caplog):
    """Twelve points, two patches of each; a pair that matches is as like as 3 % of noise leaves."""
    generator = np.random.default_rng(0)
    folder = tmp_path / "town"
    folder.mkdir()
    sheet = np.zeros((16, 64, 16, 64), np.uint8)
    for point in range(12):
        patch = cv2.resize(generator.uniform(0, 255, (8, 8)), (64, 64))
        for i in (2 * point, 2 * point + 1):
            noisy = patch + 8 * generator.standard_normal((64, 64))
            sheet[i // 16, :, i % 16] = noisy.clip(0, 255)
    cv2.imwrite(str(folder / "patches0000.bmp"), sheet.reshape(1024, 1024))
    (folder / "info.txt").write_text("".join(f"{i // 2} 0\n" for i in range(24)))
    pairs = folder / "m50_100000_100000_0.txt"
    lines = [f"{2 * i} {i} 0 {2 * i + 1} {i} 0" for i in range(12)]
    lines += [f"{2 * i} {i} 0 {2 * i + 2} {i + 1} 0" for i in range(11)]
    pairs.write_text("\n".join(lines))
    command = ["phototour", "--root", tmp_path, "--name", "town", "--outputs", tmp_path / "o"]
    run(monkeypatch, evaluation, *command, "--feature", "sift", "sift_sv64")
    assert capsys.readouterr().out.splitlines() == [
        "FPR95 of sift on town: 0.00 %",
        "FPR95 of sift_sv64 on town: 0.00 %",
    ]
    rows = (tmp_path / "o/town.csv").read_text().splitlines()
    assert [row.split(",")[0] for row in rows] == ["feature", "sift", "sift_sv64"]
    # what is said to match does not: all others are nearer than most of these
    lines = [f"{2 * i} 1 0 {2 * i + 2} 1 0" for i in range(11)]
    lines += [f"{2 * i} {i} 0 {2 * i + 1} {i + 100} 0" for i in range(12)]
    pairs.write_text("\n".join(lines))
    run(monkeypatch, evaluation, *command, "--feature", "sift")
    assert capsys.readouterr().out == "FPR95 of sift on town: 100.00 %\n"
    pairs.write_text("0 0 0 24 0 0\n0 0 0 2 1 0\n")
    message = refused(monkeypatch, caplog, evaluation, *command, "--feature", "sift")
    assert "patches that info.txt does not have" in message
    outside = [*command, "--name", "../town", "--feature", "sift"]
    assert "a folder in --root" in refused(monkeypatch, caplog, evaluation, *outside)
    message = refused(monkeypatch, caplog, evaluation, *command, "--feature", "colmap_sift")
    assert "describes photos" in message
