"""A run of a pipeline: its inputs, its outputs folder, and the stages that pipelines share."""

import os
from collections.abc import Iterable, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Self, TypedDict

import pycolmap

from hloc_reduce import (
    aggregate_features,
    extract_features,
    logger,
    match_features,
    pairs_from_retrieval,
)
from hloc_reduce.confs import features as features_confs
from hloc_reduce.confs import matchers as matchers_confs
from hloc_reduce.confs import retrieval as retrieval_confs
from hloc_reduce.datasets import true_poses
from hloc_reduce.datasets.aachen import Aachen
from hloc_reduce.datasets.inloc import InLoc
from hloc_reduce.detectors.dog import KEYPOINTS
from hloc_reduce.evaluation.summaries import (
    bytes_per_keypoint,
    query_table,
    summarize_list,
    write_summary,
)
from hloc_reduce.localization.confidence import DEFAULT_GATE, Gate
from hloc_reduce.localization.mirrored import MirrorImages
from hloc_reduce.runtime import provenance
from hloc_reduce.runtime.executors import SERIAL, Executor
from hloc_reduce.runtime.group_writer import failures
from hloc_reduce.runtime.outputs import RunFolder
from hloc_reduce.runtime.versions import versions
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.codes import STORAGES
from hloc_reduce.utils.files import write_csv
from hloc_reduce.utils.h5 import get_text, list_h5_names, open_h5
from hloc_reduce.utils.images import list_images
from hloc_reduce.utils.parsers import parse_pairs, parse_retrieval, write_pairs
from hloc_reduce.utils.paths import strings_as_paths

Thresholds = Mapping[str, tuple[tuple[float, float], ...]]  # of each query list, metres and degrees
SHARED_POINTS = "points3D.h5"  # beside given features of InLoc: the 3D points of their keypoints
GLOBAL_SUFFIXES = (".h5", ".hdf5")  # of global descriptors; other retrieval files are text


