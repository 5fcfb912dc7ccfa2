"""Say how often the gate errs on labelled trials, and fit a probability that would err less.

Reads the rows of `benchmarks.trials`. For each kind of matcher a logistic regression on
`EVIDENCE` is fitted to right poses and wrong ones; each piece of it can only speak for a pose, and
poses near the true one count as neither. Poses are judged by weights that were fitted to other
places, in five folds of places; by the rules on intrinsics and precision they are judged as they
are. Prints what the gate accepts, what a probability would accept instead, and the weights.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.optimize import minimize
from scipy.special import expit

from benchmarks.trial_rows import TRIALS, read
from hloc_reduce.localization import gate
from hloc_reduce.localization.gate import BY_MATCHES, DEFAULT_GATE, RULES
from hloc_reduce.localization.measures import Measures
from hloc_reduce.utils import cli
from hloc_reduce.utils.tables import aligned

EVIDENCE = "confidence", "agreement", "rivals", "mirror_image"
REPLACED = gate._no_agreement, gate._ambiguous, gate._mirrored  # rules, by the probability
SURE = 300.0  # confidence: more does not count
FOLDS = 5
PENALTY = 1e-4  # of squared weights of standardized evidence
OUTCOMES = "true", "near", "wrong"
PROBABILITIES = 0.5, 0.7, 0.8, 0.9, 0.95, 0.99


def evidence_of(measures: Measures) -> np.ndarray:
    """Return what speaks for a pose, by the names in EVIDENCE: the larger, the better."""
    others = measures.alternatives
    rivals = [min(others[kind].ratio, 1.0) for kind in BY_MATCHES if kind in others]
    confidence = max(1.0, measures.confidence)
    mirrored = min((measures.mirror_image or 0.0) / confidence, 1.0)
    logarithm = np.log10(min(confidence, SURE))
    return np.array([logarithm, measures.agreement, -max(rivals, default=0.0), -mirrored])


def fit(evidence: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Fit weights, each at least 0, and a bias.

    Args:
        evidence: (N, F), the larger the better.
        right: (N,) bool.

    Returns:
        (F + 1,), the bias last; right and wrong poses are taken to be equally frequent.
    """
    spread = evidence.std(axis=0) + 1e-9
    given = np.column_stack([evidence / spread, np.ones(len(evidence))])
    sign = np.where(right, 1, -1)
    weight = np.where(right, 0.5 / right.sum(), 0.5 / (~right).sum())

    def loss(weights: np.ndarray) -> tuple[float, np.ndarray]:
        margin, penalized = sign * (given @ weights), np.append(weights[:-1], 0)
        value = weight @ np.logaddexp(0, -margin) + PENALTY * (penalized**2).sum()
        return value, given.T @ (-weight * sign * expit(-margin)) + 2 * PENALTY * penalized

    bounds = [(0, None)] * evidence.shape[1] + [(None, None)]
    found = minimize(loss, np.zeros(given.shape[1]), jac=True, bounds=bounds, method="L-BFGS-B")
    return found.x / np.append(spread, 1)


def out_of_fold(rows: Sequence[dict]) -> np.ndarray:
    """Return the probability (N,) of each pose by weights that were fitted to other places."""
    evidence = np.array([evidence_of(row["measures"]) for row in rows])
    outcome = np.array([row["outcome"] for row in rows])
    places = sorted({row["map"] for row in rows})
    fold = np.array([places.index(row["map"]) % FOLDS for row in rows])
    probability = np.zeros(len(rows))
    for i in range(FOLDS):
        chosen = (outcome != "near") & (fold != i)
        weights = fit(evidence[chosen], outcome[chosen] == "true")
        probability[fold == i] = expit(evidence[fold == i] @ weights[:-1] + weights[-1])
    return probability


def _counts(rows: Sequence[dict], accepted: np.ndarray) -> list[str]:
    """Return how many poses of each outcome are accepted."""
    outcome = np.array([row["outcome"] for row in rows])
    return [
        f"{int((accepted & (outcome == one)).sum())} of {int((outcome == one).sum())}"
        for one in OUTCOMES
    ]


def _main() -> None:
    parser = cli.Parser(__doc__, "results/trials/colmap_sift_sv64-0.csv")
    parser.add_argument("trials", type=Path, nargs="*", help="default: all of results/trials")
    args = parser.parse_args()
    rows = [row for row in read(args.trials or sorted(TRIALS.glob("*.csv"))) if "measures" in row]
    for kind in sorted({row["matcher"] for row in rows}):
        poses = [row for row in rows if row["matcher"] == kind]
        today = np.array([row["accepted"] for row in poses])
        rules = [rule for rule in RULES if rule not in REPLACED]
        passed = [not any(rule(row["measures"], DEFAULT_GATE) for rule in rules) for row in poses]
        probability = np.where(passed, out_of_fold(poses), 0)
        table = [["accepted", *OUTCOMES], ["by the gate", *_counts(poses, today)]]
        table += [
            [f"probability {level:g}", *_counts(poses, probability >= level)]
            for level in PROBABILITIES
        ]
        print(f"{kind}: {len(poses):,} poses\n{aligned(table)}")
        known = [row for row in poses if row["outcome"] != "near"]
        evidence = np.array([evidence_of(row["measures"]) for row in known])
        weights = fit(evidence, np.array([row["outcome"] == "true" for row in known]))
        print(dict(zip((*EVIDENCE, "bias"), weights.round(2).tolist(), strict=True)), end="\n\n")


if __name__ == "__main__":
    cli.run(_main)
