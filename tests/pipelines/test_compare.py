"""Features compared on one data set."""

import re

import command
import pytest
from conftest import PLANE

from hloc_reduce.evaluation import published
from pipelines import compare, inloc

pytestmark = pytest.mark.check


def test_compare(aachen_layout, tmp_path, monkeypatch, capsys, caplog):
    outputs = tmp_path / "outputs"
    (tmp_path / "broken.yaml").write_text("model: {name: dog, options: {peak_treshold: 1}}")
    given = ("--dataset", aachen_layout, "--outputs", outputs, "--features")
    features = ("sift_sv16", "colmap_sift_sv16", tmp_path / "broken.yaml")
    coded = ("--storage", "float16", "uint2")
    with pytest.raises(SystemExit) as exit:
        command.run(monkeypatch, compare, *given, *features)
    # one failed, which the others do not suffer from
    assert exit.value.code == 2 and "These failed, see above: broken" in caplog.text
    lines = [
        [cell.strip() for cell in line.split("|")] for line in capsys.readouterr().out.splitlines()
    ]
    assert lines == [
        ["", "bytes", "day", "night"],
        ["distance [m]", "", "0.25 / 0.5 / 5", "0.5 / 1 / 5"],
        ["orient. [deg]", "", "2 / 5 / 10", "2 / 5 / 10"],
        ["sift_sv16", "32", "50.0 / 50.0 / 50.0", "100.0 / 100.0 / 100.0"],
        ["colmap_sift_sv16", "32", "50.0 / 50.0 / 50.0", "100.0 / 100.0 / 100.0"],
    ]
    page = (outputs / "report.html").read_text()
    assert "colmap_sift_sv16" in page and "the paper" not in page
    rows = command.table(outputs / "compare.csv")
    assert len(rows) == 2 * 2 * 3
    assert (rows[0]["recall_percent"], rows[0]["paper_percent"]) == ("50.0", "")

    # if it were a data set of the paper
    with monkeypatch.context() as other:
        other.setattr(published, "DATASETS", PLANE)
        command.run(other, compare, *given, *features[:2])
    paper = "in the paper |       | 85.9 / 91.5 / 96.2 | 34.6 / 46.1 / 58.6"
    assert re.sub(" +", " ", paper) in re.sub(" +", " ", capsys.readouterr().out)
    assert "Rows in grey are the paper" in (outputs / "report.html").read_text()
    assert command.table(outputs / "compare.csv")[0]["paper_percent"] == "85.9"

    # finished runs are not repeated
    times = command.state(outputs / "sift_sv16")
    page = tmp_path / "p.html"
    command.run(monkeypatch, compare, *given, "sift_sv16", "-o", page)
    assert page.exists() and len(times) > 10
    assert command.state(outputs / "sift_sv16") == times

    # codes beside floats, with the bytes that they take
    capsys.readouterr()
    with pytest.raises(SystemExit):
        command.run(monkeypatch, compare, *given, "sift", "sift_sv16", *coded, "-o", page)
    assert "sift, uint2 failed: sift has no projection" in caplog.text
    found = [line.split("|")[:2] for line in capsys.readouterr().out.splitlines()[3:]]
    found = [[cell.strip() for cell in cells] for cells in found]
    assert found == [["sift", "256"], ["sift_sv16", "32"], ["sift_sv16, uint2", "4"]]
    assert command.state(outputs / "sift_sv16") == times
    shown = page.read_text().split("<td><b>sift_sv16, uint2</b></td>")[1]
    assert shown.index('<td class="n">4</td>') < shown.index("</tr>")


