"""Make a finished outputs folder of hloc small, and compare before and after.

Reduces the feature file and packs the map into one small file. With --queries, localizes them with
hloc's features, with the reduced ones, and in the small map. hloc's folder is not changed.
"""

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import pycolmap

from hloc_reduce import aggregate_features, compact, localize_sfm, maps, match_features, reduce
from hloc_reduce.confs import features as features_confs
from hloc_reduce.confs import matchers as matchers_confs
from hloc_reduce.datasets import DAY_THRESHOLDS, true_poses
from hloc_reduce.evaluation.poses import FAILED, pose_error, recall
from hloc_reduce.evaluation.summaries import map_bytes
from hloc_reduce.hlm.reader import SUFFIX
from hloc_reduce.localization.records import pose_of
from hloc_reduce.localization.stage import read_queries
from hloc_reduce.networks import lightglue
from hloc_reduce.runtime import provenance
from hloc_reduce.runtime.outputs import CONF, RunFolder
from hloc_reduce.utils import cli, colmap
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.codes import Storage
from hloc_reduce.utils.feature_files import get_keypoints
from hloc_reduce.utils.files import MEGABYTE, write_csv
from hloc_reduce.utils.h5 import iterate_h5_names, list_h5_names, open_h5
from hloc_reduce.utils.options import Option, Parser
from hloc_reduce.utils.paths import strings_as_paths
from hloc_reduce.utils.tables import aligned

from .common import retrieval

FEATURE, STORAGE, NUM_LOC = "colmap_sift_sv32", "uint4", 50
TABLE = "shrink.csv"
MODELS = "*/points3D.???"  # files of COLMAP models in a folder
HLOC, REDUCED, COMPACT = "hloc's features and model", "reduced features", "compact map"
COLUMNS = "map", "MB", "localized", "inliers", "recall [%]", "median error [cm]", "s a query"


