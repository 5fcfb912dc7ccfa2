"""The options that the pipelines share."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from hloc_reduce.confs import features as features_confs
from hloc_reduce.confs import matchers as matchers_confs
from hloc_reduce.confs import retrieval as retrieval_confs
from hloc_reduce.detectors.dog import KEYPOINT_SETTINGS, KeypointSettings
from hloc_reduce.localization.gate import DEFAULT_GATE, Gate
from hloc_reduce.runtime.executors import SERIAL, Executor
from hloc_reduce.utils.codes import STORAGES, Storage
from hloc_reduce.utils.options import HIDDEN, POSITIVE, Checked, Option

Positive = Annotated[int, POSITIVE]
Matcher = Annotated[str, Option("matcher", matchers_confs.names)]
Rigs = Annotated[Path, Option(metavar="rig_config.json")]
Retrieval = Annotated[str, Option(metavar="|".join([*retrieval_confs.confs, "FILE"]))]


@dataclass(frozen=True, kw_only=True)
class Method(Checked):
    """How the queries of a data set are localized: what jobs of pipelines.batch choose, too.

    Args:
        feature: local feature, see `list_features`, or a YAML file with its configuration.
        storage: storage of the descriptors of map images (those of queries stay floats).
        keypoints: settings of the DoG detector.
        matcher: matcher; with NN+lightglue, queries that nearest neighbours do not localize are
            matched by LightGlue; default: the feature's, see `list_features`.
        retrieval: a name (those of networks need an installed hloc), or hloc's text file of pairs
            or h5 file of global descriptors.
        ground_truth: true poses of the queries; default: those of the data set.
        num_loc: retrieved map images per query.
        rigs: COLMAP's file of cameras that are fixed to each other, in the units of the map.
            Queries of one moment, which have the same name in the folders of their cameras, get one
            pose of the rig.
        gate: what a pose must have for the query to be called localized.
    """

    feature: str = features_confs.RECOMMENDED
    storage: Storage = STORAGES[0]
    keypoints: KeypointSettings = KEYPOINT_SETTINGS[0]
    matcher: Matcher | None = None
    retrieval: Retrieval = retrieval_confs.VLAD
    ground_truth: Path | None = None
    num_loc: Positive | None = None
    rigs: Rigs | None = None
    gate: Gate = DEFAULT_GATE


@dataclass(frozen=True, kw_only=True)
class DatasetOptions(Method):
    """The options of a run on a data set.

    Args:
        projection: projection file to use with the base descriptor of `feature`.
        features: feature file to use instead of extracting features.
        strict: fail at an unreadable query photo instead of recording it as not localized.
        accept_partial: build the map without photos that are missing or unreadable.
        overwrite: recompute existing results.
        executor: where the work is done.
        masks: folder of masks of photos, as COLMAP's: keypoints of a/photo.jpg in black pixels of
            `masks`/a/photo.jpg.png are dropped; or one mask for all photos of its size; default:
            none.
    """

    num_loc: Positive = 50
    projection: Path | None = None
    features: Annotated[Path, HIDDEN] | None = None
    strict: bool = False
    accept_partial: bool = False
    overwrite: bool = False
    executor: Executor = SERIAL
    masks: Path | None = None

    def configured_feature(self) -> tuple[str, dict]:
        """Return the name and the configuration of the feature."""
        return features_confs.get(self.feature, self.projection, self.storage, self.keypoints)

    @property
    def numbers(self) -> dict[str, int]:
        """The options that begin with num_."""
        return {name: value for name, value in vars(self).items() if name.startswith("num_")}
