"""Evaluation of poses and of patches, on cases computed by hand."""

import csv
import json

import cv2
import numpy as np
import pytest
import torch
from command import refused, run
from conftest import SHARED
from hypothesis import given
from hypothesis import strategies as st
from pycolmap import Rigid3d, Rotation3d

from hloc_reduce.evaluation import __main__ as evaluation
from hloc_reduce.evaluation import hpatches, poses, published
from hloc_reduce.evaluation.hpatches import data, lists, tasks
from hloc_reduce.evaluation.ranking import average_precision, roc_area
from hloc_reduce.localization.records import RECORDS
from hloc_reduce.runtime.group_writer import GroupWriter
from hloc_reduce.utils import cli
from hloc_reduce.utils.parsers import parse_query_lists, write_poses
from pipelines import aachen


def curve_area(right, number):
    """The area under a precision-recall curve, point by point, of items in their order."""
    tp, points = 0, [(0.0, 1.0)]
    for place, is_right in enumerate(right, 1):
        tp += is_right
        points.append((tp / number, tp / place))
    x, y = np.array(points).T
    return np.trapezoid(y, x)


@given(st.lists(st.booleans(), min_size=1, max_size=30), st.integers(0, 5))
def test_average_precision_is_the_area_under_the_curve(right, missed):
    number = sum(right) + missed
    ranks = np.flatnonzero(right) + 1
    if number:
        assert average_precision(ranks, number) == pytest.approx(curve_area(right, number))


def test_average_precision_by_hand():
    assert average_precision(np.array([1, 2, 3]), 3) == 1
    assert average_precision(np.array([2]), 1) == 0.25  # from precision 0 to 1/2
    # (1 + 1) / 2 for the first; the second comes fourth, from 1/3 to 2/4; the third is missed
    assert average_precision(np.array([1, 4]), 3) == pytest.approx((1 + 5 / 12) / 3)
    assert average_precision(np.array([], int), 4) == 0


def test_roc_area_by_hand():
    assert roc_area(np.array([1.0, 2]), np.array([3.0, 4])) == 1
    assert roc_area(np.array([1.0, 1]), np.array([1.0, 1])) == 0  # ties count against
    assert roc_area(np.array([1.0, 3]), np.array([2.0, 4])) == 0.75


def test_matching_by_hand():
    rows = np.eye(6, dtype=np.float32)
    assert tasks.matching_ap(rows, rows) == 1
    # all are equally far: the first of the second image is every row's nearest
    constant = np.ones((6, 4), np.float32)
    assert tasks.matching_ap(constant, constant) == pytest.approx(1 / 6, abs=1e-6)
    # two rows are exchanged: equally near as the others, and first in their order
    swapped = rows[[1, 0, 2, 3, 4, 5]]
    expected = curve_area([False, False, True, True, True, True], 6)
    assert tasks.matching_ap(rows, swapped) == pytest.approx(expected, abs=1e-6)
    # row 3 finds row 0 at once, and before all others
    wrong = 0.9 * rows
    wrong[0] = rows[3]
    expected = curve_area([False, True, True, True, True, False], 6)
    assert tasks.matching_ap(rows, wrong) == pytest.approx(expected, abs=1e-6)


def described(tmp_path, of_sequence):
    """The descriptors of two sequences, of 4 and 3 patches; of_sequence(number, kind)."""
    sequences = ["i_one", "v_two"]
    with GroupWriter(tmp_path / "d.h5", {}) as writer:
        for number, name in enumerate(sequences):
            writer.add(name, {kind: of_sequence(number, kind) for kind in data.TYPES})
    return data.Descriptors(tmp_path / "d.h5", sequences, torch.nn.Identity())


def perfect(number, kind):
    return np.eye(7, dtype=np.float32)[:4] if number == 0 else np.eye(7, dtype=np.float32)[4:]


def constant(number, kind):
    return np.ones((4 - number, 7), np.float32)


