"""A finished outputs folder of hloc is made small, and compared before and after."""

import shutil

import h5py
import numpy as np
import pytest
from command import state, table
from small_map import build

from hloc_reduce import Localizer, maps
from hloc_reduce.utils.h5 import list_h5_names
from pipelines import shrink

PIPELINE = shrink


@pytest.fixture
def finished(scene):
    """A folder as hloc leaves it: descriptors like its sift, matches and a model; and the scene."""
    generator = np.random.default_rng(0)
    described = generator.exponential(1, (len(scene.points), 128)) ** 2
    described /= np.linalg.norm(described, axis=1, keepdims=True)
    described = np.sqrt(described / described.sum(axis=1, keepdims=True))  # COLMAP's
    described = np.sqrt(described / described.sum(axis=1, keepdims=True))  # hloc's second root
    with h5py.File(scene.features, "a") as file:
        for name, seen in scene.seen.items():
            del file[name]["descriptors"]
            file[name]["descriptors"] = described[seen].T.astype(np.float16)
            file[name]["image_size"] = np.array([640, 480])
    build(scene)
    folder = scene.root / "hloc"
    folder.mkdir()
    shutil.copy(scene.features, folder / "feats-sift.h5")
    shutil.copy(scene.matches, folder / "feats-sift_matches.h5")
    shutil.copytree(scene.sfm, folder / "sfm_sift")
    (folder / "pairs-db.txt").write_text(scene.pairs.read_text())
    truth = scene.root / "truth.txt"
    lines = []
    for name in ("query/6.jpg", "query/7.jpg"):
        x, y, z, w = scene.poses[name].rotation.quat
        values = map(float, [w, x, y, z, *scene.poses[name].translation])
        lines.append(f"{name} {' '.join(map(repr, values))}\n")
    truth.write_text("".join(lines))
    scene.folder, scene.truth = folder, truth
    return scene


def test_before_and_after(finished, capsys, run):
    outputs = finished.root / "small"
    given = ("--hloc_outputs", finished.folder, "--outputs", outputs)
    queries = ("--queries", finished.queries, "--ground_truth", finished.truth)
    before = state(finished.folder)
    run(*given, *queries)
    assert state(finished.folder) == before
    printed = capsys.readouterr().out
    rows = {row["map"]: row for row in table(outputs / "shrink.csv")}
    assert list(rows) == [shrink.HLOC, shrink.REDUCED, shrink.COMPACT]
    for name, row in rows.items():
        assert name in printed
        assert row["localized"] == "2 of 2" and row["recall [%]"] == "100.0 / 100.0 / 100.0"
        assert float(row["inliers"]) > 250 and float(row["median error [cm]"]) < 1
    sizes = [float(row["MB"]) for row in rows.values()]
    assert sizes[0] > 2 * sizes[1] > 2 * sizes[2]
    assert list_h5_names(outputs / "features.h5") == sorted(finished.seen)
    assert len(Localizer(outputs / "map.hlm").names) == 6

    run(*given, *queries)  # resumes
    run(*given, "--overwrite")  # sizes only
    assert "localized" not in table(outputs / "shrink.csv")[0]


def test_wrong_input(finished, tmp_path, refused):
    given = ("--hloc_outputs", finished.folder, "--outputs", tmp_path / "small")
    assert "is hloc's folder" in refused(*given[:3], finished.folder)
    assert "There is no folder" in refused("--hloc_outputs", tmp_path / "no", *given[2:])
    assert "above 0" in refused(*given, "--max_mb", 0)
    assert "like those of SIFT" in refused(*given, "--feature", "aliked_sv32")
    assert "give --queries" in refused(*given, "--ground_truth", finished.truth)
    shutil.copy(finished.folder / "feats-sift.h5", finished.folder / "feats-2.h5")
    message = refused(*given)
    assert "several: feats-2.h5, feats-sift.h5" in message and "Give --features" in message
    for path in finished.folder.glob("feats-*.h5"):
        path.unlink()
    assert "it has no feature file, only pairs-db.txt, sfm_sift" in refused(*given)
    chosen = ("--features", finished.features)
    shutil.copytree(finished.folder / "sfm_sift", finished.folder / "sfm_2")
    assert "several: sfm_2, sfm_sift. Give --sfm" in refused(*given, *chosen)
    message = refused(*given, *chosen, "--sfm", finished.sfm, "--feature", "xfeat_sv32")
    assert "128-D" in message
    assert not (tmp_path / "small/shrink.csv").exists()


@pytest.mark.fault(10)
@pytest.mark.parametrize(
    "inside, message",
    [
        ((), "it has no feature file, as it is empty. Give the right one, or --features."),
        (("a.jpg", "b.jpg"), "it has no feature file, only a.jpg, b.jpg. Give the right one, or"),
        (("sfm/points3D.bin",), "it has no feature file, only sfm. Give the right one, or --f"),
        (
            ("hloc/feats.h5", "hloc/sfm/points3D.bin", "a.txt"),
            "it has no feature file, only a.txt, hloc. Did you mean {folder}/hloc?",
        ),
        (
            ("../feats.h5", "points3D.bin"),
            "it has no feature file, only points3D.bin. Did you mean {folder.parent}?",
        ),
    ],
)
def test_a_folder_that_is_not_of_hloc(inside, message, tmp_path, refused):
    folder = tmp_path / "outputs/folder"
    folder.mkdir(parents=True)
    for name in inside:
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(b"")
    said = refused("--hloc_outputs", folder, "--outputs", tmp_path / "small")
    begin = f"{folder} is not a finished outputs folder of hloc, which has a feature file and a "
    assert said.startswith(f"{begin}COLMAP model of its keypoints: {message.format(folder=folder)}")
    assert not (tmp_path / "small").exists()


@pytest.mark.fault(10)
def test_a_folder_of_features_only(finished, tmp_path, refused):
    shutil.rmtree(finished.folder / "sfm_sift")
    folder = shutil.copytree(finished.folder, tmp_path / "elsewhere/hloc")
    said = refused("--hloc_outputs", folder, "--outputs", tmp_path / "small")
    there_are = "feats-sift.h5, feats-sift_matches.h5, pairs-db.txt"
    assert f"it has no model of the keypoints in feats-sift.h5, only {there_are}." in said
    assert said.endswith("Give the right one, or --sfm.")


def test_another_matcher(finished, run, refused):
    given = ("--hloc_outputs", finished.folder, "--queries", finished.queries)
    run(*given, "--outputs", finished.root / "small", "--matcher", "NN-mutual")
    assert maps.Map(finished.root / "small/map").matcher == "NN-mutual"
    message = refused(*given, "--outputs", finished.root / "other", "--matcher", "lightglue")
    assert message.startswith("lightglue has no weights for colmap_sift_sv32, only for aliked, ")
    assert not (finished.root / "other").exists()