@strings_as_paths
def main(
    hloc_outputs: Path,
    outputs: Path,
    feature: str = FEATURE,
    storage: Storage = STORAGE,
    features: Path | None = None,
    sfm: Path | None = None,
    queries: Path | None = None,
    ground_truth: Path | None = None,
    num_loc: int = NUM_LOC,
    max_mb: float | None = None,
    matcher: Annotated[str, Option("matcher", matchers_confs.confs)] | None = None,
    overwrite: bool = False,
) -> list[dict]:
    """Reduce the features and the map of an outputs folder of hloc, and compare.

    Args:
        hloc_outputs: hloc's outputs folder, which is not changed.
        outputs: folder for the reduced feature file, the compact map, and the table, shrink.csv.
        feature: what to reduce hloc's descriptors to: name of a feature, or its YAML file.
        storage: how descriptors are stored.
        features: hloc's feature file, with the queries; default: the only one in the folder.
        sfm: COLMAP model of its keypoints; default: the only one in the folder.
        queries: query list with intrinsics, or a glob of several.
        ground_truth: true poses of the queries.
        num_loc: retrieved map images per query, by VLAD.
        max_mb: size of the compact map in 1,000,000 bytes; default: with all points.
        matcher: matcher of the queries; default: the feature's.
        overwrite: replace earlier results.

    Returns:
        A row of the table for hloc's files, for the reduced features with hloc's model, and for the
        compact map. Without `queries` it has sizes only.

    Raises:
        InputError: when a file is missing or ambiguous, or is not of the feature.
    """
    _check(hloc_outputs, outputs, max_mb)
    if ground_truth is not None and queries is None:
        raise InputError("--ground_truth is of queries: give --queries, too.")
    if features is None:
        features = _only(_feature_files(hloc_outputs), hloc_outputs, "features", "feature file")
    if sfm is None:
        model = f"model of the keypoints in {features.name}"
        sfm = _only(_models(hloc_outputs, features), hloc_outputs, "sfm", model)
    sfm = colmap.find_model(sfm)
    map_names = sorted(image.name for image in colmap.read_model(sfm).images.values())
    listed = [] if queries is None else read_queries(queries)
    truth = true_poses([name for name, _ in listed], ground_truth, True) if ground_truth else {}
    model = features_confs.get(feature)[1]["model"]
    given, matcher = matcher, matcher or features_confs.matcher_of({"model": model})
    of_hloc = matcher  # hloc's files do not say what their features are
    if matcher == "lightglue":
        base = matchers_confs.features_of(features_confs.base_of(model))
        of_hloc = f"{base}+lightglue"
        if of_hloc not in matchers_confs.confs:
            raise lightglue.unknown(feature)
    paths = {"hloc_outputs": hloc_outputs, "features": features, "sfm": sfm, "queries": queries}
    conf: dict[str, object] = {name: path and str(path.resolve()) for name, path in paths.items()}
    conf |= {"feature": feature, "storage": storage, "num_loc": num_loc, "max_mb": max_mb}
    conf |= {"matcher": given} if given else {}
    made_from = [features, *sorted(sfm.glob("*.*"))]
    conf["made_from"] = provenance.of_inputs({}, made_from)["inputs"]
    absent = {name for name, _ in listed}.difference(list_h5_names(features))
    if absent:
        raise InputError(f"{features} lacks {len(absent)} queries: {cli.some(sorted(absent))}.")
    before = provenance.read(outputs / CONF)
    if before.keys() == conf.keys() and before != conf and not (outputs / TABLE).exists():
        overwrite = True  # an unfinished run with other options
    with RunFolder(outputs, conf, overwrite, [hloc_outputs, features, sfm]) as folder:
        small, packed = outputs / "features.h5", outputs / f"map{SUFFIX}"
        with folder.stage("reduce"):
            reduce.main(features, small, feature, storage=storage)
        with folder.stage("compact"):
            described = aggregate_features.main(aggregate_features.confs["vlad"], small, map_names)
            compact.main(
                packed,
                sfm=sfm,
                features=small,
                global_descriptors=described,
                feature=feature,
                matcher=given,
                storage=storage,
                max_mb=max_mb,
            )
        built = maps.unpack(packed, outputs / "map", overwrite)
        sizes = {
            HLOC: map_bytes(sfm, map_names, [features]),
            REDUCED: map_bytes(sfm, map_names, [small]),
            COMPACT: packed.stat().st_size,
        }
        rows = [{COLUMNS[0]: name, COLUMNS[1]: size / MEGABYTE} for name, size in sizes.items()]
        if listed:
            pairs = outputs / "pairs-query.txt"
            names = [name for name, _ in listed]
            retrieval.retrieve_in_map(built, small, pairs, num_loc, names, map_names)
            tried = {
                "localize-hloc": (sfm, features, features, of_hloc),
                "localize-reduced": (sfm, small, small, matcher),
                "localize-compact": (built.sfm, small, built.features, built.matcher),
            }
            for (name, files), row in zip(tried.items(), rows, strict=True):
                with folder.stage(name):
                    row |= _localize(outputs / name, listed, pairs, *files, truth)
        write_csv(rows, outputs / TABLE)
    return rows


def _check(hloc_outputs: Path, outputs: Path, max_mb: float | None) -> None:
    """Raise an InputError for arguments that cannot be right."""
    if not hloc_outputs.is_dir():
        raise cli.no_folder(hloc_outputs)
    if max_mb is not None and not max_mb > 0:
        raise InputError(f"--max_mb {max_mb:g}: it must be above 0.")
    if outputs.resolve() == hloc_outputs.resolve():
        raise InputError(f"--outputs {outputs} is hloc's folder: choose another one.")