FIRST = [(0, 0), (2, 5), (3, 2), (1, 1), (1, 6)]
PAIRS = {
    "pos": [(1, 0), (0, 5), (4, 2), (5, 1), (2, 6)],
    "neg_inter": [(1, 4), (0, 1), (4, 6), (5, 5), (2, 3)],
    "neg_intra": [(1, 1), (0, 4), (4, 0), (5, 3), (2, 5)],
}
PAIRS = {kind: np.stack([FIRST, second], axis=1) for kind, second in PAIRS.items()}


def test_a_perfect_descriptor(tmp_path):
    descriptors = described(tmp_path, perfect)
    pool = np.array([1, 2, 4, 5])
    for scores in (
        tasks.matching(descriptors),
        tasks.verification(descriptors, PAIRS),
        tasks.retrieval(descriptors, np.array([0, 6]), pool),
    ):
        assert {score for _, _, score in scores} == {1}


def test_a_constant_descriptor(tmp_path):
    descriptors = described(tmp_path, constant)
    scores = list(tasks.matching(descriptors))
    assert len(scores) == 2 * 3 * 5
    assert {round(score, 6) for _, _, score in scores} == {0.25, 0.333333}
    # the only one of the positives that is left comes after five negatives
    for _, variant, score in tasks.verification(descriptors, PAIRS):
        assert score == pytest.approx(0 if "imb" not in variant else 1 / 12, abs=1e-6)
    # its own patches are first
    for _, _, score in tasks.retrieval(descriptors, np.array([0, 6]), np.array([1, 2, 4, 5])):
        assert score == 1


def test_verification_by_hand(tmp_path):
    """Patches at 0, 1, 2, ... on a line; noise moves those of image 1 and of hard image 2."""

    def line(number, kind):
        places = np.arange(4 - number)[:, None] + (0 if number == 0 else 4.0)
        return (places + {"e1": 0.25, "h1": 1.5}.get(kind, 0)).astype(np.float32)

    descriptors = described(tmp_path, line)
    right = np.stack([[(0, 0), (1, 5), (1, 1), (0, 2), (2, 3)]] * 2, axis=1)
    right[:, 1, 0] = [1, 0, 2, 1, 3]  # the same patches in other images
    wrong = [
        [(0, 0), (1, 1)],
        [(2, 5), (0, 3)],
        [(3, 1), (2, 3)],
        [(1, 3), (0, 4)],
        [(4, 2), (5, 2)],
    ]
    pairs = {"pos": right, "neg_inter": np.array(wrong), "neg_intra": np.array(wrong)}
    scores = {
        (noise, variant): score
        for noise, variant, score in tasks.verification(descriptors, pairs)
        if "inter" in variant
    }
    # easy: right 1/4, 1/4, 1/4, 1/4, 0; wrong 5/4, 2, 2, 3/4, 0
    assert scores["e", "inter balanced"] == pytest.approx((4 * 4 + 4) / 25, abs=1e-6)
    # of the positives the first one is left: second after the equal patches of the last pair
    assert scores["e", "inter imbalanced"] == pytest.approx((0 + 1 / 2) / 2, abs=1e-6)
    # hard: 3/2, and wrong 5/2, 2, 2, 1/2, 0
    assert scores["h", "inter imbalanced"] == pytest.approx((0 + 1 / 3) / 2, abs=1e-6)


