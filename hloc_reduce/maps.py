"""Maps to localize in: the points, features and global descriptors of photos, kept in a folder."""

import glob
import json
import shutil
import uuid
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import pycolmap

from confs import features as features_confs
from confs import matchers as matchers_confs

from . import (
    aggregate_features,
    colmap,
    extract_features,
    extractors,
    intrinsics,
    logger,
    match_features,
    pairs_from_covisibility,
    pairs_from_exhaustive,
    pairs_from_retrieval,
    pairs_from_verification,
    projections,
    reconstruction,
    stamps,
    triangulation,
)
from .cli import InputError, choose, no_folder
from .detection import KEYPOINTS
from .extract_features import keep_present, keep_readable, list_images
from .extractors.vlad import read_vocabulary
from .io import open_h5, provenance, replacing
from .paths import strings_as_paths
from .results import RunFolder
from .storage import STORAGES

FINISHED = "map.json"  # is written when all else is there
FINGERPRINTS = "fingerprints.json"
SFM = "sfm"  # the folder of the COLMAP model
# what is added to the names of what later attempts make: with more keypoints, or without these
MORE, FURTHER = "-keypoints_colmap", "-further"
PLACE = "place.txt"  # stays when the map is built anew
RETRIEVAL = aggregate_features.confs["vlad"]
MAX_EXHAUSTIVE = 100  # photos without covisibility of which all pairs are matched
ROUNDS = 3  # in which larger sets get more pairs, where these leave photos unconnected