def _only(found: Sequence[Path], folder: Path, option: str, what: str) -> Path:
    """Return the only file of its kind, or raise an InputError.

    Args:
        found: the files.
        folder: hloc's.
        option: names another file.
        what: kind of the file.
    """
    if len(found) == 1:
        return found[0]
    if found:
        which = cli.some(path.name for path in found)
        raise InputError(f"{folder} has several: {which}. Give --{option}.")
    names = cli.some(sorted(path.name for path in folder.iterdir()))
    near = next((path for path in (*folder.iterdir(), folder.parent) if _may_be_finished(path)), "")
    raise InputError(
        f"{folder} is not a finished outputs folder of hloc, which has a feature file and a COLMAP "
        f"model of its keypoints: it has no {what}, "
        f"{f'only {names}' if names else 'as it is empty'}. "
        + (f"Did you mean {near}?" if near else f"Give the right one, or --{option}.")
    )


def _may_be_finished(folder: Path) -> bool:
    """Tell whether a folder has files like those of hloc's outputs."""
    return all(any(folder.glob(found)) for found in ("*.h5", MODELS))


def _feature_files(folder: Path) -> list[Path]:
    """Return the feature files in a folder, by the keypoints and descriptors in them."""
    found = []
    for path in sorted(folder.glob("*.h5")):
        with open_h5(path) as file:
            first = next(iterate_h5_names(file.id), None)
            if first is not None and {"keypoints", "descriptors"} <= file[first].keys():
                found.append(path)
    return found


def _models(folder: Path, features: Path) -> list[Path]:
    """Return the COLMAP models in a folder that have the keypoints of a feature file."""
    found = []
    with open_h5(features) as file:
        for path in sorted({path.parent for path in folder.glob(MODELS)}):
            images = colmap.read_model(path).images.values()
            image = next(iter(images), None)
            if image is not None and image.name in file:
                keypoints, _ = get_keypoints(file, image.name)
                if len(keypoints) == image.num_points2D():
                    found.append(path)
    return found


def _localize(
    results: Path,
    queries: list[tuple[str, pycolmap.Camera]],
    pairs: Path,
    sfm: Path,
    features: Path,
    map_features: Path,
    matcher: str,
    truth: Mapping[str, pycolmap.Rigid3d],
) -> dict:
    """Localize queries and return the columns of a row.

    Args:
        results: begins the names of the files of results.
        queries: names and intrinsics.
        pairs: queries and map images.
        sfm: the COLMAP model of the map.
        features: feature file of the queries.
        map_features: feature file of the map.
        matcher: a key of `confs.matchers`.
        truth: true poses.
    """
    start, conf = time.perf_counter(), matchers_confs.confs[matcher]
    matches, poses = (results.with_name(f"{results.name}-{n}") for n in ("matches.h5", "poses.txt"))
    match_features.main(
        conf, pairs, features, matches=matches, features_ref=map_features, overwrite=True
    )
    records = localize_sfm.main(
        sfm, queries, pairs, features, matches, poses, full_names=True, overwrite=True
    )
    seconds = time.perf_counter() - start
    localized = [record for record in records.values() if record["localized"]]
    errors = [
        pose_error(pose_of(records[name]), truth[name]) if records[name]["localized"] else FAILED
        for name, _ in queries
        if name in truth
    ]
    inliers = sum(record["num_inliers"] for record in localized)
    row = {
        "localized": f"{len(localized)} of {len(queries)}",
        "inliers": round(inliers / len(queries), 1),
        "recall [%]": "",
        "median error [cm]": "",
        "s a query": round(seconds / len(queries), 3),
    }
    if errors:
        row["recall [%]"] = " / ".join(f"{one:.1f}" for one in recall(errors, DAY_THRESHOLDS))
        row["median error [cm]"] = round(100 * float(np.median([error for error, _ in errors])), 2)
    return row


def _main() -> None:
    parser = Parser(__doc__, "--hloc_outputs outputs/aachen --outputs outputs/aachen_small")
    parser.add(main)
    given = parser.read()
    rows = main(**given)
    columns = [column for column in COLUMNS if column in rows[0]]
    lines = [[f"{row[c]:.3f}" if c == "MB" else str(row[c]) for c in columns] for row in rows]
    print(aligned([columns, *lines]))
    print(f"{given['outputs']} has features.h5, map{SUFFIX} and {TABLE}.")


if __name__ == "__main__":
    cli.run(_main)