def test_retrieval_by_hand(tmp_path):
    right = np.array([[1.0, 2, 3, 4, 5]] * 3)
    # in the smallest pool there are 95 distractors
    wrong = np.array([2, 0.5, *[9] * 93, 0.1, 0.1])
    ranks = tasks.ranks_in_pools(right, wrong)
    assert ranks.shape == (3, len(tasks.POOLS), 5)
    assert ranks[0, 0].tolist() == [2, 3, 5, 6, 7]  # its own before the equal one
    assert ranks[2, 1].tolist() == [4, 5, 7, 8, 9]
    assert tasks.ranks_in_pools(right, np.array([]))[0, 3].tolist() == [1, 2, 3, 4, 5]

    # its own patches are as far as a distractor, which counts as farther
    generator = np.random.default_rng(0)
    for i in range(10):
        rows = torch.nn.functional.normalize(torch.from_numpy(generator.normal(size=(3, 128))))
        reference, noisy, other = rows.float().numpy()

        def tied(number, kind, reference=reference, noisy=noisy, other=other):
            first = reference if kind == "ref" else noisy
            return np.stack([first, other, other, other] if number == 0 else [noisy] * 3)

        (tmp_path / str(i)).mkdir()
        descriptors = described(tmp_path / str(i), tied)
        scores = tasks.retrieval(descriptors, np.array([0]), np.array([4, 5, 6]))
        assert {score for _, _, score in scores} == {1}

    def line(number, kind):
        return np.arange(4 - number)[:, None].astype(np.float32) + 4 * number

    descriptors = described(tmp_path, line)
    # the distractors 1, 2, 3 are of the query's own sequence
    for _, _, score in tasks.retrieval(descriptors, np.array([0]), np.array([1, 2, 3, 5])):
        assert score == 1


@pytest.fixture
def root(tmp_path):
    """Six sequences of 12 to 22 patches, whose noise grows from easy to tough."""
    generator = np.random.default_rng(0)
    root, shared = tmp_path / "hpatches", generator.uniform(0, 255, (9, 9))
    for number, name in enumerate(("i_a", "i_b", "i_c", "v_a", "v_b", "v_c")):
        folder = root / name
        folder.mkdir(parents=True)
        patches = 0.9 * shared + 0.1 * generator.uniform(0, 255, (12 + 2 * number, 9, 9))
        patches = np.stack([cv2.resize(patch, (65, 65)) for patch in patches])
        for kind in data.TYPES:
            noise = 0 if kind == "ref" else {"e": 10, "h": 40, "t": 120}[kind[0]]
            noisy = patches + noise * generator.standard_normal(patches.shape)
            image = noisy.clip(0, 255).astype(np.uint8).reshape(-1, 65)
            cv2.imwrite(str(folder / f"{kind}.png"), image)
    tests = {"test": ["v_b", "i_a", "i_c"], "train": []}
    (root / "tasks").mkdir()
    (root / "tasks/splits.json").write_text(json.dumps({"a": tests}))
    return root


def rows_of(path):
    with path.open() as file:
        return list(csv.DictReader(file))


@pytest.fixture
def few(monkeypatch):
    """Short lists."""
    monkeypatch.setattr(lists, "NUM_PAIRS", 500)
    monkeypatch.setattr(lists, "NUM_QUERIES", 10)
    monkeypatch.setattr(lists, "NUM_DISTRACTORS", 20)


def test_hpatches(root, few, tmp_path, monkeypatch, capsys):
    outputs = tmp_path / "outputs"
    command = ["hpatches", "--root", root, "--outputs", outputs, "--feature", "sift", "sift_sv16"]
    run(monkeypatch, evaluation, *command)
    printed = capsys.readouterr().out
    assert "24.78" in printed and "69.69" in printed and "37.49" in printed  # the paper's sift
    first, second = rows_of(outputs / "a.csv")
    assert (first["feature"], second["feature"]) == ("sift", "sift_sv16")
    for task in hpatches.TASKS:
        by_noise = [float(first[f"{task}_{noise}"]) for noise in ("easy", "hard", "tough")]
        assert 100 >= by_noise[0] > by_noise[2] > 0
        assert float(first[task]) == pytest.approx(np.mean(by_noise))
        assert f"{float(first[task]):.2f}" in printed
    scores = rows_of(outputs / "a_scores.csv")
    # of two features: each image, both protocols with both negatives, seven pools
    assert len(scores) == 2 * 3 * (3 * 5 + 4 + 7)
    picture = (outputs / "a.svg").read_text()
    assert "sift_sv16" in picture and "mean in the paper" in picture

    # what is there is not computed again, and a smaller choice prints less
    monkeypatch.setattr(tasks, "matching", None)
    monkeypatch.setattr(data, "read_patches", None)
    run(monkeypatch, evaluation, *command, "--task", "matching")
    assert "69.69" not in capsys.readouterr().out