class Map:
    """A map that `main` made; what it needs is in its folder, which may be moved.

    Args:
        folder: of the map.

    Raises:
        InputError: when the folder is not there, is no map or not a finished one.
    """

    @strings_as_paths
    def __init__(self, folder: Path):
        self.folder = folder
        try:
            self.place = (folder / PLACE).read_text()
            content = json.loads((folder / FINISHED).read_text())
            self.id = str(content["id"])
            self.feature = _file_name(content["feature"])
            self.matcher = choose("matcher", content["matcher"], matchers_confs.confs)
            self.images = Path(content["image_dir"])
            self.num_images = int(content["images_with_pose"])
            self.num_points3D = int(content["points3D"])
            self.camera_mode = content.get("camera_mode")  # None for the cameras of a model
            known = content.get("cameras", {}).items()
            self.cameras = intrinsics.MapCameras(
                {name: intrinsics.from_list(values) for name, values in known},
                {(int(width), int(height)) for width, height in content.get("sizes", [])},
                {str(model) for model in content.get("camera_models", [])},
            )
            conf = content["conf"]
            self._conf = {
                "output": _file_name(conf["output"]),
                "model": dict(conf["model"]),
                "preprocessing": dict(conf["preprocessing"]),
            }
            base = conf["model"].get("base", conf["model"])
            if base["name"] == "dog" and "keypoints" not in base:  # made before these could adapt
                self._conf["model"] = features_confs.with_keypoints(conf["model"], "hloc")
            model = self._conf["model"]
            found = model.get("base", model).get("keypoints", KEYPOINTS[0])
            self._keypoints = choose("keypoints", content.get("keypoints", found), KEYPOINTS)
            self._sfm = _file_name(content.get("sfm", SFM))
            if "storage" in conf:
                self._conf["storage"] = choose("storage", conf["storage"], STORAGES)
            _with_projection(self._conf, _file_name)
        except (OSError, ValueError, KeyError, TypeError):
            if not folder.is_dir():
                raise no_folder(folder) from None
            raise InputError(
                f"{folder} is not a map, or not a finished one: it has no sound {FINISHED}."
            ) from None
        self._check()

    def _check(self) -> None:
        """Refuse a map that lacks a file, or has a broken one, before any work is done in it."""
        projection = self.conf["model"].get("projection")
        needed = [self.features, self.descriptors, self.vocabulary]
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
                    provenance(file)
            read_vocabulary(self.vocabulary)
            if projection:
                projections.load(projection)
        except InputError as error:
            raise InputError(
                f"The map {self.folder} is broken: {str(error).rstrip('.')}. Copy it again, or "
                "build it anew with --overwrite."
            ) from None

    @property
    def conf(self) -> dict:
        """The configuration of the map's features, for more images."""
        return _with_projection(self._conf, lambda name: str(self.folder / name))

    def check_feature(self, feature: str, projection: Path | None = None) -> None:
        """Refuse a feature that is not the map's.

        Args:
            feature: as in `confs.features.get`.
            projection: likewise.

        Raises:
            InputError: if it is another, or has the same name but another projection.
        """
        name, conf = features_confs.get(feature, projection, self.storage, self.keypoints)
        made_by = extract_features.provenance(conf)
        if json.loads((self.folder / "conf.json").read_text())["feature"] != made_by:
            other = "" if name != self.feature else f", but not of the {name} that it is now"
            raise InputError(
                f"The map {self.folder} is of --feature {self.feature}{other}. "
                "Leave it out to localize in this map."
            )

    @property
    def storage(self) -> str:
        """How descriptors are kept, as in `confs.features.get`."""
        return self._conf.get("storage", STORAGES[0])

    @property
    def keypoints(self) -> str:
        """The settings of the DoG detector that were asked for, as in `confs.features.get`.

        `conf` may have others, which found more keypoints.
        """
        return self._keypoints

    @property
    def sfm(self) -> Path:
        """The folder of the COLMAP model."""
        return self.folder / self._sfm

    def drop_others(self) -> None:
        """Delete what other attempts to build the map left."""
        kept = self._conf["output"]
        plain = kept.removesuffix(MORE)
        for name in {plain, f"{plain}{MORE}"} - {kept}:
            escaped = glob.escape(name)
            others = [f"{escaped}.h5*", f"{escaped}_matches*"]
            others.append(f"{RETRIEVAL['output']}_{escaped}.*")
            for path in [path for pattern in others for path in self.folder.glob(pattern)]:
                shutil.rmtree(path) if path.is_dir() else path.unlink()
        for name in {SFM, f"{SFM}{MORE}", f"{SFM}{FURTHER}"} - {self._sfm}:
            shutil.rmtree(self.folder / name, ignore_errors=True)

    @property
    def features(self) -> Path:
        """The feature file of the map images."""
        return self.folder / f"{self._conf['output']}.h5"

    @property
    def descriptors(self) -> Path:
        """The h5 file of the global descriptors of the map images."""
        return self.folder / f"{RETRIEVAL['output']}_{self.features.stem}.h5"

    @property
    def vocabulary(self) -> Path:
        """The file of the vocabulary of the global descriptors."""
        return aggregate_features.vocabulary_of(self.descriptors)

    def names(self) -> list[str]:
        """List the images that have a pose."""
        return sorted(image.name for image in colmap.read_model(self.sfm).images.values())


