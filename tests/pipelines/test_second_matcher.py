"""NN+lightglue: queries that the first matcher does not localize are matched by the second one."""

from pathlib import Path

import h5py
import pytest
from command import outcome, refused, run

from hloc_reduce.confs import features as features_confs
from hloc_reduce.confs import matchers as matchers_confs
from hloc_reduce.localization import gate as gates
from hloc_reduce.report import pictures
from hloc_reduce.report.runs import Run
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.h5 import list_h5_names
from pipelines import aachen, batch, localize

BOTH = "--matcher", "NN+lightglue"


@pytest.fixture
def second(monkeypatch):
    """Nearest neighbours stand for LightGlue, which has no weights for SIFT."""
    model = {"name": "nearest_neighbor", "ratio_threshold": 0.9}
    conf = {"output": "matches-lightglue", "model": model}
    monkeypatch.setitem(matchers_confs.confs, "lightglue", conf)


def blind(monkeypatch):
    """The first matcher finds nothing."""
    model = {"name": "nearest_neighbor", "ratio_threshold": 0.01}
    conf = {**matchers_confs.confs["NN-ratio"], "model": model}
    monkeypatch.setitem(matchers_confs.confs, "NN-ratio", conf)


@pytest.mark.usefixtures("second")
def test_queries_of_a_map_that_was_built(place, build_map, monkeypatch):
    """Their intrinsics are not known: mirror images are matched by the second matcher, too."""
    monkeypatch.setattr(gates, "SURE", 2.0)
    _, images, outputs = place
    given = "--map", build_map(), "--query_images", images / "query/day", "--outputs"
    run(monkeypatch, localize, *given, outputs / "first")
    blind(monkeypatch)
    for folder, matcher in (("none", "NN-ratio"), ("second", "lightglue"), ("both", BOTH[1])):
        run(monkeypatch, localize, *given, outputs / folder, "--matcher", matcher)
    rows = {
        name: outcome(outputs / name / "queries-day")[1]
        for name in ("first", "none", "second", "both")
    }
    assert rows["first"]["a.png"]["status"] == "localized"
    assert {row["status"] for row in rows["none"].values()} == {"fallback"}
    again = {name: row.pop("again") for name, row in rows["both"].items()}
    assert again == {"a.png": "True", "grey.png": "False"}  # nothing came nearer
    assert {row.pop("again") for row in rows["second"].values()} == {"False"}
    assert rows["both"] == rows["second"]
    found = Run(outputs / "both/queries-day")
    assert found.summary["matcher"] == "NN+lightglue"
    assert {record["tried"] for record in found.records.values()} == {1}
    assert found.summary["queries_matched_again"] == 1
    assert found.records["a.png"]["measures"]["mirror_image"] is not None
    assert [*(outputs / "both/queries-day").glob("*mirrored_matches-lightglue_*")]
    matched = pictures.matched(found, "a.png")
    assert matched is not None and matched["inliers"].sum() > 50


@pytest.mark.usefixtures("second")
@pytest.mark.parametrize("compact", [(), ("--compact",)])
def test_localized_queries_are_not_matched_again(
    compact, aachen_layout, tmp_path, monkeypatch, caplog
):
    given = "--dataset", aachen_layout, "--outputs"
    for folder, matcher in (("first", ()), ("both", BOTH)):
        run(monkeypatch, aachen, *given, tmp_path / folder, *matcher, *compact)
    folders = [tmp_path / name / ("compact" if compact else "") for name in ("first", "both")]
    first, both = map(outcome, folders)
    assert first[1] == both[1]
    again = list_h5_names(folders[1] / both[0]["tries"]["1"]["matches"])
    assert {name.split("/")[0] for name in again} == {"query-day-grey.png"}  # no keypoints
    assert (tmp_path / "both/sfm_colmap_sift_sv64+NN-ratio").is_dir()
    assert [*folders[1].glob("*NN+lightglue_vlad50.txt")]
    blind(monkeypatch)
    message = refused(monkeypatch, caplog, aachen, *given, tmp_path / "both", *BOTH, *compact)
    assert "differs: matcher" in message


def test_what_the_second_matcher_needs(place, build_map, monkeypatch, caplog):
    """LightGlue has no weights for the map's feature; a map that was built has its matcher."""
    _, images, outputs = place
    given = "--map", build_map(), "--outputs", outputs / "other", *BOTH
    message = refused(monkeypatch, caplog, localize, *given, "--query_images", images / "query/day")
    assert message.startswith("lightglue has no weights for colmap_sift_sv64, only for aliked, ")
    assert not (outputs / "other").exists()
    message = refused(monkeypatch, caplog, localize, *given)
    assert message.startswith("--matcher NN+lightglue is for queries: give --query_images, or ")
    new = "--map_images", images / "db", "--outputs", outputs / "new", *BOTH
    message = refused(monkeypatch, caplog, localize, *new, "--query_images", images / "query/day")
    assert message.startswith("lightglue has no weights for colmap_sift_sv64, only for aliked, ")
    assert not (outputs / "new").exists()
    # what keypoints of a network lack is found before photos are read
    given = "--map", outputs / "map", "--query_images", images / "query/day", "--outputs"
    with h5py.File(next((outputs / "map").glob("feats-*.h5")), "a") as file:
        for name in list_h5_names(Path(file.filename)):
            del file[f"{name}/scales"]
    message = refused(
        monkeypatch, caplog, localize, *given, outputs / "other", "--matcher", "adalam"
    )
    assert message.startswith("The matcher adalam needs scales")
    assert not (outputs / "other").exists()


def test_jobs_of_a_batch_are_checked_first(aachen_layout, tmp_path, monkeypatch, caplog):
    path = tmp_path / "jobs.yaml"
    path.write_text(f"jobs: [{{dataset: {aachen_layout}, matcher: NN+lightglue}}]\n")
    with pytest.raises(SystemExit):
        run(monkeypatch, batch, path)
    assert "lightglue has no weights for colmap_sift_sv64" in caplog.text
    assert not [*tmp_path.rglob("sfm_*")]


def test_the_first_matcher_is_never_lightglue():
    feature = features_confs.confs["aliked"]
    for of_map in ("lightglue", "aliked+lightglue"):
        fast = matchers_confs.fast_of(of_map, feature)
        assert matchers_confs.steps_of(BOTH[1], fast) == ("NN-mutual", "lightglue")
    assert matchers_confs.fast_of("NN-ratio90", feature) == "NN-ratio90"
    with pytest.raises(InputError, match="xfeat.lightglue is not for mini32: choose lightglue"):
        made_from = {"model": features_confs.confs["mini32"]["model"]}
        matchers_confs.for_features(matchers_confs.confs["xfeat+lightglue"]["model"], made_from)