def test_hpatches_lists_are_the_benchmarks(root, few, tmp_path):
    """What is drawn is what the benchmark's calls draw, and lists of its files are used."""
    sizes = {"v_b": 20, "i_a": 12, "i_c": 16}
    drawn = lists.draw_pairs(sizes, 50)
    np.random.seed(42)
    sequences = np.random.choice(list(sizes), 50)
    patches = [np.random.choice(np.arange(sizes[s]), 2, replace=False) for s in sequences]
    images = [np.random.choice(np.arange(5), 2, replace=False) for _ in range(50)]
    others = np.random.choice(list(sizes), 50)
    other_patches = [np.random.randint(sizes[s]) for s in others]
    for i, name in enumerate(sequences):
        one = (name, images[i][0], patches[i][0])
        assert drawn["pos"][i] == (*one, name, images[i][1], patches[i][0])
        assert drawn["neg_intra"][i] == (*one, name, images[i][1], patches[i][1])
        assert drawn["neg_inter"][i] == (*one, others[i], images[i][1], other_patches[i])

    def contrast(name):
        return np.where(np.arange(sizes[name]) % 2, 5.0, 20.0)

    drawn = lists.draw_pools(sizes, contrast, 5, 10)
    np.random.seed(42)
    every = []
    for number in (20, 100):
        sequences = np.random.choice(list(sizes), number)
        every.append([(s, np.random.randint(sizes[s])) for s in sequences])
    queries, distractors = ([p for p in part if p[1] % 2 == 0] for part in every)
    queries = list(dict.fromkeys(queries))[:5]
    assert drawn["queries"] == queries
    kept = [p for p in dict.fromkeys(distractors) if p not in queries]
    assert drawn["distractors"] == kept[:10]

    (tmp_path / "lists").mkdir()
    for kind, rows in (("queries", ["i_a,3", "i_c,0"]), ("distractors", ["v_b,19"])):
        text = "\n".join(["s,idx", *rows])
        (tmp_path / f"lists/retr_{kind}_split-a.csv").write_text(text)
    task_lists = lists.TaskLists(tmp_path / "lists", tmp_path / "drawn", "a", sizes)
    found = task_lists.pools(contrast)
    assert [part.tolist() for part in found] == [[23, 32], [19]]


