"""HPatches: matching, verification and retrieval of patches (Balntas et al., CVPR 2017)."""

import hashlib
import json
from collections.abc import Iterable, Iterator
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
from ...utils.tables import aligned
from .. import published
from . import data, tasks
from .data import NOISE_LEVELS, Descriptors
from .lists import TaskLists

TASKS = ("matching", "verification", "retrieval")
NOT_IN_MEAN = " balanced"  # the paper's mean of verification is of the imbalanced protocol
PAPER_SPLIT = "a"


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
        outputs: folder for the descriptors, the drawn lists and the scores.
        split: one of `data.SPLITS`.
        task_lists: the folder `tasks` of the benchmark; default: `root`/tasks.
        chosen: tasks.

    Returns:
        A dict for each feature: `feature` and, for each task, the mean average precision [%]:
        `<task>`; `<task>_easy`, `_hard` and `_tough`; and `<task>_paper`, or None. This is also
        written to `<outputs>/<split>.csv`, and the scores to `<outputs>/<split>_scores.csv`.

    Raises:
        InputError: when the data or a feature is missing or broken.
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
        descriptors = outputs / f"descriptors_{base}.h5"
        data.describe(root, sequences, base, descriptors)
        with open_h5(descriptors) as file:
            made_from = {
                "descriptors": file_provenance(file),
                "projection": checksum,
                "sequences": sequences,
                "lists": provenance.of_inputs({}, sorted(task_lists.glob(f"*_split-{split}.csv"))),
            }
        path = outputs / split / f"{name}.json"
        found = _read_scores(path, made_from)
        if missing := [task for task in chosen if task not in found]:
            project = torch.nn.Identity() if projection is None else projections.load(projection)
            projected = Descriptors(descriptors, sequences, project)
            for task in missing:
                found[task] = list(_evaluate(task, projected, root, task_lists, outputs, split))
                provenance.write(path, {"made_from": made_from, "scores": found})
        scores[name] = {task: found[task] for task in chosen}
    paper = published.hpatches() if split == PAPER_SPLIT else {}
    rows = [
        {"feature": name, **_means(found, paper.get(name, {}))} for name, found in scores.items()
    ]
    write_csv(_score_rows(scores), outputs / f"{split}_scores.csv")
    write_csv(rows, outputs / f"{split}.csv")
    return rows


def _read_scores(path: Path, made_from: dict) -> dict[str, list]:
    """Read the scores that an earlier run left, none if they are stale."""
    before = provenance.read(path)
    current = before.get("made_from") == json.loads(json.dumps(made_from))
    return before["scores"] if current else {}


def _evaluate(
    task: str, descriptors: Descriptors, root: Path, task_lists: Path, outputs: Path, split: str
) -> Iterator[tuple[str, str, float]]:
    """Evaluate a task: yield noise, variant and score."""
    if task == "matching":
        return tasks.matching(descriptors)
    sizes = json.dumps(list(descriptors.sizes.items()))  # which lists depend on
    drawn = outputs / "tasks" / hashlib.sha256(sizes.encode()).hexdigest()[:8]
    listed = TaskLists(task_lists, drawn, split, descriptors.sizes)
    if task == "verification":
        return tasks.verification(descriptors, listed.pairs())

    def contrast(sequence: str) -> np.ndarray:
        return data.read_patches(root / sequence / "ref.png").std(axis=(1, 2))

    return tasks.retrieval(descriptors, *listed.pools(contrast))


def _score_rows(scores: dict[str, dict[str, list]]) -> list[dict]:
    keys = ("feature", "task", "noise", "variant", "score")
    return [
        dict(zip(keys, (feature, task, NOISE_LEVELS[noise], variant, score), strict=True))
        for feature, by_task in scores.items()
        for task, rows in by_task.items()
        for noise, variant, score in rows
    ]


def _means(scores: dict[str, list], paper: dict[str, float]) -> dict[str, float | None]:
    """Return the means [%] of a feature's scores in each task, next to the paper's."""
    means: dict[str, float | None] = {}
    for task, found in scores.items():
        by_noise = {
            noise: float(
                np.mean([s for n, v, s in found if n == noise and not v.endswith(NOT_IN_MEAN)])
            )
            for noise in NOISE_LEVELS
        }
        means[task] = 100 * float(np.mean(list(by_noise.values())))
        means |= {f"{task}_{NOISE_LEVELS[noise]}": 100 * mean for noise, mean in by_noise.items()}
        means[f"{task}_paper"] = paper.get(task)
    return means


def table(rows: list[dict]) -> str:
    """Format the means [%] of features in each task, next to the paper's."""
    names = [task for task in TASKS if task in rows[0]]
    keys = [key for name in names for key in (name, f"{name}_paper")]
    lines = [["feature", *(cell for name in names for cell in (name, "paper"))]]
    for row in rows:
        means = ("-" if row[key] is None else f"{row[key]:.2f}" for key in keys)
        lines.append([row["feature"], *means])
    return aligned(lines)
