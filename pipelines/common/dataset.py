"""A run of the pipeline of a data set: its inputs, and the stages that its pipelines share."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from hloc_reduce import extract_features, match_features
from hloc_reduce.aggregate_features import output_of
from hloc_reduce.confs import features as features_confs
from hloc_reduce.confs import matchers as matchers_confs
from hloc_reduce.confs import retrieval as retrieval_confs
from hloc_reduce.datasets import Place, true_poses
from hloc_reduce.evaluation.summaries import map_bytes
from hloc_reduce.localization import rigs
from hloc_reduce.runtime import provenance
from hloc_reduce.runtime.outputs import CONF, RunFolder
from hloc_reduce.utils import masks
from hloc_reduce.utils.h5 import get_text, open_h5
from hloc_reduce.utils.parsers import write_poses

from .options import DatasetOptions
from .retrieval import check_model, check_retrieval, retrieval_name, retrieve
from .run import Run, Thresholds, check_queries, readable, relative

TRUTH = "ground_truth_poses.txt"  # written if the poses of the queries are those of a model
SHARED_POINTS = "points3D.h5"  # beside given features of InLoc: the 3D points of their keypoints


class DatasetRun(Run):
    """A run of the pipeline of a data set. All inputs are checked before any work is done.

    Args:
        place: the data set.
        outputs: folder for the results.
        options: the options of the pipeline.

    Attributes:
        conf: the configuration of the feature.
        query_names: the queries.
        map_names: the map images that are needed; after `extract_features` the readable ones.
        features: the feature file, after `extract_features`.
        rigs: the frames of rigs among the queries.
        label: names files of results, such as `sift_sv64+NN-ratio_vlad50`.

    Raises:
        InputError: when something is missing or wrong.
    """

    def __init__(self, place: Place, outputs: Path, options: DatasetOptions):
        feature, self.conf = options.configured_feature()
        fast = features_confs.matcher_of(self.conf)
        matcher = options.matcher or fast
        steps = matchers_confs.steps_of(matcher, fast)
        self.place, self.options = place, options
        retrieved = f"{retrieval_name(options.retrieval)}{options.num_loc}"
        self.label = f"{feature}+{matcher}_{retrieved}"
        self._pairs = outputs / f"pairs-query-{retrieved}.txt"
        self.query_names, map_names = place.query_names(), place.map_names()
        used = check_retrieval(
            options.retrieval, self._pairs, options.num_loc, self.query_names, map_names
        )
        needed, accept_partial = map_names if place.whole_map else used, options.accept_partial
        place.check([] if accept_partial and place.whole_map else needed)
        self.map_names = extract_features.keep_present(place.images, needed, accept_partial)
        self.is_partial = len(self.map_names) < len(needed)
        if options.features is None:
            check_queries(place.images, self.query_names, options.strict)
        self.rigs = rigs.frames(options.rigs, self.query_names) if options.rigs else {}
        self.truth_file = options.ground_truth or place.ground_truth
        self.truth = (
            true_poses(self.query_names, options.ground_truth, True)
            if options.ground_truth
            else place.true_poses()
        )
        self.features = options.features or outputs / f"{self.conf['output']}.h5"
        super().__init__(self._claim(outputs, steps), feature, matcher, steps, options.executor)

    def _claim(self, outputs: Path, steps: tuple[str, ...]) -> RunFolder:
        """Claim the outputs folder. Results of given features are stale if these were redone."""
        options = self.options
        models = [matchers_confs.confs[step]["model"] for step in steps]
        conf: dict[str, Any] = {
            "dataset": str(self.place.root.resolve()),
            "feature": extract_features.provenance(self.conf),
            "matcher": models if steps[1:] else models[0],
            "retrieval": options.retrieval,
            **options.numbers,
        }
        found = masks.find(options.masks, self.place.images, [*self.map_names, *self.query_names])
        conf |= {"masks": masks.digests(found)} if found else {}
        is_file = options.retrieval not in retrieval_confs.confs
        inputs = [Path(options.retrieval)] if is_file else []
        if inputs and outputs.resolve().parent in inputs[0].resolve().parents:
            conf["retrieval"] = relative(inputs[0], outputs)  # both may be moved together
        overwrite = options.overwrite
        if options.features is not None:
            with open_h5(options.features) as file:
                conf["features"] = get_text(file, "id", str(options.features))
            before = provenance.read(outputs / CONF)
            redone = before.get("features") not in (None, conf["features"])
            overwrite |= redone and {**before, "features": conf["features"]} == conf
        elif overwrite or not (outputs / CONF).exists():
            extract_features.check_model(self.conf)
            for step in steps:
                match_features.check_model(matchers_confs.confs[step], conf["feature"])
            check_model(options.retrieval)
        inputs += [options.masks] if options.masks else []
        return RunFolder(outputs, conf, overwrite, inputs)

    def extract_features(self) -> Path:
        """Extract the features of all images, unless they are given."""
        with self.stage("extract_features"):
            if self.options.features is None:
                extract_features.main(
                    self.conf,
                    self.place.images,
                    feature_path=self.features,
                    image_list=[*self.map_names, *self.query_names],
                    executor=self.executor,
                    strict=self.options.strict,
                    queries=self.query_names,
                    masks=self.options.masks,
                )
            kept = extract_features.keep_readable(
                self.features, self.map_names, self.options.accept_partial
            )
            self.is_partial |= len(kept) < len(self.map_names)
            self.map_names = kept
        return self.features

    @property
    def global_descriptors(self) -> Path:
        """The file of the global descriptors that `retrieve` computes, unless they are given."""
        confs = retrieval_confs.confs
        conf = confs.get(self.options.retrieval, confs[retrieval_confs.VLAD])
        return output_of(conf, self.features)

    def map_bytes(self, sfm: Path) -> int:
        """Measure the map that queries are localized in, see `summaries.map_bytes`."""
        return map_bytes(sfm, self.map_names, [self.features, self.global_descriptors])

    def retrieve(self) -> Path:
        """Write the pairs of the readable queries and map images."""
        with self.stage("retrieval"):
            queries = readable(self.features, self.query_names)
            retrieve(
                self.options.retrieval,
                self.features,
                self._pairs,
                self.options.num_loc,
                queries,
                self.map_names,
                self.place.images,
            )
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
        files = self.files(self.features, built, self._pairs, matches)
        summary, truth = self.summary(**more), self.truth
        return self.finish(summary, lists, records, truth, thresholds, self.features, poses, files)

    def summary(self, **more: object) -> dict:
        """Return what the summary begins with; `more` are further entries."""
        return {
            "retrieval": self.options.retrieval,
            "dataset": str(self.place.root),
            **self.options.numbers,
            "map_images": len(self.map_names),
            **more,
        }

    def files(
        self, map_features: Path, built: Path, pairs: Path, matches: Path
    ) -> dict[str, Path | None]:
        """Return the files that a report reads, see `finish`."""
        images, truth = self.place.images, self.truth_file
        if self.truth and (truth is None or not truth.is_file()):
            truth = self.folder.path / TRUTH
            write_poses(self.truth, truth, None)
        return {
            "query_images": images,
            "map_images": images,
            "map_features": map_features,
            "map": built,
            "pairs": pairs,
            "matches": matches,
            "ground_truth": truth if self.truth else None,
        }
