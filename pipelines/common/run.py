"""A run of a pipeline: its outputs folder, matching, and the summary at its end."""

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from types import MappingProxyType
from typing import Self

import pycolmap

from hloc_reduce import logger, match_features
from hloc_reduce.confs import matchers as matchers_confs
from hloc_reduce.evaluation.summaries import (
    bytes_per_keypoint,
    query_table,
    summarize_list,
    write_summary,
)
from hloc_reduce.localization import rig_stage
from hloc_reduce.localization.frame import UNKNOWN, Frame
from hloc_reduce.localization.mirrored import MirrorImages
from hloc_reduce.localization.stage import Matched, MatchRigs, Try
from hloc_reduce.maps.mirror_images import mirror_images
from hloc_reduce.runtime.executors import SERIAL, Executor
from hloc_reduce.runtime.group_writer import failures
from hloc_reduce.runtime.outputs import RunFolder
from hloc_reduce.runtime.versions import versions
from hloc_reduce.utils.files import write_csv
from hloc_reduce.utils.h5 import get_conf, open_h5
from hloc_reduce.utils.images import list_images, with_reasons
from hloc_reduce.utils.match_files import check_distinct
from hloc_reduce.utils.parsers import parse_pairs, write_pairs, write_pairs_of

Thresholds = Mapping[str, tuple[tuple[float, float], ...]]  # of each query list, metres and degrees