def test_hpatches_wrong_input(root, few, tmp_path, monkeypatch, caplog):
    def message(*arguments):
        return refused(
            monkeypatch,
            caplog,
            evaluation,
            *("hpatches", "--root", root, "--outputs", tmp_path / "o", *arguments),
        )

    assert "Unknown split 'd'" in message("--feature", "sift", "--split", "d")
    assert "no split b" in message("--feature", "sift", "--split", "b")
    assert "Unknown task 'match'" in message("--feature", "sift", "--task", "match")
    assert "describes photos" in message("--feature", "colmap_sift_sv64")
    assert "Unknown feature" in message("--feature", "sift_sv65")
    assert "no sequence" in message("--root", tmp_path, "--feature", "sift")
    listed = root / "tasks/retr_queries_split-a.csv"
    (root / "tasks/retr_distractors_split-a.csv").write_text("s,idx\ni_a,1\n")
    for text, reason in (
        ("s,idx\ni_a,12\n", "line 2: i_a has 12 patches"),
        ("s,idx\ni_b,1\n", "'i_b' is not of this split"),
        ("s,idx\ni_a,1,2\n", "line 2"),
        ("s,idx\ni_a,x\n", "line 2"),
        ("s,idx\n", "is empty"),
        ("a,b\n", "does not begin with s,idx"),
    ):
        listed.write_text(text)
        assert reason in message("--feature", "sift", "--task", "retrieval")
    cv2.imwrite(str(root / "i_c/e3.png"), np.zeros((65 * 3 + 1, 65), np.uint8))
    (tmp_path / "o/descriptors_sift.h5").unlink()
    assert "not a column of patches" in message("--feature", "sift")
    cv2.imwrite(str(root / "i_c/e3.png"), np.zeros((65 * 3, 65), np.uint8))
    assert "different numbers of patches" in message("--feature", "sift")
    (root / "tasks/splits.json").write_text("{")
    assert "is broken" in message("--feature", "sift")
    (root / "tasks/splits.json").unlink()
    assert "give the tasks folder" in message("--feature", "sift")
    (root / "i_c/ref.png").unlink()
    assert data.test_sequences(root, root / "tasks", "illum") == ["i_a", "i_b"]


def test_published_numbers():
    assert published.hpatches()["sift_sv64"].keys() == {"matching", "verification", "retrieval"}
    assert len(published.hpatches()) == len(published.localization()) == 68
    assert published.localization()["sift"]["aachen_day_0.25m_2deg"] == 88.1


def numbered(folder, number):
    return [f"{folder}/{i}.jpg" for i in range(number)]


DAY, NIGHT = numbered("query/day/milestone", 824), numbered("query/night/nexus5x", 191)
PHOTOS = numbered("query/iphone7", 329)


@pytest.mark.parametrize(
    "lists, expected",
    [
        ({"day_time_queries": DAY, "night_time_queries": NIGHT}, "Aachen Day-Night v1.1"),
        ({"day_time_queries": DAY, "night_time_queries": NIGHT[:98]}, None),  # v1.0
        ({"day_time_queries": DAY}, None),
        ({"day_time_queries": numbered("query", 824), "night_time_queries": NIGHT}, None),
        ({"DUC1": PHOTOS[:198], "DUC2": PHOTOS[198:]}, "InLoc"),
        ({"DUC1": PHOTOS[:8], "DUC2": PHOTOS[8:16]}, None),
        ({"query": PHOTOS}, None),
        ({}, None),
    ],
)
def test_a_data_set_is_known_by_its_queries(lists, expected):
    assert published.dataset(lists) == expected


def test_real_lists_are_told_apart(herz_jesus):
    found = {}
    for folder in (herz_jesus / "queries", SHARED / "aachen_v1.1"):
        queries = parse_query_lists(folder / "*_time_queries_with_intrinsics.txt")
        lists = {name: [query for query, _ in part] for name, part in queries.items()}
        found[folder.name] = published.dataset(lists)
    assert found == {"queries": None, "aachen_v1.1": "Aachen Day-Night v1.1"}


def rigid(x, degrees=0.0):
    half = np.radians(degrees) / 2
    rotation = Rotation3d(np.array([0, 0, np.sin(half), np.cos(half)]))
    return Rigid3d(rotation, rotation.matrix() @ np.array([-x, 0.0, 0.0]))


@pytest.fixture
def two_lists(tmp_path):
    """True poses of four queries by day, two by night; estimates by base names, one missing."""
    truth = {f"query/day/{i}.jpg": rigid(i) for i in range(4)}
    truth |= {f"query/night/n{i}.jpg": rigid(i) for i in range(2)}
    estimates = {
        "0.jpg": rigid(0.1, 1),
        "1.jpg": rigid(1.4, 1),
        "2.jpg": rigid(2.1, 3),
        "n0.jpg": rigid(0.4, 1),
        "n1.jpg": rigid(8, 170),
    }
    write_poses(truth, tmp_path / "truth.txt", None)
    write_poses(estimates, tmp_path / "poses.txt")
    return tmp_path


