"""Localize the queries of Aachen Day-Night v1.1, or of another place with a COLMAP model.

Extracts features, triangulates a map with the poses of the reference model, retrieves map images
for each query and estimates its pose. An interrupted run resumes.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from hloc_reduce import demo, localize_sfm, pairs_from_covisibility, triangulation
from hloc_reduce.confs import features as features_confs
from hloc_reduce.datasets.layouts import open_model_place
from hloc_reduce.utils import cli, colmap
from hloc_reduce.utils.options import ABOVE_0, Parser, taken
from hloc_reduce.utils.paths import strings_as_paths

from .common import command, compact_map
from .common.dataset import DatasetRun
from .common.options import DatasetOptions, Positive


@dataclass(frozen=True, kw_only=True)
class Options(DatasetOptions):
    """The options of the pipeline.

    Args:
        ground_truth: true poses of the queries; default: those of the data set, such as
            <dataset>/queries/ground_truth_poses.txt.
        num_covis: other images that each map image is matched with.
        compact: pack the map into one file and localize in that; the file and the results are in
            the folder compact of `outputs`; whole and compact maps share the features.
        max_mb: with `compact`: size of the file in 1,000,000 bytes; the folder is
            compact-<size>MB; default: all points.
    """

    num_covis: Positive = 20
    compact: bool = False
    max_mb: Annotated[float, ABOVE_0] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        compact_map.check(self.compact, self.max_mb, self.retrieval, self.matcher)


@strings_as_paths
def main(
    dataset: Path, outputs: Path, feature: str = features_confs.RECOMMENDED, **options: Any
) -> dict:
    """Run all stages and return the summary, as in summary.json.

    Args:
        dataset: data set folder.
        outputs: folder for the results.
        feature: name of a feature, or its YAML file.
        options: further `Options`.
    """
    given, place = Options(feature=feature, **options), open_model_place(dataset)
    lists = {name: [query for query, _ in part] for name, part in place.query_lists().items()}
    with DatasetRun(place, outputs, given) as run:
        features = run.extract_features()
        reference = place.reference(outputs / "reference")
        if run.is_partial:
            part = outputs / "sfm_reference"
            reference = colmap.write_part(reference, set(run.map_names), part)
        sfm_pairs = outputs / f"pairs-db-covis{given.num_covis}.txt"
        with run.stage("pairs_from_covisibility"):
            pairs_from_covisibility.main(reference, sfm_pairs, given.num_covis)
        sfm_matches = run.match("match_map", sfm_pairs, features)
        sfm = outputs / f"sfm_{run.feature}+{run.steps[0]}"
        with run.stage("triangulation"):
            reconstruction = triangulation.main(
                sfm, reference, place.images, sfm_pairs, features, sfm_matches
            )
        limits = {name: place.thresholds(name) for name in lists}
        loc_pairs = run.retrieve()
        if given.compact:
            return compact_map.main(run, place, sfm, given.max_mb, lists, limits)
        loc_matches = run.match("match_queries", loc_pairs, features)
        poses = outputs / f"{place.results}_hloc_{run.label}.txt"
        with run.stage("localization"):
            records = localize_sfm.main(
                sfm,
                place.queries,
                loc_pairs,
                features,
                loc_matches,
                poses,
                full_names=place.full_names,
                executor=given.executor,
                gate=given.gate,
                again=run.again(loc_pairs, features),
                rigs=run.rigs,
                match_rigs=run.match_rigs(loc_pairs, features),
            )
        sizes = {"map_points3D": reconstruction.num_points3D(), "map_bytes": run.map_bytes(sfm)}
        return run.finish_dataset(lists, limits, records, poses, loc_matches, sfm, **sizes)


@dataclass(frozen=True, kw_only=True)
class Command(command.DatasetCommand):
    """The command line of the pipeline.

    Args:
        dataset: data set folder; default: datasets/aachen_v1.1.
        demo: render a small town in the data set's layout and localize there (default `dataset`:
            datasets/demo_town).
        demo_photos: number of map photos that `demo` renders, with a query by day and one by night
            for each eight, but at least ten; default: 32.
    """

    demo: bool = False
    demo_photos: int | None = None


def _main() -> None:
    parser = Parser(__doc__, "--feature colmap_sift_sv64 --demo")
    parser.add(Command)
    parser.add(Options)
    values = command.read(parser)
    called, given = Command(**taken(Command, values)), Options(**taken(Options, values))
    if called.demo_photos is not None and not called.demo:
        parser.error("--demo_photos needs --demo")
    town = "demo_town" if called.demo_photos is None else f"demo_town-{called.demo_photos}"
    dataset = called.dataset or Path("datasets") / (town if called.demo else "aachen_v1.1")
    if called.demo:
        features_confs.get(given.feature, given.projection)  # fails before the rendering
        demo.main(dataset, num_photos=called.demo_photos)
    command.run_on_dataset(main, dataset, called, given)


if __name__ == "__main__":
    cli.run(_main)
