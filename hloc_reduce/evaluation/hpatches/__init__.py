"""HPatches: matching, verification and retrieval of patches (Balntas et al., CVPR 2017)."""

import hashlib
import json
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import numpy as np
import torch

from ... import projections
from ...confs import features as features_confs
from ...descriptors import check_weights
from ...runtime import provenance
from ...utils import cli
from ...utils.files import write_csv
from ...utils.h5 import file_provenance, open_h5
from ...utils.paths import strings_as_paths
from .. import published
from . import data, lists, tasks
from .data import NOISE, Descriptors

# what the one number of a task, which the paper has, is the mean of
VARIANTS = {
    "matching": lambda variant: True,
    "verification": lambda variant: variant.endswith("imbalanced"),
    "retrieval": lambda variant: True,
}
TASKS = tuple(VARIANTS)
PAPERS = "a"  # the split that the paper has numbers of


@strings_as_paths
def main(
    root: Path,
    features: Iterable[str],
    outputs: Path,
    split: str = "a",
    task_lists: Path | None = None,
    chosen: Iterable[str] = TASKS,
) -> list[dict]:
    """Evaluate features.

    Args:
        root: the folder of HPatches' sequences.
        features: names, or YAML files, of features of patches.
        outputs: folder for the descriptors, the lists that are drawn, and the scores.
        split: one of `data.SPLITS`.
        task_lists: the folder `tasks` of the benchmark; default: `root`/tasks.
        chosen: tasks.

    Returns:
        A dict for each feature: `feature`, of each task the mean average precision [%], of each
        noise as `<task>_easy` and so on, and as `<task>_paper` the paper's, or None.
        `<outputs>/<split>.csv` has the same, and `<outputs>/<split>_scores.csv` what it is the
        mean of.

    Raises:
        InputError: when the data or a feature is not there, or broken.
    """
    task_lists = task_lists or root / "tasks"
    sequences = data.test_sequences(root, task_lists, split)
    chosen = [cli.choose("task", task, TASKS) for task in chosen]
    known = {}
    for feature in features:
        base, projection = features_confs.of_patches(feature)
        check_weights(base)
        checksum = projection and projections.checksum(projection)
        known[features_confs.get(feature)[0]] = base, projection, checksum
    scores = {}
    for name, (base, projection, checksum) in known.items():
        file = outputs / f"descriptors_{base}.h5"
        data.describe(root, sequences, base, file)
        with open_h5(file) as described:
            made_from = {
                "descriptors": file_provenance(described),
                "projection": checksum,
                "sequences": sequences,
                "lists": provenance.stamp({}, sorted(task_lists.glob(f"*_split-{split}.csv"))),
            }
        scores[name] = _score(
            outputs / split / f"{name}.json",
            made_from,
            chosen,
            _evaluations(root, task_lists, outputs, split, file, sequences, projection),
        )
    paper = published.hpatches() if split == PAPERS else {}
    rows = [
        {"feature": name, **_means(found, paper.get(name, {}))} for name, found in scores.items()
    ]
    write_csv(_score_rows(scores), outputs / f"{split}_scores.csv")
    write_csv(rows, outputs / f"{split}.csv")
    return rows


def _evaluations(
    root: Path,
    task_lists: Path,
    outputs: Path,
    split: str,
    file: Path,
    sequences: list[str],
    projection: str | None,
) -> Callable[[str], Iterator[tuple[str, str, float]]]:
    """Return what evaluates a feature in a task; its descriptors are read once."""
    read = {}

    def contrast(sequence: str) -> np.ndarray:
        return data.read_patches(root / sequence / "ref.png").std(axis=(1, 2))

    def evaluate(task: str) -> Iterator[tuple[str, str, float]]:
        if not read:
            project = torch.nn.Identity() if projection is None else projections.load(projection)
            read["descriptors"] = Descriptors(file, sequences, project)
        descriptors = read["descriptors"]
        sizes = descriptors.sizes
        made_of = hashlib.sha256(json.dumps(list(sizes.items())).encode()).hexdigest()[:8]
        where = task_lists, outputs / "tasks" / made_of, split, sizes
        if task == "matching":
            return tasks.matching(descriptors)
        if task == "verification":
            return tasks.verification(descriptors, lists.pairs(*where))
        return tasks.retrieval(descriptors, *lists.pools(*where, contrast))

    return evaluate


def _score(
    path: Path,
    made_from: dict,
    chosen: list[str],
    evaluate: Callable[[str], Iterator[tuple[str, str, float]]],
) -> dict[str, list]:
    """Return the scores of a feature in each task, those that a file has and those computed now."""
    before = provenance.read(path)
    current = before.get("made_from") == json.loads(json.dumps(made_from))
    scores = before["scores"] if current else {}
    for task in chosen:
        if task not in scores:
            scores[task] = list(evaluate(task))
            provenance.write(path, {"made_from": made_from, "scores": scores})
    return {task: scores[task] for task in chosen}


def _score_rows(scores: dict[str, dict[str, list]]) -> list[dict]:
    return [
        {
            "feature": feature,
            "task": task,
            "noise": NOISE[noise],
            "variant": variant,
            "score": score,
        }
        for feature, by_task in scores.items()
        for task, rows in by_task.items()
        for noise, variant, score in rows
    ]


def _means(scores: dict[str, list], paper: dict[str, float]) -> dict:
    """Return the means [%] of a feature's scores in each task, next to the paper's."""
    means = {}
    for task, found in scores.items():
        by_noise = of_noise(task, found)
        means[task] = 100 * float(np.mean(list(by_noise.values())))
        means |= {f"{task}_{NOISE[key]}": 100 * value for key, value in by_noise.items()}
        means[f"{task}_paper"] = paper.get(task)
    return means


def of_noise(task: str, scores: list[tuple[str, str, float]]) -> dict[str, float]:
    """Return the mean average precision in [0, 1] of each noise, of a task's scores."""
    counted = [score for score in scores if VARIANTS[task](score[1])]
    return {
        noise: float(np.mean([value for other, _, value in counted if other == noise]))
        for noise in NOISE
    }


def table(rows: list[dict]) -> str:
    """Format the means of features, of each task next to the paper's, in percent."""
    names = [task for task in TASKS if task in rows[0]]
    lines = [["feature", *(cell for name in names for cell in (name, "paper"))]]
    for row in rows:
        values = [row[key] for name in names for key in (name, f"{name}_paper")]
        shown = ["-" if value is None else f"{value:.2f}" for value in values]
        lines.append([row["feature"], *shown])
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join(
        "  ".join(cell.ljust(w) if i == 0 else cell.rjust(w) for i, (cell, w) in enumerate(cells))
        for cells in (list(zip(line, widths, strict=True)) for line in lines)
    )
