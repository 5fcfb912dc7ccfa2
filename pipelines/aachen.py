"""Localize the queries of Aachen Day-Night v1.1, or of any place in its layout.

Extracts features, triangulates a map with the poses of the reference model, retrieves map images
for each query and estimates its pose. An interrupted run resumes.
"""

from pathlib import Path
from typing import Unpack

from hloc_reduce import demo, localize_sfm, pairs_from_covisibility, triangulation
from hloc_reduce.confs import features as features_confs
from hloc_reduce.datasets import thresholds
from hloc_reduce.datasets.aachen import Aachen
from hloc_reduce.utils import cli, colmap
from hloc_reduce.utils.paths import strings_as_paths

from .common import compact_map, options
from .common.dataset import DatasetRun, Settings

NUMBERS = {"num_covis": 20, "num_loc": 50}
Place = Aachen


@strings_as_paths
def main(
    dataset: Path,
    outputs: Path,
    feature: str = features_confs.RECOMMENDED,
    num_covis: int = NUMBERS["num_covis"],
    num_loc: int = NUMBERS["num_loc"],
    compact: bool = False,
    max_mb: float | None = None,
    **settings: Unpack[Settings],
) -> dict:
    """Run all stages and return the summary, as in summary.json.

    Args:
        dataset: data set folder.
        outputs: folder for the results.
        feature: name of a feature, or its YAML file.
        num_covis: other images that each map image is matched with.
        num_loc: retrieved map images per query.
        compact: localize in a compact map, one file, instead of the whole map. The file and the
            results are in a folder of `outputs`, see `compact_map.folder`; whole and compact maps
            share the features.
        max_mb: the size of this file in 1,000,000 bytes; default: all points.
        settings: further arguments of `DatasetRun`.
    """
    compact_map.check(compact, max_mb, settings.get("retrieval", "vlad"))
    place = Aachen(dataset)
    lists = {name: [query for query, _ in part] for name, part in place.query_lists().items()}
    with DatasetRun(place, outputs, feature, num_loc, {"num_covis": num_covis}, **settings) as run:
        features = run.extract_features()
        reference = place.reference_model
        if run.is_partial:
            part = outputs / "sfm_reference"
            reference = colmap.write_part(reference, set(run.map_names), part)
        sfm_pairs = outputs / f"pairs-db-covis{num_covis}.txt"
        with run.stage("pairs_from_covisibility"):
            pairs_from_covisibility.main(reference, sfm_pairs, num_covis)
        sfm_matches = run.match("match_map", sfm_pairs, features)
        sfm = outputs / f"sfm_{run.feature}+{run.matcher}"
        with run.stage("triangulation"):
            reconstruction = triangulation.main(
                sfm, reference, place.images, sfm_pairs, features, sfm_matches
            )
        limits = {name: thresholds(name) for name in lists}
        loc_pairs = run.retrieve()
        if compact:
            return compact_map.main(run, place, sfm, max_mb, lists, limits)
        loc_matches = run.match("match_queries", loc_pairs, features)
        poses = outputs / f"Aachen-v1.1_hloc_{run.label}.txt"
        with run.stage("localization"):
            records = localize_sfm.main(
                *(sfm, place.queries, loc_pairs, features, loc_matches, poses),
                executor=run.executor,
                gate=run.gate,
                mirror_images=run.mirror_images_of_dataset(),
            )
        sizes = {"map_points3D": reconstruction.num_points3D(), "map_bytes": run.map_bytes(sfm)}
        return run.finish_dataset(lists, limits, records, poses, loc_matches, sfm, **sizes)


def _main() -> None:
    parser = cli.Parser(__doc__, "--feature colmap_sift_sv64 --demo")
    truth = "<dataset>/queries/ground_truth_poses.txt"
    options.add_dataset_options(parser, "datasets/aachen_v1.1", truth, NUMBERS["num_loc"])
    parser.add_argument(
        "--demo",
        action="store_true",
        help="render a small town in the data set's layout and localize there "
        "(default --dataset: datasets/demo_town)",
    )
    parser.add_argument(
        "--demo_photos",
        type=int,
        help="number of map photos that --demo renders, with a query by day and one by night for "
        "each eight, but at least ten (default: 32)",
    )
    parser.add_argument(
        "--num_covis",
        type=int,
        default=NUMBERS["num_covis"],
        help="other images that each map image is matched with",
    )
    parser.add_argument(
        "--compact",
        action="store_true",
        help="pack the map into one file and localize in that; the file and the results are in the "
        "folder compact of --outputs",
    )
    parser.add_argument(
        "--max_mb",
        type=float,
        help="with --compact: size of the file in 1,000,000 bytes; the folder is compact-<size>MB",
    )
    given = options.parse(parser)
    is_demo, num_photos = given.pop("demo"), given.pop("demo_photos")
    if num_photos is not None and not is_demo:
        parser.error("--demo_photos needs --demo")
    town = "datasets/demo_town" if num_photos is None else f"datasets/demo_town-{num_photos}"
    default = town if is_demo else "datasets/aachen_v1.1"
    dataset = given.pop("dataset") or Path(default)
    if is_demo:
        features_confs.get(given["feature"], given["projection"])  # fails before the rendering
        demo.main(dataset, num_photos=num_photos)
    options.run_on_dataset(main, dataset, given)


if __name__ == "__main__":
    cli.run(_main)