@strings_as_paths
def main(
    map_dir: Path,
    image_dir: Path,
    model: Path | None = None,
    feature: str = features_confs.RECOMMENDED,
    projection: Path | None = None,
    matcher: str = "NN-ratio",
    num_covis: int = 20,
    overwrite: bool = False,
    storage: str = STORAGES[0],
    keypoints: str = KEYPOINTS[0],
    accept_partial: bool = False,
    camera_mode: pycolmap.CameraMode = pycolmap.CameraMode.AUTO,
) -> Map:
    """Build a map, or open one that was made from the same.

    Args:
        map_dir: the folder of the map.
        image_dir: folder of the images.
        model: COLMAP model with their poses; None to reconstruct them, in a frame and scale of
            their own.
        feature: as in `confs.features.get`.
        projection: likewise.
        matcher: a key of `confs.matchers`.
        num_covis: pairs of each image with the most covisible ones of the model. If the model has
            no points, or there is none, up to `MAX_EXHAUSTIVE` images are all paired, and of more
            each is paired with the most similar ones; without a model, pairs are added where
            these leave images unconnected.
        overwrite: build anew.
        storage: as in `confs.features.get`.
        keypoints: as in `confs.features.get`.
        accept_partial: do without images of the model that are missing, and without images that
            cannot be read; without a model, build a map even if fewer than half of the images
            are in it.
        camera_mode: which images share a camera, without a model.

    Returns:
        The map.

    Raises:
        InputError: when the folder has a map that was made from something else, something is
            missing or wrong, or fewer than half of the images can be reconstructed; what is
            finished is kept, for a run with `accept_partial`.
    """
    feature, conf = features_confs.get(feature, projection, storage, keypoints)
    matcher_conf = matchers_confs.confs[matcher]
    model_files = {}
    names, num_points3D = None, 0
    if model is not None:
        reference = colmap.read_model(model)
        names = sorted(image.name for image in reference.images.values())
        if not names:
            raise InputError(f"The model {model} has no images.")
        num_points3D = reference.num_points3D()
        model_files = {
            path.name: path
            for path in sorted(model.iterdir())
            if path.stem in triangulation.PARTS and path.is_file()
        }
        names = keep_present(image_dir, names, accept_partial)
    names = list_images(image_dir, names)
    if model is None and len(names) == 1:
        raise InputError(f"A map of photos alone needs two or more: {image_dir} has one.")
    made_by = extract_features.provenance(conf)
    if overwrite or not (map_dir / "conf.json").exists():
        extractors.load(conf["model"])  # is wrong before anything is deleted, if it is
    files = {f"images/{name}": image_dir / name for name in names}
    files |= {f"model/{name}": path for name, path in model_files.items()}
    fingerprints = stamps.fingerprints(files, stamps.read(map_dir / FINGERPRINTS))
    made_from = {
        "feature": made_by,
        "matcher": matcher_conf["model"],
        "num_covis": num_covis,
        "images": {name: fingerprints[f"images/{name}"][2] for name in names},
        "model": {name: fingerprints[f"model/{name}"][2] for name in model_files},
    }
    exhaustive = not num_points3D and len(names) <= MAX_EXHAUSTIVE
    if exhaustive:
        made_from |= {"num_covis": None, "pairs": "exhaustive"}
    elif model is None:
        made_from |= {"pairs": f"retrieval, {ROUNDS} rounds of verification"}
    before = stamps.read(map_dir / "conf.json")
    if before and before != made_from and not (map_dir / FINISHED).exists():
        logger.info("The map %s, which was not finished, is begun anew.", map_dir)
        overwrite = True
    with RunFolder(
        map_dir,
        made_from,
        overwrite,
        inputs=[path for path in (image_dir, model, projection) if path is not None],
    ) as folder:
        if (map_dir / FINISHED).exists():
            built = Map(map_dir)
            if built.camera_mode not in (None, camera_mode.name.lower()):
                raise InputError(
                    f"The map {map_dir} was made with --camera_mode {built.camera_mode}: give it "
                    "again, choose other --outputs, or --overwrite."
                )
            built.drop_others()  # which a killed run left
            return built
        if not (map_dir / PLACE).exists():
            with replacing(map_dir / PLACE) as temporary:
                temporary.write_text(uuid.uuid4().hex)

        logger.info("Building the map %s of %d images.", map_dir, len(names))
        stamps.write(map_dir / FINGERPRINTS, fingerprints)
        conf = _keep_projection(conf, map_dir)
        building = _Building(
            *(folder, map_dir, image_dir, names, matcher_conf),
            *(num_covis, exhaustive, accept_partial, camera_mode),
        )
        if model is not None:
            name, sfm = SFM, building.of_model(conf, model, reference)
        else:
            name, conf, sfm = building.of_photos_alone(conf)
        cameras = intrinsics.of_map(sfm, image_dir)
        summary = {
            "id": uuid.uuid4().hex,
            "feature": feature,
            "matcher": matcher,
            "image_dir": str(image_dir.resolve()),
            "model": str(model.resolve()) if model is not None else None,
            "camera_mode": camera_mode.name.lower() if model is None else None,
            "conf": _with_projection(conf, lambda path: Path(path).name),
            "keypoints": keypoints,
            "sfm": name,
            "images": len(building.names),
            "images_with_pose": sfm.num_reg_images(),
            "points3D": sfm.num_points3D(),
            "cameras": {name: intrinsics.to_list(one) for name, one in cameras.known.items()},
            "sizes": sorted(cameras.sizes),
            "camera_models": sorted(cameras.models),
            "seconds": folder.seconds(),
        }
        stamps.write(map_dir / FINISHED, summary)
        built = Map(map_dir)
        built.drop_others()
        stamps.write(map_dir / FINISHED, {**summary, "bytes": folder.bytes()})
        return built