def test_poses(two_lists, monkeypatch, capsys):
    files = ["--estimates", two_lists / "poses.txt", "--ground_truth", two_lists / "truth.txt"]
    run(monkeypatch, evaluation, "poses", *files, "--outputs", two_lists / "o")
    printed = capsys.readouterr().out
    # by day 0 within all, 1 and 2 within (0.5 m, 5 deg), 3 missing; by night n0 within all
    assert "25.0 / 75.0 / 75.0" in printed and "50.0 / 50.0 / 50.0" in printed
    # of 0.1, 0.4, 0.1, inf m and 1, 1, 3, inf deg
    assert "day: 4 queries, median errors 0.250 m, 2.000 deg" in printed
    assert printed.splitlines()[-2:] == [
        "Failures without a pose: 1",
        "query/day/3.jpg",
    ]
    rows = rows_of(two_lists / "o/errors.csv")
    assert len(rows) == 6 and rows[3]["position_error_m"] == ""
    assert [row["status"] for row in rows] == [*["localized"] * 3, "failed", *["localized"] * 2]
    assert float(rows[1]["position_error_m"]) == pytest.approx(0.4)
    curve = [
        (float(row["value"]), float(row["percent"]))
        for row in rows_of(two_lists / "o/curves.csv")
        if (row["list"], row["error"]) == ("day", "m")
    ]
    np.testing.assert_allclose(curve, [(0.1, 25), (0.1, 50), (0.4, 75)], atol=1e-9)
    assert "position error" in (two_lists / "o/curves.svg").read_text()

    run(
        monkeypatch,
        evaluation,
        "poses",
        *files,
        "--thresholds",
        "0.15,2",
        "1,180",
        "--outputs",
        two_lists / "p",
    )
    assert "16.7 / 66.7" in capsys.readouterr().out
    run(
        monkeypatch,
        evaluation,
        "poses",
        *files,
        "--thresholds",
        "inloc",
        "--outputs",
        two_lists / "p",
    )
    assert "33.3 / 66.7 / 66.7" in capsys.readouterr().out


def test_whole_names_of_estimates_come_first():
    truth = {name: rigid(0) for name in ("sub/x.jpg", "x.jpg")}
    assert poses.find_estimates({"x.jpg": rigid(1)}, truth).keys() == {"x.jpg"}
    assert poses.find_estimates({"sub/x.jpg": rigid(1)}, truth).keys() == {"sub/x.jpg"}


def test_poses_of_a_pipeline_are_evaluated_as_in_its_summary(
    aachen_layout, tmp_path, monkeypatch, capsys
):
    given = ("--dataset", aachen_layout, "--outputs", tmp_path / "o", "--feature", "colmap_sift")
    run(monkeypatch, aachen, *given)
    capsys.readouterr()
    lists = json.loads((tmp_path / "o/summary.json").read_text())["lists"]
    (logs,) = (tmp_path / "o").glob("*_logs.jsonl")
    truth = aachen_layout / "queries/ground_truth_poses.txt"
    files = ("--estimates", logs, "--ground_truth", truth, "--outputs", tmp_path / "e")
    run(monkeypatch, evaluation, "poses", *files)
    printed = capsys.readouterr().out
    assert "50.0 / 50.0 / 50.0" in printed and "100.0 / 100.0 / 100.0" in printed
    for name, summary in lists.items():
        medians = [summary[f"median_{key}"] for key in ("position_error_m", "rotation_error_deg")]
        number = summary["queries"]
        said = "{}: {} queries, median errors {:.3f} m, {:.3f} deg"
        assert said.format(name.split("_")[0], number, *medians) in printed
    assert printed.endswith("Failures with a fallback pose: 1\nquery/day/grey.png\n")
    with (next((tmp_path / "o").glob("queries.csv"))).open() as file:
        expected = {row["query"]: row for row in csv.DictReader(file)}
    for row in rows_of(tmp_path / "e/errors.csv"):
        for key in ("status", "position_error_m", "rotation_error_deg"):
            assert row[key] == expected[row["query"]][key]


