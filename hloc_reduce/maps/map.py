"""Maps to localize in: the points, features and global descriptors of photos, kept in a folder."""

import glob
import json
import shutil
import uuid
from collections.abc import Callable, Iterable
from functools import cached_property
from pathlib import Path

import numpy as np
import pycolmap

from .. import aggregate_features, extract_features, projections
from ..confs import features as features_confs
from ..confs import matchers as matchers_confs
from ..confs import retrieval as retrieval_confs
from ..detectors.dog import KEYPOINT_SETTINGS
from ..localization import intrinsics, views
from ..localization.frame import Frame
from ..mapping.findings import Finding, warn
from ..runtime import provenance
from ..runtime.outputs import CONF, RunFolder
from ..utils import colmap
from ..utils.cli import InputError, choose, no_folder
from ..utils.codes import CODED, QUANTIZED, STORAGES
from ..utils.feature_files import Levels, first_descriptors
from ..utils.files import announce, delete, replacing
from ..utils.h5 import Unavailable, file_provenance, get_dataset, list_h5_names, open_h5
from ..utils.match_files import list_pairs
from ..utils.paths import strings_as_paths
from .older import findings_of

FINISHED = "map.json"  # is written last
FINGERPRINTS = "fingerprints.json"
SFM = "sfm"  # the folder of the COLMAP model
PLACE = "place.txt"  # stays when the map is rebuilt