@dataclass
class _Building:
    """A map that is being built.

    Args:
        folder: its run.
        map_dir: its folder.
        image_dir: folder of the images.
        names: its images; those that cannot be read are dropped.
        matcher_conf: configuration of the matcher.
        num_covis: as in `main`.
        exhaustive: pair all images, unless by covisibility.
        accept_partial: do without images that are missing, unreadable or not reconstructed.
        camera_mode: which images share a camera, without a model.
    """

    folder: RunFolder
    map_dir: Path
    image_dir: Path
    names: list[str]
    matcher_conf: dict
    num_covis: int
    exhaustive: bool
    accept_partial: bool
    camera_mode: pycolmap.CameraMode

    def of_model(
        self, conf: dict, model: Path, reference: pycolmap.Reconstruction
    ) -> pycolmap.Reconstruction:
        """Triangulate a map with the poses of a model, which is read already."""
        features, descriptors = self._describe(conf)
        if len(self.names) < len(reference.images):
            model = colmap.write_part(model, set(self.names), self.map_dir / "sfm_reference")
        if reference.num_points3D():
            pairs = self.map_dir / f"pairs-db-{self.num_covis}.txt"
            with self.folder.stage("pairs"):
                pairs_from_covisibility.main(model, pairs, self.num_covis)
        else:
            pairs = self._pairs(descriptors)
        matches = self._match(pairs, features)
        with self.folder.stage("triangulation"):
            sfm = triangulation.main(
                self.map_dir / SFM, model, self.image_dir, pairs, features, matches
            )
        shutil.rmtree(self.map_dir / "sfm_reference", ignore_errors=True)
        return sfm

    def of_photos_alone(self, conf: dict) -> tuple[str, dict, pycolmap.Reconstruction]:
        """Reconstruct poses and points; again with more keypoints where photos are missing.

        Returns:
            The name of the folder of the map with the most images, the configuration of its
            features, and the map.
        """
        adaptive = features_confs.keypoints_of(conf["model"]) == "adaptive"
        if not adaptive or len(self.names) > reconstruction.VERY_FEW:
            sfm = self._reconstruct(conf, SFM)
            reconstruction.check(self.map_dir / SFM, self.accept_partial)
            return SFM, conf, sfm
        model = features_confs.with_keypoints(conf["model"], "colmap")
        more = {**conf, "output": f"{conf['output']}{MORE}", "model": model}
        found: list[tuple[pycolmap.Reconstruction, str, dict]] = []

        def attempt(sfm: str, conf: dict, once: bool = False) -> bool:
            """Return whether all photos are in the best map so far."""
            with suppress(reconstruction.NoModelError):
                found.append((self._reconstruct(conf, sfm, once), sfm, conf))
            found.sort(key=lambda one: reconstruction.size(one[0]), reverse=True)
            registered = found[0][0].num_reg_images() if found else 0
            logger.info("%d of %d photos are in the map.", registered, len(self.names))
            return registered == len(self.names)

        if not attempt(SFM, conf, once=True):
            logger.info("Trying again with more keypoints.")
            attempt(f"{SFM}{MORE}", more)
            if not found or found[0][1] == SFM:
                attempt(f"{SFM}{FURTHER}", conf)
        if not found:
            raise reconstruction.NoModelError(reconstruction.nothing(self.image_dir))
        best, sfm, conf = found[0]
        reconstruction.check(self.map_dir / sfm, self.accept_partial)
        return sfm, conf, best

    def _reconstruct(self, conf: dict, sfm: str, once: bool = False) -> pycolmap.Reconstruction:
        features, descriptors = self._describe(conf)
        pairs = self._pairs(descriptors)
        matches = self._match(pairs, features)
        for number in () if self.exhaustive else range(1, ROUNDS + 1):
            before, pairs = pairs, self.map_dir / f"pairs-db-{self.num_covis}-{number}.txt"
            with self.folder.stage("verification"):
                pairs_from_verification.main(
                    *(pairs, self.image_dir, before, features, matches, descriptors),
                    *(self.num_covis, self.num_covis if number == 1 else 0),
                    *(self.camera_mode, self.names),
                )
            with self.folder.stage("match_map"):
                match_features.main(self.matcher_conf, pairs, features, matches=matches)
        with self.folder.stage("reconstruction"):
            return reconstruction.reconstruct(
                *(self.map_dir / sfm, self.image_dir, pairs, features, matches, self.camera_mode),
                image_list=self.names,
                once=once,
            )

    def _describe(self, conf: dict) -> tuple[Path, Path]:
        """Return the files of the features and of the global descriptors."""
        with self.folder.stage("extract_features"):
            features = extract_features.main(
                *(conf, self.image_dir, self.map_dir),
                image_list=self.names,
                strict=not self.accept_partial,
            )
            self.names = keep_readable(features, self.names, self.accept_partial)
        with self.folder.stage("retrieval"):
            return features, aggregate_features.main(RETRIEVAL, features, self.names)

    def _pairs(self, descriptors: Path) -> Path:
        """Pair all images, or of many each with the most similar ones."""
        with self.folder.stage("pairs"):
            if self.exhaustive:
                pairs = self.map_dir / "pairs-db-exhaustive.txt"
                pairs_from_exhaustive.main(pairs, self.names)
            else:
                pairs = self.map_dir / f"pairs-db-{self.num_covis}.txt"
                pairs_from_retrieval.main(descriptors, pairs, self.num_covis)
        return pairs

    def _match(self, pairs: Path, features: Path) -> Path:
        with self.folder.stage("match_map"):
            return match_features.main(self.matcher_conf, pairs, features.stem, self.map_dir)


def _file_name(name: str) -> str:
    """Return a name that leads out of no folder, or raise a ValueError."""
    if Path(name).name != name:
        raise ValueError(f"{name!r} is not the name of a file")
    return name


def _with_projection(conf: dict, change: Callable[[str], str]) -> dict:
    """Return the configuration of a feature with another path of its projection, if it has one."""
    model = dict(conf["model"])
    if model.get("projection") is not None:
        model["projection"] = change(model["projection"])
    return {**conf, "model": model}


def _keep_projection(conf: dict, folder: Path) -> dict:
    """Copy the projection of a feature into a folder and return the configuration with it."""

    def copy(projection: str) -> str:
        source, prefix = projections.find(projection), projections.split_prefix(projection)[1]
        with replacing(folder / source.name) as temporary:
            shutil.copyfile(source, temporary)
        return f"{folder / source.name}{prefix and f'@{prefix}'}"

    return _with_projection(conf, copy)


def is_map(folder: Path) -> bool:
    """Return whether a folder is a map of `main`'s, finished or not, rather than a COLMAP model."""
    return any((folder / name).exists() for name in (FINISHED, FINGERPRINTS))