def test_fallbacks_only(two_lists, monkeypatch, capsys):
    """What a run leaves that localized nothing."""
    record = {"localized": False, "qvec": [1, 0, 0, 0], "tvec": [0, 0, 0]}
    lines = [{"records": RECORDS}, ["query/day/0.jpg", record]]
    (two_lists / "p_logs.jsonl").write_text("\n".join(map(json.dumps, lines)) + "\n")
    files = ("--estimates", two_lists / "p_logs.jsonl", "--ground_truth", two_lists / "truth.txt")
    run(monkeypatch, evaluation, "poses", *files, "--outputs", two_lists / "o")
    printed = capsys.readouterr().out
    assert "0.0 / 0.0 / 0.0" in printed and "Failures with a fallback pose: 1" in printed
    assert (two_lists / "o/curves.csv").read_text() == "list,error,value,percent\n"


def test_exact_poses_and_unknown_names(two_lists, monkeypatch, capsys, caplog, recwarn):
    """On a logarithmic axis there is no 0."""
    lines = (two_lists / "truth.txt").read_text()
    (two_lists / "exact.txt").write_text(lines + lines.splitlines()[0].replace("day/0", "day/O"))
    files = ("--estimates", two_lists / "exact.txt", "--ground_truth", two_lists / "truth.txt")
    monkeypatch.setattr(cli.logger, "propagate", True)
    run(monkeypatch, evaluation, "poses", *files, "--outputs", two_lists / "o")
    assert "1 estimates are of other queries: query/day/O.jpg." in caplog.text
    assert "day: 4 queries, median errors 0.000 m, 0.000 deg" in capsys.readouterr().out
    assert not list(recwarn)


def test_poses_wrong_input(two_lists, monkeypatch, caplog):
    def message(*arguments, estimates="poses.txt"):
        files = ["--estimates", two_lists / estimates, "--ground_truth", two_lists / "truth.txt"]
        return refused(monkeypatch, caplog, evaluation, "poses", *files, *arguments)

    assert "aachen, inloc or pairs" in message("--thresholds", "0.25")
    assert "aachen, inloc or pairs" in message("--thresholds", "aachen", "0,1")
    assert "in another file" in message("--ground_truth", two_lists / "truth.txt")
    assert "Cannot read" in message(estimates="absent.txt")
    assert "poses.txt is a file" in message("--outputs", two_lists / "poses.txt/o")
    write_poses({"x.jpg": rigid(0)}, two_lists / "other.txt")
    assert "no pose of a query" in message(estimates="other.txt")
    write_poses({"a/day/0.jpg": rigid(0), "b/0.jpg": rigid(0)}, two_lists / "more.txt", None)
    assert "could be of" in message("--ground_truth", two_lists / "more.txt")
    # base names of two lists in one file: the second one is not taken for the first
    lines = (two_lists / "poses.txt").read_text()
    (two_lists / "twice.txt").write_text(lines + lines)
    assert "twice.txt:6: 0.jpg is listed twice" in message(estimates="twice.txt")
    (two_lists / "nan.txt").write_text("0.jpg 1 0 0 0 nan 0 0\n")
    assert "nan.txt:1: not a pose" in message(estimates="nan.txt")
    (two_lists / "logs.jsonl").write_text("{}\n")
    assert "run the localization again" in message(estimates="logs.jsonl")
    (two_lists / "empty.txt").touch()
    assert "has no pose" in message("--ground_truth", two_lists / "empty.txt")


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
    assert [row["feature"] for row in rows_of(tmp_path / "o/town.csv")] == ["sift", "sift_sv64"]
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