class Run:
    """A run in an outputs folder; as a context manager it releases the folder at its end.

    Args:
        folder: the outputs folder.
        feature: name of the feature.
        matcher: one of `confs.matchers.names`.
        steps: the matchers that it stands for, see `confs.matchers.steps_of`.
        executor: where the work is done.
        earlier: an outputs folder whose stages this run continues: the summary counts them, but
            for those that this run repeats. Features of mirror images are kept there.
    """

    def __init__(
        self,
        folder: RunFolder,
        feature: str,
        matcher: str,
        steps: tuple[str, ...],
        executor: Executor = SERIAL,
        earlier: RunFolder | None = None,
    ):
        self.folder, self.feature, self.matcher, self.steps = folder, feature, matcher, steps
        self.executor = executor
        self._files_of_tries: dict[int, Matched] = {}
        self._folders = [folder] if earlier is None else [earlier, folder]

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
            return self.match_pairs(self.steps[0], pairs, features, features_ref)

    def match_pairs(
        self, matcher: str, pairs: Path, features: Path, features_ref: Path | None
    ) -> Path:
        """Match pairs, see `match`."""
        conf = matchers_confs.confs[matcher]
        matches = self.folder.path / f"{features.stem}_{conf['output']}_{pairs.stem}.h5"
        if next(parse_pairs(pairs), None) is not None:  # else no query could be read
            match_features.main(
                conf,
                pairs,
                features,
                matches=matches,
                features_ref=features_ref,
                executor=self.executor,
            )
        return matches

    def again(
        self,
        pairs: Path,
        features: Path,
        features_ref: Path | None = None,
        mirror_images: Callable[[str], MirrorImages] | None = None,
        others: Iterable[Try] = (),
    ) -> list[Try]:
        """Return how queries that are not localized are matched once more.

        Args:
            pairs: pairs of all queries and map images; those of the queries go beside it.
            features: feature file.
            features_ref: feature file of the map images; default: `features`.
            mirror_images: returns the `mirror_images` of a matcher.
            others: tries after that by a second matcher, if there is one.
        """
        given = pairs, features, features_ref, mirror_images
        tries = [*(self._second(matcher, *given) for matcher in self.steps[1:]), *others]
        return [self._recorded(number, one) for number, one in enumerate(tries, 1)]

    def _recorded(self, number: int, one: Try) -> Try:
        """Return a try whose files go to the summary."""

        def match(names: list[str]) -> Matched:
            self._files_of_tries[number] = one.match(names)
            return self._files_of_tries[number]

        return one._replace(match=match)

    def _second(
        self,
        matcher: str,
        pairs: Path,
        features: Path,
        features_ref: Path | None,
        mirror_images: Callable[[str], MirrorImages] | None,
    ) -> Try:
        """Return how a second matcher matches queries, see `again`."""

        def match(names: list[str]) -> Matched:
            listed = write_pairs_of(names, pairs, "again")
            return Matched(features, self.match_pairs(matcher, listed, features, features_ref))

        model = matchers_confs.confs[matcher]["model"]
        with open_h5(features) as file:
            made_from = {"model": model, **matchers_confs.provenance(model, get_conf(file))}
        return Try(match, made_from, mirror_images(matcher) if mirror_images else None)

    def match_rigs(
        self, pairs: Path, features: Path, features_ref: Path | None = None
    ) -> MatchRigs:
        """Return what matches photos of rigs once more; the arguments are those of `again`."""

        def match(number: int, listed: Sequence[tuple[str, str]]) -> Path:
            wider = pairs.with_stem(f"{pairs.stem}-rigs{number or ''}")
            write_pairs(listed, wider)
            return self.match_pairs(self.steps[number], wider, features, features_ref)

        return match

    def mirror_images(
        self,
        conf: dict,
        image_dir: Path,
        pairs: Path,
        features: Path,
        map_features: Path,
        masks: Path | None = None,
    ) -> Callable[[str], MirrorImages]:
        """Return what a matcher needs to match mirror images of queries in a localization stage.

        Args:
            conf: configuration of the feature.
            image_dir: folder of the queries.
            pairs: pairs of all queries and map images.
            features: feature file of all queries.
            map_features: feature file of the map images.
            masks: of the queries.
        """
        mirrored = self._folders[0].path / f"{features.stem}-mirrored.h5"

        def of_matcher(matcher: str) -> MirrorImages:
            def match(listed: Path, mirrored: Path) -> Path:
                return self.match_pairs(matcher, listed, mirrored, map_features)

            return mirror_images(conf, image_dir, pairs, mirrored, match, self.executor, masks)

        return of_matcher

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
        frame: Frame = UNKNOWN,
        unreadable: Mapping[str, str] = MappingProxyType({}),
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
            frame: of the map.
            unreadable: why panoramas, which have no features of their own, cannot be read.

        Returns:
            The summary.
        """
        outputs = self.folder.path
        rows = query_table(lists, records, truth, frame)
        localized = [row for row in rows if row["status"] == "localized"]
        known = {**failures(features), **unreadable}
        failed = {name: reason for name, reason in known.items() if name in records}
        if failed:
            logger.warning(
                "%d of %d queries are unreadable and not localized: %s. Run the same command again "
                "to retry them.",
                len(failed),
                len(rows),
                with_reasons(failed),
            )
        write_csv(rows, outputs / "queries.csv")
        frames = rig_stage.reasons(records.values())
        of_rigs = {"frames": len(frames), "frames_localized": list(frames.values()).count(None)}
        summary = {
            "feature": self.feature,
            "matcher": self.matcher,
            **summary,
            "queries": len(rows),
            "queries_localized": len(localized),
            "queries_matched_again": sum(row["again"] for row in localized),
            "queries_turned": sum(row["turned"] > 0 for row in localized),
            "queries_unreadable": len(failed),
            **(of_rigs if frames else {}),
            "lists": {
                name: summarize_list([row for row in rows if row["list"] == name], thresholds[name])
                for name in lists
            },
            "bytes_per_keypoint": bytes_per_keypoint(files["map_features"] or features),
            "seconds": {k: v for folder in self._folders for k, v in folder.seconds().items()},
            "bytes": {k: v for folder in self._folders for k, v in folder.bytes().items()},
            "versions": versions(),
            "poses": poses.name,
            "files": _relative({"features": features, **files}, outputs),
            "tries": {
                str(number): _relative(matched._asdict(), outputs)
                for number, matched in sorted(self._files_of_tries.items())
            },
        }
        write_summary(summary, outputs / "summary.json")
        return summary


def check_queries(image_dir: Path, names: list[str], strict: bool) -> None:
    """Check the names of queries, and that one of the photos exists or, if `strict`, all do.

    Raises:
        InputError: if they do not, or if two of the photos have the same name in match files.
    """
    check_distinct(names)
    if strict or not any((image_dir / name).is_file() for name in names):
        list_images(image_dir, names)


def readable(features: Path, names: list[str]) -> list[str]:
    """Return the images that could be read when their features were extracted."""
    failed = failures(features)
    return [name for name in names if name not in failed]


def _relative(files: Mapping[str, Path | None], outputs: Path) -> dict[str, str | None]:
    return {key: None if path is None else relative(path, outputs) for key, path in files.items()}


def relative(path: Path, outputs: Path) -> str:
    """Return a path relative to the outputs folder if it is in or beside it, else absolute."""
    path, outputs = path.resolve(), outputs.resolve()
    return os.path.relpath(path, outputs) if path.is_relative_to(outputs.parent) else str(path)
