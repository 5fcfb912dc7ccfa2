"""Fit the gate's probability to labelled trials, and say how often the gate errs.

Reads the rows of `benchmarks.trials`. For each kind of matches, a logistic regression on
`gate.Evidence` tells right poses from those of photos that do not belong in the map. Poses of
photos of the place that are near or wrong are left out: their matches are right, but their
intrinsics or their precision are not. Each piece of evidence can only speak for a pose. In five
folds of maps, the gate then judges the poses by weights that were fitted to other maps; whether a
mirror image counts is decided by the weights of `gate.py`. Prints what is accepted, also without
each other rule, how often right poses are among those of a probability, and the weights.
"""

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from scipy.optimize import minimize
from scipy.special import expit

from benchmarks.trial_rows import OUTCOMES, TRIALS, label, read
from hloc_reduce.localization import gate
from hloc_reduce.localization.gate import (
    MATCH_KINDS,
    RULES,
    Evidence,
    Gate,
    Rule,
    evidence,
)
from hloc_reduce.utils import cli
from hloc_reduce.utils.tables import aligned

FOLDS = 5
PENALTY = 1e-4  # of squared weights of standardized evidence
PROBABILITIES = 0.1, 0.3, 0.5, 0.7, 0.8, 0.9, 0.99
OTHER_RULES = [rule for rule in RULES if rule.refusal is not gate._improbable]


def fit(given: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Fit weights, each at least 0, and a bias.

    Args:
        given: (N, F) evidence, the larger the better.
        right: (N,) bool.

    Returns:
        (F + 1,), the bias last; right and wrong poses are taken to be equally frequent.
    """
    spread = given.std(axis=0) + 1e-9
    columns = np.column_stack([given / spread, np.ones(len(given))])
    sign = np.where(right, 1, -1)
    weight = np.where(right, 0.5 / right.sum(), 0.5 / (~right).sum())

    def loss(weights: np.ndarray) -> tuple[float, np.ndarray]:
        margin, penalized = sign * (columns @ weights), np.append(weights[:-1], 0)
        value = weight @ np.logaddexp(0, -margin) + PENALTY * (penalized**2).sum()
        return value, columns.T @ (-weight * sign * expit(-margin)) + 2 * PENALTY * penalized

    bounds = [(0, None)] * given.shape[1] + [(None, None)]
    found = minimize(loss, np.zeros(columns.shape[1]), jac=True, bounds=bounds, method="L-BFGS-B")
    return found.x / np.append(spread, 1)


def fit_rows(rows: Iterable[dict]) -> np.ndarray:
    """Fit weights and a bias (3,) to trials of one kind of matches."""
    known = [row for row in rows if label(row) is not None]
    given = np.array([evidence(row["measures"]) for row in known])
    return fit(given, np.array([label(row) for row in known]))


def out_of_fold(rows: Sequence[dict]) -> np.ndarray:
    """Return the probability (N,) of each pose by weights that were fitted to other places."""
    places = sorted({row["map"] for row in rows})
    fold = np.array([places.index(row["map"]) % FOLDS for row in rows])
    given, found = np.array([evidence(row["measures"]) for row in rows]), np.zeros(len(rows))
    for i in range(FOLDS):
        *weights, bias = fit_rows(row for row, one in zip(rows, fold, strict=True) if one != i)
        found[fold == i] = expit(given[fold == i] @ weights + bias)
    return found


def passes(rows: Sequence[dict], rules: Iterable[Rule]) -> np.ndarray:
    """Return which poses (N,) no rule refuses."""
    given = [(row["measures"], Gate(match_kind=row["matcher"])) for row in rows]
    return np.array([not any(rule.refusal(*one) for rule in rules) for one in given])


def counts(rows: Sequence[dict], accepted: np.ndarray) -> list[str]:
    """Return how many poses of each outcome are accepted."""
    outcome = np.array([row["outcome"] for row in rows])
    return [
        f"{int((accepted & (outcome == one)).sum())} of {int((outcome == one).sum())}"
        for one in OUTCOMES
    ]


def report(rows: Sequence[dict]) -> str:
    """Return what is accepted of the trials of one kind of matches, and how it is calibrated."""
    probability, passed = out_of_fold(rows), passes(rows, OTHER_RULES)
    table = [["accepted", *OUTCOMES]]
    for least in PROBABILITIES:
        table.append([f"probability {least:g}", *counts(rows, passed & (probability >= least))])
    probable = probability >= Gate(match_kind=rows[0]["matcher"]).least_probability
    table.append(["without a probability", *counts(rows, passed)])
    for rule in OTHER_RULES:
        others = passes(rows, [other for other in OTHER_RULES if other is not rule])
        table.append([f"without {rule.refusal.__name__[1:]}", *counts(rows, probable & others)])
    right, wrong = (probability[[label(row) == one for row in rows]] for one in (True, False))
    calibrated = [["probability", "poses", "share of right ones, if half of all are"]]
    for low, high in zip((0, *PROBABILITIES), (*PROBABILITIES, 1.01), strict=True):
        number = [np.sum((found >= low) & (found < high)) for found in (right, wrong)]
        shares = number[0] / len(right), number[1] / len(wrong)
        share = f"{shares[0] / sum(shares):.2f}" if sum(number) else ""
        calibrated.append([f"{low:g} to {min(high, 1):g}", f"{sum(number)}", share])
    return f"{aligned(table)}\n\n{aligned(calibrated)}"


def _main() -> None:
    parser = cli.Parser(__doc__, "results/trials/colmap_sift_sv64-0.csv")
    parser.add_argument("trials", type=Path, nargs="*", help="default: all of results/trials")
    args = parser.parse_args()
    rows = [row for row in read(args.trials or sorted(TRIALS.glob("*.csv"))) if "measures" in row]
    for kind in MATCH_KINDS:
        poses = [row for row in rows if row["matcher"] == kind]
        if not poses:
            continue
        print(f"{kind}: {len(poses):,} poses\n{report(poses)}")
        named = zip((*Evidence._fields, "bias"), fit_rows(poses).round(2).tolist(), strict=True)
        print("weights:", dict(named), end="\n\n")


if __name__ == "__main__":
    cli.run(_main)