class Run:
    """A run in an outputs folder; as a context manager it releases the folder at its end.

    Args:
        folder: the outputs folder.
        feature: name of the feature.
        matcher: name of the matcher.
        executor: where the work is done.
    """

    def __init__(self, folder: RunFolder, feature: str, matcher: str, executor: Executor = SERIAL):
        self.folder, self.feature, self.matcher = folder, feature, matcher
        self.executor = executor

    def __enter__(self) -> Self:
        self.folder.__enter__()
        return self

    def __exit__(self, *error: object) -> None:
        self.folder.__exit__(*error)

    def stage(self, name: str) -> AbstractContextManager[None]:
        """Time a stage."""
        return self.folder.stage(name)

    def match(
        self, stage: str, pairs: Path, features: Path, features_ref: Path | None = None
    ) -> Path:
        """Match pairs as a stage, into a file named as hloc's.

        Args:
            stage: its name.
            pairs: text file of pairs; without any, no match file is written.
            features: feature file.
            features_ref: feature file of the second images; default: `features`.
        """
        with self.stage(stage):
            return self._match(pairs, features, features_ref)

    def _match(self, pairs: Path, features: Path, features_ref: Path | None) -> Path:
        conf = matchers_confs.confs[self.matcher]
        matches = self.folder.path / f"{features.stem}_{conf['output']}_{pairs.stem}.h5"
        if next(parse_pairs(pairs), None) is not None:  # else no query could be read
            match_features.main(
                *(conf, pairs, features),
                matches=matches,
                features_ref=features_ref,
                executor=self.executor,
            )
        return matches

    def mirror_images(
        self, conf: dict, image_dir: Path, pairs: Path, features: Path, map_features: Path
    ) -> MirrorImages:
        """Return what extracts and matches mirror images of queries, for a localization stage.

        Args:
            conf: configuration of the feature.
            image_dir: folder of the queries.
            pairs: pairs of all queries and map images.
            features: feature file of all queries.
            map_features: feature file of the map images.
        """

        def main(names: list[str]) -> tuple[Path, Path]:
            listed = self.folder.path / f"{pairs.stem}-mirrored.txt"
            retrieved = parse_retrieval(pairs)
            write_pairs([(name, other) for name in names for other in retrieved[name]], listed)
            mirrored = extract_features.main(
                {**conf, "preprocessing": {**conf["preprocessing"], "mirrored": True}},
                image_dir,
                feature_path=self.folder.path / f"{features.stem}-mirrored.h5",
                image_list=names,
                executor=self.executor,
                strict=False,
                queries=names,
            )
            return mirrored, self._match(listed, mirrored, map_features)

        return main

    def finish(
        self,
        summary: dict,
        lists: Mapping[str, Iterable[str]],
        records: Mapping[str, dict],
        truth: Mapping[str, pycolmap.Rigid3d],
        thresholds: Thresholds,
        features: Path,
        poses: Path,
        files: Mapping[str, Path | None],
    ) -> dict:
        """Write queries.csv and summary.json.

        Args:
            summary: the configuration and counts that the summary begins with.
            lists: the queries of each list.
            records: the record of each query, see `localization.stage.main`.
            truth: known true poses, camera from world.
            thresholds: the recall thresholds of each list.
            features: feature file.
            poses: file of the poses.
            files: what the report reads: `query_images` and `map_images`, folders; `pairs` and
                `matches` of the queries; `map_features`; `map`, a COLMAP model or the h5 file of
                `localize_inloc.lift_keypoints`; and `ground_truth`.

        Returns:
            The summary.
        """
        outputs = self.folder.path
        rows = query_table(lists, records, truth)
        failed = {name: reason for name, reason in failures(features).items() if name in records}
        if failed:
            logger.warning(
                "%d of %d queries are unreadable and not localized: %s. Run the same command again "
                "to retry them.",
                *(len(failed), len(rows), extract_features.with_reasons(failed)),
            )
        write_csv(rows, outputs / "queries.csv")
        summary = {
            "feature": self.feature,
            "matcher": self.matcher,
            **summary,
            "queries": len(rows),
            "queries_localized": sum(row["status"] == "localized" for row in rows),
            "queries_unreadable": len(failed),
            "lists": {
                name: summarize_list([row for row in rows if row["list"] == name], thresholds[name])
                for name in lists
            },
            "bytes_per_keypoint": bytes_per_keypoint(files["map_features"] or features),
            "seconds": self.folder.seconds(),
            "bytes": self.folder.bytes(),
            "versions": versions(),
            "poses": poses.name,
            "files": {
                key: None if path is None else relative(path, outputs)
                for key, path in {"features": features, **files}.items()
            },
        }
        write_summary(summary, outputs / "summary.json")
        return summary


class Settings(TypedDict, total=False):
    """The arguments that pipelines of data sets hand on to `DatasetRun`, which explains them."""

    matcher: str
    retrieval: str
    ground_truth: Path | None
    overwrite: bool
    projection: Path | None
    storage: str
    keypoints: str
    executor: Executor
    strict: bool
    accept_partial: bool
    gate: Gate


