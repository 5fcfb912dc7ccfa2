"""What `false_accepts.py` prints of its trials.csv, and options of both benchmarks."""

from pathlib import Path

import numpy as np

from hloc_reduce.utils.cli import Parser
from hloc_reduce.utils.files import replacing

LEVELS = (0, 2, 4, 6, 8, 10, 15, 20, 30)
OLD_GATE = 8  # inliers, whatever the number of matches
RESHAPED = ("cropped", "squeezed")  # kinds of photos whose intrinsics are not those of the place


def _same_place(row: dict, same: list[set[str]]) -> bool:
    """Tell whether a photo is of the place of the map, or of one that sees it."""
    return any({row["map"], row["place"]} <= names for names in same)


def table(rows: list[dict], same: list[set[str]]) -> str:
    """Format how many poses are accepted and refused, by feature."""
    lines = [
        "| feature | wrong place | accepted | with 8 inliers | highest confidence "
        "| own, wrong pose | accepted | true pose | refused | lowest confidence |",
        "| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    for feature in dict.fromkeys(row["feature"] for row in rows):
        of_feature = [row for row in rows if row["feature"] == feature]
        away = [r for r in of_feature if is_away(r, same)]
        wrong = [r for r in of_feature if is_plain(r) and r["outcome"] == "wrong"]
        true = [r for r in of_feature if is_true(r)]
        lines.append(
            f"| {feature} | {len(away):,} | {_accepted(away)} | "
            f"{sum(int(r['inliers']) >= OLD_GATE for r in away)} | "
            f"{max(float(r['confidence']) for r in away):.1f} | {len(wrong):,} | "
            f"{_accepted(wrong)} | {len(true):,} | {len(true) - _accepted(true)} | "
            f"{min(float(r['confidence']) for r in true):.1f} |"
        )
    return "\n".join(lines)


def own_table(rows: list[dict]) -> str:
    """Format the outcomes of photos of the place itself."""
    lines = [
        "| feature | photo | intrinsics | number | right | near | wrong | true pose refused |",
        "| --- | --- | --- | ---: | ---: | ---: | ---: | ---: |",
    ]
    seen = dict.fromkeys((row["feature"], row["kind"], row["intrinsics"]) for row in rows)
    for feature, kind, given in seen:
        if kind not in ("own", "blurred", *RESHAPED):
            continue
        part = [
            r for r in rows if (r["feature"], r["kind"], r["intrinsics"]) == (feature, kind, given)
        ]
        found = {
            outcome: _accepted([row for row in part if row["outcome"] == outcome])
            for outcome in ("true", "near", "wrong")
        }
        refused = sum(row["outcome"] == "true" for row in part) - found["true"]
        counts = " | ".join(f"{count:,}" for count in (len(part), *found.values(), refused))
        lines.append(f"| {feature} | {kind} | {given} | {counts} |")
    return "\n".join(lines)


def is_plain(row: dict) -> bool:
    """Tell whether a photo is of the place, not reshaped, and without a wrong focal length."""
    return row["kind"] in ("own", "blurred") and row["intrinsics"] != "off"


def is_true(row: dict) -> bool:
    """Tell whether a plain trial found the true pose."""
    return is_plain(row) and row["outcome"] == "true"


def is_away(row: dict, same: list[set[str]]) -> bool:
    """Tell whether a photo shows nothing of the map, so that every pose is wrong."""
    if row["kind"] == "other":
        return not _same_place(row, same)
    return row["kind"] in ("mirrored", "black", "noise")


def _accepted(rows: list[dict]) -> int:
    return sum(not row["refusal"] for row in rows)


def levels(rows: list[dict], same: list[set[str]]) -> str:
    """Format how many poses each --min_confidence accepts and refuses, for all features."""
    away = np.array([float(r["confidence"]) for r in rows if is_away(r, same)])
    true = np.array([float(r["confidence"]) for r in rows if is_true(r)])
    lines = [
        f"| confidence | false accepts of {len(away):,} | true poses refused of {len(true):,} |",
        "| ---: | ---: | ---: |",
    ]
    for level in LEVELS:
        lines.append(f"| {level} | {(away > level).sum()} | {(true <= level).sum()} |")
    return "\n".join(lines)


def plot(rows: list[dict], same: list[set[str]], path: Path) -> None:
    """Draw true accepts against false ones, by confidence and by the number of inliers."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(6, 4))
    away = [row for row in rows if is_away(row, same)]
    true = [row for row in rows if is_true(row)]
    for key, label in (("confidence", "confidence"), ("inliers", "number of inliers")):
        wrong, right = (np.array([float(row[key]) for row in part]) for part in (away, true))
        at = np.unique(np.concatenate([wrong, right]))
        axes.plot(
            [(wrong >= level).mean() for level in at],
            [(right >= level).mean() for level in at],
            label=f"by {label}",
        )
    axes.set_xscale("symlog", linthresh=1e-4)
    axes.set(xlabel="wrong poses accepted", ylabel="true poses accepted", ylim=(0.9, 1.003))
    axes.legend(loc="lower right")
    axes.grid(alpha=0.3)
    figure.tight_layout()
    with replacing(path) as temporary:
        figure.savefig(temporary, format="svg", metadata={"Date": None})


def add_places(parser: Parser) -> None:
    """Add --map and --same."""
    parser.add_argument(
        "--map", action="append", default=[], metavar="IMAGES:MODEL", help="may be repeated"
    )
    parser.add_argument(
        "--same",
        nargs="+",
        action="append",
        default=[],
        metavar="PLACE",
        help="places that see each other, whose photos are not tried as wrong ones",
    )
