"""The command line of HPatches, on a small data set in its layout."""

import csv
import json

import cv2
import numpy as np
import pytest
from command import refused, run

from hloc_reduce.evaluation import __main__ as evaluation
from hloc_reduce.evaluation import hpatches
from hloc_reduce.evaluation.hpatches import data, lists, tasks


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
        for kind in data.PATCH_TYPES:
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

    # existing scores are not computed again, and a smaller choice prints less
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


@pytest.fixture
def message(root, few, tmp_path, monkeypatch, caplog):
    """Run with wrong input; return the message."""
    given = ("hpatches", "--root", root, "--outputs", tmp_path / "o", "--feature", "sift")
    return lambda *options: refused(monkeypatch, caplog, evaluation, *given, *options)


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["--split", "d"], "Unknown split 'd'"),
        (["--split", "b"], "no split b"),
        (["--task", "match"], "Unknown task 'match'"),
        (["--feature", "colmap_sift_sv64"], "describes photos"),
        (["--feature", "sift_sv65"], "Unknown feature"),
        (["--root", "."], "no sequence"),
    ],
)
def test_wrong_options(message, tmp_path, monkeypatch, options, expected):
    monkeypatch.chdir(tmp_path)
    assert expected in message(*options)


def test_wrong_lists(root, message):
    (root / "tasks/retr_distractors_split-a.csv").write_text("s,idx\ni_a,1\n")
    for text, reason in (
        ("s,idx\ni_a,12\n", "line 2: i_a has 12 patches"),
        ("s,idx\ni_b,1\n", "'i_b' is not of this split"),
        ("s,idx\ni_a,1,2\n", "line 2"),
        ("s,idx\ni_a,x\n", "line 2"),
        ("s,idx\n", "is empty"),
        ("a,b\n", "does not begin with s,idx"),
    ):
        (root / "tasks/retr_queries_split-a.csv").write_text(text)
        assert reason in message("--task", "retrieval")


def test_broken_files(root, message):
    for rows, reason in (
        (65 * 3 + 1, "not a column of patches"),
        (65 * 3, "different numbers of patches"),
    ):
        cv2.imwrite(str(root / "i_c/e3.png"), np.zeros((rows, 65), np.uint8))
        assert reason in message()
    (root / "tasks/splits.json").write_text("{")
    assert "is broken" in message()
    (root / "tasks/splits.json").unlink()
    assert "give the tasks folder" in message()
    (root / "i_c/ref.png").unlink()
    assert data.test_sequences(root, root / "tasks", "illum") == ["i_a", "i_b"]