class Map:
    """A finished map. All that it needs is in its folder, which may be moved.

    Args:
        folder: of the map.

    Attributes:
        place: an id that stays the same when the map is rebuilt.
        id: an id of this build.
        feature: name of the feature.
        storage: how descriptors are stored, as in `confs.features.get`.
        keypoints: settings of the DoG detector that were asked for, as in `confs.features.get`;
            `conf` may have others, which found more keypoints.
        conf: configuration of the features, for more images.
        matcher: key of `confs.matchers`.
        retrieval: key of `confs.retrieval`.
        images: folder of the photos.
        num_images: images with a pose.
        findings: what may be wrong with it, and which photos were left out.
        num_points3D: 3D points.
        camera_mode: which images share a camera, None for the cameras of a given model.
        has_rigs: whether a file of rigs gave poses of its cameras.
        cameras: what the map tells about the intrinsics of other photos.
        frame: its unit, and where on Earth it is.
        aligned_to: what its frame was aligned to, see `georeference.align`; else None.
        sfm: folder of the COLMAP model.
        features: feature file of the map images.
        descriptors: h5 file of their global descriptors.
        vocabulary: file of the vocabulary of the global descriptors, None if they have none.

    Raises:
        InputError: if the folder is missing, or is not a finished map.
    """

    cameras: intrinsics.MapCameras
    sfm: Path
    _tells_lenses: bool

    @strings_as_paths
    def __init__(self, folder: Path):
        self.folder = folder
        try:
            self._read(json.loads((folder / FINISHED).read_text()))
        except (OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError):
            if not folder.is_dir():
                raise no_folder(folder) from None
            inner = folder / "map"
            hint = f" Did you mean {inner}?" if (inner / FINISHED).is_file() else ""
            raise InputError(
                f"{folder} is not a map, or not a finished one: it has no sound {FINISHED}.{hint}"
            ) from None
        self._check()
        if not self._tells_lenses:  # of an earlier version
            model = colmap.read_model(self.sfm)
            cameras = [image.camera for image in model.images.values()]
            self.cameras = intrinsics.with_lenses(self.cameras, cameras)

    def _read(self, content: dict) -> None:
        self.place = (self.folder / PLACE).read_text()
        self.id = str(content["id"])
        self.feature = _file_name(content["feature"])
        self.matcher = choose("matcher", content["matcher"], matchers_confs.confs)
        name = content.get("retrieval", retrieval_confs.VLAD)
        retrieved_by, self.retrieval = retrieval_confs.get(name), str(name)
        self.images = Path(content["image_dir"])
        self.num_images = int(content["images_with_pose"])
        if "findings" in content:
            self.findings = [Finding.from_json(one) for one in content["findings"]]
        else:
            self.findings = findings_of(content)
        self._doubts = [str(doubt) for doubt in content.get("doubts", [])]
        self.num_points3D = int(content["points3D"])
        self.frame = Frame.from_json(content.get("frame"))
        self.aligned_to = content.get("aligned_to")
        self.camera_mode = content.get("camera_mode")
        self.has_rigs = bool(content.get("rigs"))
        self.cameras = intrinsics.from_dict(content)
        self._tells_lenses = "lenses" in content
        conf = dict(content["conf"])
        conf |= {key: dict(conf[key]) for key in ("model", "preprocessing")}
        self.storage = choose("storage", conf.get("storage", STORAGES[0]), STORAGES)
        base = features_confs.base_of(conf["model"])
        if base["name"] == "dog" and "keypoints" not in base:  # of a version without this setting
            conf["model"] = features_confs.with_keypoints(conf["model"], "hloc")
        found = features_confs.base_of(conf["model"]).get("keypoints", KEYPOINT_SETTINGS[0])
        self.keypoints = choose("keypoints", content.get("keypoints", found), KEYPOINT_SETTINGS)
        self.conf = with_projection(conf, lambda name: str(self.folder / _file_name(name)))
        self.sfm = self.folder / _file_name(content.get("sfm", SFM))
        self.features = self.folder / f"{_file_name(conf['output'])}.h5"
        self.descriptors = aggregate_features.output_of(retrieved_by, self.features)
        self.vocabulary = aggregate_features.vocabulary_if_any(retrieved_by, self.descriptors)

    def _check(self) -> None:
        """Refuse a map that lacks a file, or has a broken one, before any work is done in it."""
        from ..retrieval.vlad import read_vocabulary

        projection = self.conf["model"].get("projection")
        needed = [self.features, self.descriptors]
        needed += [self.vocabulary] if self.vocabulary else []
        needed += [Path(projections.split_prefix(projection)[0])] if projection else []
        missing = [path for path in needed if not path.is_file()]
        for part in ("cameras", "images", "points3D"):
            if not any((self.sfm / f"{part}{suffix}").is_file() for suffix in (".bin", ".txt")):
                missing.append(self.sfm / f"{part}.bin")
        try:
            if missing:
                named = ", ".join(str(path.relative_to(self.folder)) for path in missing)
                raise InputError(f"it has no {named}")
            for path in (self.features, self.descriptors):
                with open_h5(path) as file:
                    file_provenance(file)
            self._check_levels()
            if self.vocabulary:
                read_vocabulary(self.vocabulary)
            if projection:
                projections.load(projection)
        except Unavailable:
            raise
        except InputError as error:
            raise InputError(
                f"The map {self.folder} is broken: {str(error).rstrip('.')}. Copy it again, or "
                "build it again with --overwrite."
            ) from None

    def levels(self) -> Levels:
        """Return what checks that the codes of its images have the levels of its projection."""
        file = features_confs.level_file(self.conf)
        if self.storage not in CODED or file is None:
            return Levels()
        found = projections.levels(file, self.storage).astype(np.float16)
        return Levels({QUANTIZED[self.storage]: (found, Path(file).name)})

    def _check_levels(self) -> None:
        """Raise an InputError if the codes of the first image have others."""
        if self.storage not in CODED:
            return
        with open_h5(self.features) as file:
            if (first := first_descriptors(file)) is not None:
                self.levels().check(first)

    def check_feature(self, feature: str, projection: Path | None = None) -> None:
        """Refuse a feature that is not the map's.

        Args:
            feature: as in `confs.features.get`.
            projection: as in `confs.features.get`.

        Raises:
            InputError: if it is another one, or has the same name but another projection.
        """
        name, conf = features_confs.get(feature, projection, self.storage)
        conf = features_confs.with_settings(conf, self.keypoints)
        made_from = provenance.read(self.folder / CONF).get("feature")
        known = (
            name == self.feature
            if made_from is None
            else made_from == extract_features.provenance(conf)
        )
        if not known:
            other = "" if name != self.feature else f", but not of the {name} that it is now"
            raise InputError(
                f"The map {self.folder} is of --feature {self.feature}{other}. "
                "Leave it out to localize in this map."
            )

    @cached_property
    def is_rotation_invariant(self) -> bool:
        """Whether photos match however they are turned: by such features, also of any size."""
        from .. import extractors

        return extractors.is_rotation_invariant(self.conf["model"])

    def aggregate(
        self,
        features: Path,
        names: list[str],
        image_dir: Path | None,
        export_dir: Path | None = None,
        turns: int = 0,
    ) -> Path:
        """Compute global descriptors of other photos that compare with the map's.

        Args:
            features: feature file of the photos.
            names: the photos.
            image_dir: their folder, which only some retrievals need.
            export_dir: folder of the h5 file of global descriptors; default: that of `features`.
            turns: of the photos, see `localization.views.View`.

        Returns:
            The h5 file.
        """
        conf = retrieval_confs.confs[self.retrieval]
        return aggregate_features.main(
            views.for_retrieval(conf, turns, self.conf["preprocessing"]),
            features,
            export_dir=export_dir,
            vocabulary=self.vocabulary,
            image_list=names,
            image_dir=image_dir,
        )

    @property
    def doubts(self) -> list[str]:
        """Why its photos may be misplaced, and queries with them, in a few words each."""
        found = [one.doubt for one in self.findings if one.doubt and one.verdict != "drop"]
        return [*dict.fromkeys(found + self._doubts)]

    def warn(self) -> None:
        """Warn of what may be wrong with the map, as was found when it was built."""
        warn(self.findings)

    def matched(self) -> list[tuple[str, str]] | None:
        """Return the pairs of photos that were matched to build it, None if that is not known."""
        files = [*self.folder.glob(f"{glob.escape(self.features.stem)}_matches*.h5")]
        names = list_h5_names(self.features)
        return [pair for file in files for pair in list_pairs(file, names)] if files else None

    def names(self) -> list[str]:
        """List the images that have a pose.

        Raises:
            InputError: if the model is broken.
        """
        return sorted(image.name for image in colmap.read_model(self.sfm).images.values())

    def check_features(self, names: Iterable[str]) -> None:
        """Raise an InputError if an image lacks its features or its global descriptor."""
        with open_h5(self.features) as features, open_h5(self.descriptors) as descriptors:
            for name in names:
                get_dataset(features, name, "keypoints")
                get_dataset(descriptors, name, "global_descriptor")