class DatasetRun(Run):
    """A run of the pipeline of a data set. All inputs are checked before any work is done.

    Args:
        place: the data set.
        outputs: folder for the results.
        feature: name of a feature, or its YAML file.
        num_loc: retrieved map images per query.
        numbers: further --num_... options of the pipeline.
        matcher: name of the matcher.
        retrieval: "vlad", or a file of pairs or of global descriptors.
        ground_truth: true poses of the queries; default: those of the data set.
        overwrite: recompute existing results.
        projection: projection file to use with the base descriptor of `feature`.
        storage: how descriptors of map images are stored.
        keypoints: settings of the DoG detector.
        executor: where the work is done.
        features: feature file to use instead of extracting features.
        strict: stop at an unreadable query photo instead of recording it as not localized.
        accept_partial: build the map without photos that are missing or unreadable.
        gate: what a pose must have for the query to be called localized.

    Attributes:
        query_names: the queries.
        map_names: the map images that are needed; after `extract_features` the readable ones.
        features: the feature file, after `extract_features`.
        label: names files of results, such as `sift_sv64+NN-ratio_vlad50`.

    Raises:
        InputError: when something is missing or wrong.
    """

    @strings_as_paths
    def __init__(
        self,
        place: Aachen | InLoc,
        outputs: Path,
        feature: str = features_confs.RECOMMENDED,
        num_loc: int = 50,
        numbers: Mapping[str, int] | None = None,
        matcher: str | None = None,
        retrieval: str = "vlad",
        ground_truth: Path | None = None,
        overwrite: bool = False,
        projection: Path | None = None,
        storage: str = STORAGES[0],
        keypoints: str = KEYPOINTS[0],
        executor: Executor = SERIAL,
        features: Path | None = None,
        strict: bool = False,
        accept_partial: bool = False,
        gate: Gate = DEFAULT_GATE,
    ):
        feature, self._conf = features_confs.get(feature, projection, storage, keypoints)
        matcher = matcher or features_confs.matcher_of(self._conf)
        self.place, self._retrieval, self.gate = place, retrieval, gate
        self._strict, self._accept_partial = strict, accept_partial
        self.numbers = {**(numbers or {}), "num_loc": num_loc}
        retrieved = f"{_retrieval_name(retrieval)}{num_loc}"
        self.label = f"{feature}+{matcher}_{retrieved}"
        self._pairs = outputs / f"pairs-query-{retrieved}.txt"
        self.query_names, map_names = place.query_names(), place.map_names()
        used = check_retrieval(retrieval, self._pairs, num_loc, self.query_names, map_names)
        needed = map_names if place.whole_map else used
        place.check([] if accept_partial and place.whole_map else needed)
        self.map_names = extract_features.keep_present(place.images, needed, accept_partial)
        self.is_partial = len(self.map_names) < len(needed)
        if features is None:
            check_queries(place.images, self.query_names, strict)
        self.truth_file = ground_truth or place.ground_truth
        self.truth = true_poses(self.query_names, self.truth_file, bool(ground_truth))
        self._given, self.features = features, features or outputs / f"{self._conf['output']}.h5"
        super().__init__(self._claim(outputs, matcher, overwrite), feature, matcher, executor)

    def _claim(self, outputs: Path, matcher: str, overwrite: bool) -> RunFolder:
        """Claim the outputs folder. Results of given features are stale if these were redone."""
        conf = {
            "dataset": str(self.place.root.resolve()),
            "feature": extract_features.provenance(self._conf),
            "matcher": matchers_confs.confs[matcher]["model"],
            "retrieval": self._retrieval,
            **self.numbers,
        }
        inputs = [] if self._retrieval == "vlad" else [Path(self._retrieval)]
        if inputs and outputs.resolve().parent in inputs[0].resolve().parents:
            conf["retrieval"] = relative(inputs[0], outputs)  # both may be moved together
        if self._given is not None:
            with open_h5(self._given) as file:
                conf["features"] = get_text(file, "id", str(self._given))
            before = provenance.read(outputs / "conf.json")
            redone = before.get("features") not in (None, conf["features"])
            overwrite |= redone and {**before, "features": conf["features"]} == conf
        elif overwrite or not (outputs / "conf.json").exists():
            extract_features.check_model(self._conf)
        return RunFolder(outputs, conf, overwrite, inputs)

    def extract_features(self) -> Path:
        """Extract the features of all images, unless they are given."""
        with self.stage("extract_features"):
            if self._given is None:
                extract_features.main(
                    *(self._conf, self.place.images),
                    feature_path=self.features,
                    image_list=[*self.map_names, *self.query_names],
                    executor=self.executor,
                    strict=self._strict,
                    queries=self.query_names,
                )
            kept = extract_features.keep_readable(
                self.features, self.map_names, self._accept_partial
            )
            self.is_partial |= len(kept) < len(self.map_names)
            self.map_names = kept
        return self.features

    def mirror_images_of_dataset(self) -> MirrorImages:
        """Return what extracts and matches mirror images of queries, for a localization stage."""
        images = self.place.images
        return self.mirror_images(self._conf, images, self._pairs, self.features, self.features)

    def retrieve(self) -> Path:
        """Write the pairs of the readable queries and map images."""
        with self.stage("retrieval"):
            queries = readable(self.features, self.query_names)
            num_loc = self.numbers["num_loc"]
            retrieve(self._retrieval, self.features, self._pairs, num_loc, queries, self.map_names)
        return self._pairs

    def finish_dataset(
        self,
        lists: Mapping[str, Iterable[str]],
        thresholds: Thresholds,
        records: Mapping[str, dict],
        poses: Path,
        matches: Path,
        built: Path,
        **more: object,
    ) -> dict:
        """Write queries.csv and summary.json.

        Args:
            lists: the queries of each list.
            thresholds: the recall thresholds of each list.
            records: the record of each query.
            poses: file of the poses.
            matches: match file of the queries.
            built: the map, see `finish`.
            more: further entries of the summary.

        Returns:
            The summary.
        """
        images = self.place.images
        summary = {
            "retrieval": self._retrieval,
            "dataset": str(self.place.root),
            **self.numbers,
            "map_images": len(self.map_names),
            **more,
        }
        files = {
            "query_images": images,
            "map_images": images,
            "map_features": self.features,
            "map": built,
            "pairs": self._pairs,
            "matches": matches,
            "ground_truth": self.truth_file if self.truth else None,
        }
        return self.finish(
            summary, lists, records, self.truth, thresholds, self.features, poses, files
        )


