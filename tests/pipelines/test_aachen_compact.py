"""The main job in a compact map, one file."""

import pytest
from command import outcome, run, state

from hloc_reduce import compact, report
from hloc_reduce.localization.records import log_file, read_records
from pipelines import aachen, localize

PIPELINE = aachen


@pytest.fixture
def given(aachen_layout, tmp_path):
    """The options of a run of the plane."""
    feature = ("--feature", "colmap_sift_sv32")
    return ("--dataset", aachen_layout, "--outputs", tmp_path / "outputs", *feature)


def records(folder):
    return read_records(log_file(folder / outcome(folder)[0]["poses"]))


def test_a_compact_map_localizes_as_its_file(given, aachen_layout, tmp_path, monkeypatch):
    run(monkeypatch, aachen, *given)
    outputs = tmp_path / "outputs"
    whole, before = outcome(outputs)[0], state(outputs)
    run(monkeypatch, aachen, *given, "--compact")
    shared = {path: time for path, time in state(outputs).items() if path in before}
    assert {path.name for path in before if shared[path] != before[path]} <= {"files.json"}

    folder = outputs / "compact"
    summary, rows = outcome(folder)
    assert summary["map_bytes"] == (folder / "map.hlm").stat().st_size < 0.1 * whole["map_bytes"]
    assert summary["compact"] == "map.hlm" and summary["matcher"] == "NN-ratio90"
    assert summary["lists"].keys() == whole["lists"].keys() and len(rows) == 3
    assert summary["queries_localized"] == 2 and summary["map_points3D"] == whole["map_points3D"]
    assert summary["seconds"]["triangulation"] == whole["seconds"]["triangulation"]
    assert rows["query/day/grey.png"]["reason"] == "no keypoints"

    # the same poses as from the file alone
    images, queries = aachen_layout / "images_upright", aachen_layout / "queries/*_intrinsics.txt"
    new = ("--query_images", images, "--queries", queries, "--outputs", tmp_path / "file")
    run(monkeypatch, localize, "--map", folder / "map.hlm", *new)
    (localized,) = (tmp_path / "file").glob("queries-*")
    assert records(localized) == records(folder)

    # nothing is repeated, and both are shown in one report
    times = state(folder)
    run(monkeypatch, aachen, *given, "--compact")
    assert state(folder) == times
    page = report.main([outputs, folder], tmp_path / "r.html").read_text()
    assert f"colmap_sift_sv32, {summary['map_bytes'] / 1e6:.3g} MB" in page
    assert "megabytes of the map" in page


def test_a_compact_map_of_another_map_is_stale(given, tmp_path, monkeypatch, caplog):
    limit = ("--compact", "--max_mb", "0.012")
    run(monkeypatch, aachen, *given, *limit)
    folder = tmp_path / "outputs/compact-0.012MB"
    first = (folder / "map.hlm").stat()
    assert first.st_size <= 12_000 and not (tmp_path / "outputs/summary.json").exists()
    (model,) = (tmp_path / "outputs").glob("sfm_*")
    (model / "made_from.json").unlink()
    run(monkeypatch, aachen, *given, *limit)
    assert "stale, as the map or its packing has changed" in caplog.text
    second = (folder / "map.hlm").stat()
    assert second.st_mtime_ns > first.st_mtime_ns
    monkeypatch.setattr(compact, "PACKED", compact.PACKED + 1)
    run(monkeypatch, aachen, *given, *limit)
    assert (folder / "map.hlm").stat().st_mtime_ns > second.st_mtime_ns
    assert outcome(folder)[0]["queries_localized"] == 2
    run(monkeypatch, aachen, *given, "--matcher", "NN-mutual", "--overwrite")
    assert not folder.exists()


def test_wrong_sizes(given, tmp_path, refused):
    assert "give --compact, too" in refused(*given, "--max_mb", "1")
    assert "--max_mb 0: it must be above 0" in refused(*given, "--compact", "--max_mb", "0")
    pairs = tmp_path / "pairs.txt"
    pairs.write_text("query/day/a.png db/3.png\n")
    assert "leave out --retrieval" in refused(*given, "--compact", "--retrieval", pairs)
    assert not (tmp_path / "outputs").exists()
    assert "--max_mb 0.001 is too small" in refused(*given, "--compact", "--max_mb", "0.001")