def test_sizes_of_maps(aachen_layout, tmp_path, monkeypatch, capsys, caplog):
    """The smallest is too small for a point, and all points fit into the second largest."""
    outputs, shown = tmp_path / "outputs", []
    monkeypatch.setattr(compare.report, "main", lambda folders, page: shown.append(folders))
    given = ("--dataset", aachen_layout, "--outputs", outputs, "--features", "colmap_sift_sv32")
    sizes = ("--max_mb", 0.03, 0.001, 0.02, 0.008)
    with pytest.raises(SystemExit) as exit:
        command.run(monkeypatch, compare, *given, *sizes)
    assert exit.value.code == 2
    assert "colmap_sift_sv32, at most 0.001 MB failed: --max_mb 0.001 is too small" in caplog.text
    assert "at most 0.02 MB: all points fit" in caplog.text
    whole = outputs / "colmap_sift_sv32"
    folders = [whole, whole / "compact-0.008MB", whole / "compact-0.02MB"]
    assert shown == [folders]
    assert {path.parent for path in outputs.rglob("map.hlm")} == {*folders[1:]}

    printed = capsys.readouterr().out.splitlines()
    lines = [[cell.strip() for cell in line.split("|")] for line in printed]
    head = ["error [cm]", "inliers"]
    assert lines[0] == ["", "MB", "day", *head, "night", *head]
    of_hloc = lines.pop(4)
    assert of_hloc[0] == "as hloc's files" and float(of_hloc[1]) > float(lines[3][1])
    summaries = [command.outcome(folder)[0] for folder in folders]
    for line, summary in zip(lines[3:], summaries, strict=True):
        night = summary["lists"]["night_time_queries_with_intrinsics"]
        size = f"{summary['map_bytes'] / 1e6:.3g}"
        assert line[0] == "colmap_sift_sv32" + (f", {size} MB" if "compact" in summary else "")
        assert line[1:3] == [size, "50.0 / 50.0 / 50.0"]
        error = f"{100 * night['median_position_error_m']:.2f}"
        assert line[-3:] == ["100.0 / 100.0 / 100.0", error, f"{night['mean_inliers']:.0f}"]
    rows = command.table(outputs / "compare.csv")
    assert [int(row["map_bytes"]) for row in rows[::3][:3]] == [s["map_bytes"] for s in summaries]
    assert rows[0]["hloc_bytes"] and not rows[3]["hloc_bytes"]
    drawn = (outputs / "compare.svg").read_text()
    assert "megabytes of the map" in drawn and "colmap_sift_sv32, night" in drawn

    times = command.state(whole)
    command.run(monkeypatch, compare, *given, "--max_mb", 0.008)
    assert command.state(whole) == times and len(times) > 30


def test_one_storage_with_sizes(aachen_layout, tmp_path, monkeypatch, caplog):
    given = ("--dataset", aachen_layout, "--outputs", tmp_path / "o", "--features", "sift_sv16")
    sizes = ("--storage", "uint4", "uint2", "--max_mb", 0.1)
    said = command.refused(monkeypatch, caplog, compare, *given, *sizes)
    assert said == "Give one --storage with --max_mb."


def test_compare_wrong_input(aachen_layout, inloc_layout, tmp_path, monkeypatch, caplog):
    def message(dataset, *features):
        command_line = ("--dataset", dataset, "--outputs", tmp_path / "o", "--features", *features)
        return command.refused(monkeypatch, caplog, compare, *command_line)

    assert "neither of the folders 3D-models and database" in message(tmp_path, "sift")
    assert "Unknown feature 'sift_sv65'" in message(aachen_layout, "sift", "sift_sv65")
    assert "is a folder: name the HTML file" in message(aachen_layout, "sift", "-o", tmp_path)
    assert "must be above 0" in message(aachen_layout, "sift", "--max_mb", 1, 0)
    assert "in the layout of Aachen" in message(inloc_layout, "sift", "--max_mb", 1)
    assert not (tmp_path / "o").exists()
    (tmp_path / "o/sift/conf.json").mkdir(parents=True)
    given = ("--dataset", aachen_layout, "--outputs", tmp_path / "o", "--features", "sift")
    with pytest.raises(SystemExit):
        command.run(monkeypatch, compare, *given)
    assert "sift failed: " in caplog.text and "None of 1 features could be run" in caplog.text
    assert compare.pipeline_of(inloc_layout) is inloc