def check_retrieval(
    retrieval: str, output: Path, num_loc: int, query_names: list[str], map_names: list[str]
) -> list[str]:
    """Check a retrieval file before any work is done.

    Returns:
        The map images that can be retrieved: those of a list of pairs, else all.

    Raises:
        InputError: for a broken file, one of other images, or `output` itself.
    """
    if retrieval == "vlad":
        return map_names
    if Path(retrieval).resolve() == output.resolve():
        raise InputError(f"--retrieval {retrieval} would be overwritten: move it elsewhere.")
    if Path(retrieval).suffix in GLOBAL_SUFFIXES:
        list_h5_names(Path(retrieval))
        return map_names
    pairs, names = parse_retrieval(Path(retrieval)), set(map_names)
    found = [[other for other in pairs.get(name, ()) if other in names] for name in query_names]
    if not any(found):
        raise InputError(f"{retrieval} has no pair of a query and a map image.")
    return sorted({other for others in found for other in others[:num_loc]})


def check_queries(image_dir: Path, names: list[str], strict: bool) -> None:
    """Raise an InputError if no query photo exists or, if `strict`, one does not."""
    if strict or not any((image_dir / name).is_file() for name in names):
        list_images(image_dir, names)


def readable(features: Path, names: list[str]) -> list[str]:
    """Return the images that could be read when their features were extracted."""
    failed = failures(features)
    return [name for name in names if name not in failed]


def retrieve(
    retrieval: str,
    features: Path,
    output: Path,
    num_loc: int,
    query_names: list[str],
    map_names: list[str],
) -> None:
    """Write pairs of queries and map images, from a file or by VLAD of `features`."""
    if not query_names:
        write_pairs([], output)
        return
    source = Path(retrieval)
    if retrieval == "vlad":
        source = aggregate_features.main(retrieval_confs.confs["vlad"], features, map_names)
    of_descriptors = source.suffix in GLOBAL_SUFFIXES
    select = pairs_from_retrieval.main if of_descriptors else pairs_from_retrieval.select
    select(source, output, num_loc, query_list=query_names, db_list=map_names)


def _retrieval_name(retrieval: str) -> str:
    """Return what result files are named after: `netvlad` for `pairs-query-netvlad50.txt`."""
    return Path(retrieval).stem.removeprefix("pairs-query-").rstrip("0123456789")


def relative(path: Path, outputs: Path) -> str:
    """Return a path relative to the outputs folder if it is in or beside it, else absolute."""
    path, outputs = path.resolve(), outputs.resolve()
    return os.path.relpath(path, outputs) if path.is_relative_to(outputs.parent) else str(path)
