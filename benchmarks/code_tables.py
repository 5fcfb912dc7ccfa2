"""Tables of the documentation that are made from the code: its limits, and what ships."""

import json
from collections.abc import Callable

from safetensors import safe_open

from benchmarks.cells import Table
from hloc_reduce import projections
from hloc_reduce.localization.exif import WELL_KNOWN
from hloc_reduce.localization.gate import DEFAULT_GATE, FOCAL_LENGTHS, REFINED, RULES
from hloc_reduce.mapping.adjustment import GAIN_OF_FREE, MAX_ADJUSTED_IMAGES
from hloc_reduce.mapping.checks import (
    contradictions,
    copies,
    few_points,
    focal_lengths,
    intrinsics,
    lenses,
    misfits,
    partial,
    positions,
)
from hloc_reduce.mapping.plausibility import SAME_VIEWPOINT
from hloc_reduce.mapping.registration import MIN_VIEWPOINTS
from hloc_reduce.networks import MINI
from hloc_reduce.networks import WEIGHTS as NETWORKS
from hloc_reduce.projections.files import WEIGHTS


def limits_table() -> Table:
    """List what a pose must have to be localized."""
    rows = [pair for rule in RULES for pair in ((rule.text, rule.limit), *rule.parts)]
    return [["a pose must", "limit"], *map(list, rows)]


def map_limits_table() -> Table:
    """List what is judged of a map."""
    low, high = FOCAL_LENGTHS
    tolerance = contradictions.ELSEWHERE
    few, share = few_points.HINGE_POINTS, few_points.HINGE_SHARE
    spread = focal_lengths.SPREAD
    return [
        ["what is judged", "limit"],
        [
            "viewpoints of a model",
            f"at least {MIN_VIEWPOINTS}; photos nearer than {100 * SAME_VIEWPOINT:g} % of the "
            "distance to the scene are one",
        ],
        [
            "focal length of a photo",
            f"{low:g} to {high:g} longer sides; within a factor of {REFINED:g} of its EXIF data, "
            f"unless {WELL_KNOWN} photos share the camera",
        ],
        ["distortion of a photo", f"at most {lenses.MAX_DISTORTION:g}"],
        [
            "shared points of a photo",
            f"at least {DEFAULT_GATE.min_inliers}; {few}, where most photos have more than "
            f"{1 / share:g} times as many",
        ],
        [
            "share of the predicted points that two groups share",
            f"{100 * copies.JOINED_SHARE:g} %, or {100 * copies.APART_SHARE:g} % for groups that "
            "the mapper did not connect directly",
        ],
        [
            "ratio of estimated focal lengths of photos of one size",
            f"a warning above {focal_lengths.SPREAD_OF_FEW:g}, refused above {spread:g}",
        ],
        [
            "photo placed elsewhere by the points of others",
            f"{100 * tolerance.position:g} % of the distance or {tolerance.rotation:g}°, while "
            "less than half of its matches agree",
        ],
        [
            "matches of a photo off their epipolar lines",
            f"half of them by more than {misfits.MISFIT_PIXELS:g} pixel, and "
            f"{misfits.MISFIT_RATIO:g} times as far as is typical: refused",
        ],
        [
            "uncertain position of a photo",
            f"a warning above {100 * positions.MAX_DEVIATION:g} % of the distance; refused if "
            f"{100 * positions.MANY_UNCERTAIN_SHARE:g} % of the photos are above",
        ],
        [
            f"fall of the reprojection error with free principal points (up to "
            f"{MAX_ADJUSTED_IMAGES} photos)",
            f"photos are left out, or a warning, above {100 * GAIN_OF_FREE:g} %; "
            f"{100 * intrinsics.GAIN_OF_OWN:g} % if photos share cameras",
        ],
        [
            "photos in the map",
            f"a warning below {100 * partial.ENOUGH_REGISTERED:g} %, refused below half",
        ],
    ]


def projections_table() -> Table:
    """List the projections that ship, by what they project, from their metadata."""
    by_base: dict[str, list[tuple[dict, int]]] = {}
    for name in projections.names():
        metadata = projections.load(name).metadata
        size = (WEIGHTS / f"{name}.safetensors").stat().st_size
        by_base.setdefault(metadata["descriptor"], []).append((metadata, size))
    rows = [["of", "schemes", "KB", "layers", "places", "observations"]]
    for base, files in by_base.items():
        schemes = sorted({f"`{metadata['scheme']}`" for metadata, _ in files})
        layers = max((metadata["layers"] for metadata, _ in files), key=len)
        data = files[0][0]["training_data"]
        assert all(metadata["training_data"].keys() == data.keys() for metadata, _ in files)
        rows.append(
            [
                f"`{base}`",
                ", ".join(schemes),
                f"{sum(size for _, size in files) / 1e3:,.0f}",
                "-".join([*map(str, layers[:-1]), "D"]),
                str(len(data)),
                f"{sum(place['observations'] for place in data.values()):,}",
            ]
        )
    return rows


def networks_table() -> Table:
    """List the networks that ship, from their metadata."""
    rows = [["file", "KB", "what", "photos", "steps"]]
    for name in (*MINI, *(f"lightglue/{mini}" for mini in MINI)):
        path = NETWORKS / f"{name}.safetensors"
        with safe_open(path, "np") as file:
            metadata = file.metadata()
        told = json.loads(metadata.get("metadata") or metadata["training"])
        is_mini = "architecture" in told
        what = f"{told['architecture']}; teacher {told['teacher']}" if is_mini else "LighterGlue"
        photos = told["photos"] if is_mini else sum(told["maps"].values())
        rows.append(
            [
                f"`{name}`",
                f"{path.stat().st_size / 1e3:,.0f}",
                what,
                *(str(number) for number in (photos, told["steps"])),
            ]
        )
    return rows


TABLES: dict[str, Callable[[], Table]] = {
    "limits": limits_table,
    "map_limits": map_limits_table,
    "projections": projections_table,
    "networks": networks_table,
}