def models(names: Iterable[str]) -> set[str]:
    """Return the names of folders of COLMAP models, of any attempt to build a map."""
    return {name for name in names if name == SFM or name.startswith(f"{SFM}-")}


def _file_name(name: str) -> str:
    """Return a name, or raise a ValueError if it is a path that leads out of a folder."""
    if Path(name).name != name:
        raise ValueError(f"{name!r} is not the name of a file")
    return name


def with_projection(conf: dict, change: Callable[[str], str]) -> dict:
    """Return the configuration of a feature with a changed path of its projection, if any."""
    model = dict(conf["model"])
    if model.get("projection") is not None:
        model["projection"] = change(model["projection"])
    return {**conf, "model": model}


def keep_projection(conf: dict, folder: Path) -> dict:
    """Copy the projection of a feature to a folder and return the configuration with the copy."""

    def copy(projection: str) -> str:
        source, prefix = projections.find(projection), projections.split_prefix(projection)[1]
        with replacing(folder / source.name) as temporary:
            shutil.copyfile(source, temporary)
        return f"{folder / source.name}{prefix and f'@{prefix}'}"

    return with_projection(conf, copy)


def write(
    folder: Path,
    conf: dict,
    reconstruction: pycolmap.Reconstruction,
    cameras: intrinsics.MapCameras,
    **content: object,
) -> dict:
    """Write map.json, with which a map is finished, and return it.

    Args:
        folder: of the map.
        conf: configuration of the features.
        reconstruction: the model.
        cameras: what the map tells about the intrinsics of other photos.
        content: what else map.json says, or says differently from that of a map of a given model
            that contains all images and nothing doubtful.
    """
    whole: dict[str, object] = {
        "id": uuid.uuid4().hex,
        "camera_mode": None,
        "sfm": SFM,
        "images": reconstruction.num_reg_images(),
        "images_with_pose": reconstruction.num_reg_images(),
        "findings": [],
        "points3D": reconstruction.num_points3D(),
    }
    conf = with_projection(conf, lambda path: Path(path).name)
    whole |= {"conf": conf, **intrinsics.to_dict(cameras), **content}
    provenance.write(folder / FINISHED, whole)
    return whole


def opened(built: Map) -> RunFolder:
    """Lock the folder of a finished map, to change it."""
    conf = provenance.read(built.folder / CONF)
    return RunFolder(built.folder, conf, overwrite=False, kept=(PLACE, FINGERPRINTS))


def write_model(folder: Path, before: str, model: pycolmap.Reconstruction) -> Path:
    """Write a changed model into a new folder, which map.json is to name then, and return that.

    Args:
        folder: of the map.
        before: name of the folder of the model as it was.
        model: as it is now.
    """
    number = 2
    while before == f"{SFM}-{number}":
        number += 1
    written = folder / f"{SFM}-{number}"
    announce(written)
    delete(written)
    written.mkdir()
    model.write_binary(written)
    return written


def is_map(folder: Path) -> bool:
    """Return whether a folder is a map, finished or not, rather than a COLMAP model."""
    return any((folder / name).exists() for name in (FINISHED, FINGERPRINTS))
