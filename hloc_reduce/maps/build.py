"""Build a map from photos, with or without a model of their poses."""

import shutil
import uuid
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import pycolmap

from .. import (
    aggregate_features,
    extract_features,
    logger,
    match_features,
    pairs_from_covisibility,
    pairs_from_exhaustive,
    pairs_from_retrieval,
    pairs_from_verification,
    projections,
    reconstruction,
    triangulation,
)
from ..confs import features as features_confs
from ..confs import matchers as matchers_confs
from ..detectors.dog import KEYPOINTS
from ..extract_features import keep_present, keep_readable
from ..localization import intrinsics
from ..mapping import mapper, plausibility, registration
from ..runtime import provenance
from ..runtime.outputs import CONF, RunFolder
from ..utils import colmap
from ..utils.cli import InputError
from ..utils.codes import STORAGES
from ..utils.files import replacing
from ..utils.images import list_images
from ..utils.match_files import check_names
from ..utils.paths import strings_as_paths
from . import contradictions, cropping, precision
from .map import (
    FINGERPRINTS,
    FINISHED,
    FURTHER,
    MORE,
    OWN,
    PLACE,
    RETRIEVAL,
    SFM,
    Map,
    with_projection,
)

MAX_EXHAUSTIVE = 100  # photos without covisibility that are all paired with each other
ROUNDS = 3  # of additional pairs, in which larger sets of photos get connected


@strings_as_paths
def main(
    map_dir: Path,
    image_dir: Path,
    model: Path | None = None,
    feature: str = features_confs.RECOMMENDED,
    projection: Path | None = None,
    matcher: str | None = None,
    num_covis: int = 20,
    overwrite: bool = False,
    storage: str = STORAGES[0],
    keypoints: str = KEYPOINTS[0],
    accept_partial: bool = False,
    camera_mode: pycolmap.CameraMode = pycolmap.CameraMode.AUTO,
) -> Map:
    """Build a map, or open the one that was made from the same.

    Args:
        map_dir: the folder of the map.
        image_dir: folder of the images.
        model: COLMAP model with their poses; None to reconstruct them, in an arbitrary frame and
            scale.
        feature: as in `confs.features.get`, like `projection`, `storage` and `keypoints`.
        projection: see `feature`.
        matcher: a key of `confs.matchers`; default: the feature's.
        num_covis: each image is paired with this number of the most covisible ones in the model.
            Without points in the model, or without a model, up to `MAX_EXHAUSTIVE` images are all
            paired with each other, and of more each with the most similar ones; without a model,
            pairs are added where these leave images unconnected.
        overwrite: rebuild the map.
        storage: see `feature`.
        keypoints: see `feature`.
        accept_partial: do without images that are missing or unreadable; without a model, build a
            map even if fewer than half of the images are in it.
        camera_mode: which images share a camera, without a model.

    Returns:
        The map.

    Raises:
        InputError: if the folder has a map that was made from something else, something is missing
            or wrong, or fewer than half of the images can be reconstructed; what is finished is
            kept, for a run with `accept_partial`.
    """
    feature, conf = features_confs.get(feature, projection, storage, keypoints)
    matcher = matcher or features_confs.matcher_of(conf)
    reference = None if model is None else colmap.read_model(model)
    if reference is not None and not reference.images:
        raise InputError(f"The model {model} has no images.")
    names = _list(image_dir, reference, accept_partial)
    check_names(names)
    has_points = reference is not None and reference.num_points3D() > 0
    exhaustive = not has_points and len(names) <= MAX_EXHAUSTIVE
    if overwrite or not (map_dir / "conf.json").exists():
        extract_features.check_model(conf)
    fingerprints, found = _digests(map_dir, image_dir, names, model)
    made_from = {
        "feature": extract_features.provenance(conf),
        "matcher": matchers_confs.confs[matcher]["model"],
        "num_covis": num_covis,
        **found,
    }
    if exhaustive:
        made_from |= {"num_covis": None, "pairs": "exhaustive"}
    elif model is None:
        made_from |= {"pairs": f"retrieval, {ROUNDS} rounds of verification"}
    with claim(map_dir, made_from, overwrite, image_dir, model, projection) as folder:
        if not (map_dir / FINISHED).exists():
            begin(map_dir, fingerprints)
            building = _Building(
                *(folder, image_dir, names, matcher, num_covis, exhaustive),
                *(accept_partial, camera_mode),
            )
            return building.build(feature, conf, keypoints, model, reference)
        built = Map(map_dir)
        if built.camera_mode not in (None, camera_mode.name.lower()):
            raise InputError(
                f"The map {map_dir} was made with --camera_mode {built.camera_mode}: give it "
                "again, choose other --outputs, or --overwrite."
            )
        _drop_others(folder, built)  # a killed run may have left some
        built.warn()
        return built


def claim(map_dir: Path, made_from: dict, overwrite: bool, *inputs: Path | None) -> RunFolder:
    """Lock the folder of a map, whose unfinished map of something else is replaced.

    Args:
        map_dir: the folder.
        made_from: what the map is made from.
        overwrite: rebuild the map.
        inputs: files and folders that the map is made from, if given.
    """
    before = provenance.read(map_dir / CONF)
    if before and before != made_from and not (map_dir / FINISHED).exists():
        logger.info("Rebuilding the unfinished map %s.", map_dir)
        overwrite = True
    given = [path for path in inputs if path is not None]
    return RunFolder(map_dir, made_from, overwrite, given, kept=(PLACE, FINGERPRINTS))


def begin(map_dir: Path, fingerprints: dict[str, list]) -> None:
    """Write what a map has before it is built: the id of its place, and fingerprints."""
    if not (map_dir / PLACE).exists():
        with replacing(map_dir / PLACE) as temporary:
            temporary.write_text(uuid.uuid4().hex)
    provenance.write(map_dir / FINGERPRINTS, fingerprints)


def _list(
    image_dir: Path, reference: pycolmap.Reconstruction | None, accept_partial: bool
) -> list[str]:
    """List the images of a map: those of the model, or without it all images in a folder."""
    if reference is None:
        names = keep_present(image_dir, list_images(image_dir), accept_partial)
        if len(names) == 1:
            raise InputError(f"A map of photos alone needs two or more: {image_dir} has one.")
        return names
    names = sorted(image.name for image in reference.images.values())
    return list_images(image_dir, keep_present(image_dir, names, accept_partial))


def _digests(
    map_dir: Path, image_dir: Path, names: list[str], model: Path | None
) -> tuple[dict, dict[str, dict[str, str]]]:
    """Return the fingerprints of a map's images and model, and the digests of both by name."""
    groups = {
        "images": {name: image_dir / name for name in names},
        "model": {path.name: path for path in model_files(model)},
    }
    return digests(map_dir, groups)


def digests(
    map_dir: Path, groups: dict[str, dict[str, Path]]
) -> tuple[dict, dict[str, dict[str, str]]]:
    """Return the fingerprints of groups of files by name, and the digests of each group."""
    files = {f"{key}/{name}": file for key, part in groups.items() for name, file in part.items()}
    fingerprints = provenance.fingerprints(files, provenance.read(map_dir / FINGERPRINTS))
    return fingerprints, {
        key: {name: fingerprints[f"{key}/{name}"][2] for name in part}
        for key, part in groups.items()
    }


def model_files(model: Path | None) -> list[Path]:
    """Return the files of a COLMAP model, if any."""
    paths = sorted(model.iterdir()) if model else []
    return [path for path in paths if path.stem in triangulation.PARTS and path.is_file()]


@dataclass
class _Building:
    """A map that is being built; `names` loses images that cannot be read.

    `matches` are its match files by the names of their feature files.
    """

    folder: RunFolder
    image_dir: Path
    names: list[str]
    matcher: str
    num_covis: int
    exhaustive: bool
    accept_partial: bool
    camera_mode: pycolmap.CameraMode
    matches: dict[str, Path] = field(default_factory=dict)

    def build(
        self,
        feature: str,
        conf: dict,
        keypoints: str,
        model: Path | None,
        reference: pycolmap.Reconstruction | None,
    ) -> Map:
        """Build the map with the name and the configuration of a feature, and a model, if any."""
        logger.info("Building the map %s of %d images.", self.folder.path, len(self.names))
        conf = keep_projection(conf, self.folder.path)
        if model is not None and reference is not None:
            folder, sfm, fit = SFM, self._of_model(conf, model, reference), cropping.AS_ASSUMED
        else:
            folder, conf, sfm = self._of_photos_alone(conf)
            folder, sfm, fit = self._fitting(conf, folder, sfm)
            registration.check(self.folder.path / folder, self.accept_partial)
        with self.folder.stage("judge_poses"):
            contradicting = contradictions.find(sfm, self.matches[conf["output"]])
        uncertain = precision.find(sfm) if model is None else {}
        cameras = intrinsics.of_map(sfm, self.image_dir)
        summary = {
            "id": uuid.uuid4().hex,
            "feature": feature,
            "matcher": self.matcher,
            "image_dir": str(self.image_dir.resolve()),
            "model": str(model.resolve()) if model is not None else None,
            "camera_mode": self.camera_mode.name.lower() if model is None else None,
            "conf": with_projection(conf, lambda path: Path(path).name),
            "keypoints": keypoints,
            "sfm": folder,
            "images": len(self.names),
            "images_with_pose": sfm.num_reg_images(),
            "images_contradicting_others": contradicting,
            "images_of_uncertain_position": uncertain,
            "gain_of_free_principal_points": fit.gain,
            "images_altered": fit.altered,
            "points3D": sfm.num_points3D(),
            **intrinsics.to_dict(cameras),
            "seconds": self.folder.seconds(),
        }
        provenance.write(self.folder.path / FINISHED, summary)
        built = Map(self.folder.path)
        built.warn()
        _drop_others(self.folder, built)
        provenance.write(self.folder.path / FINISHED, {**summary, "bytes": self.folder.bytes()})
        return built

    def _of_model(
        self, conf: dict, model: Path, reference: pycolmap.Reconstruction
    ) -> pycolmap.Reconstruction:
        """Triangulate the map with the poses of a model."""
        features, descriptors = self._describe(conf)
        if len(self.names) < len(reference.images):
            model = colmap.write_part(model, set(self.names), self.folder.path / "sfm_reference")
        if reference.num_points3D():
            pairs = self.folder.path / f"pairs-db-{self.num_covis}.txt"
            with self.folder.stage("pairs"):
                pairs_from_covisibility.main(model, pairs, self.num_covis)
        else:
            pairs = self._pairs(descriptors)
        matches = self._match(pairs, features)
        with self.folder.stage("triangulation"):
            sfm = triangulation.main(
                self.folder.path / SFM, model, self.image_dir, pairs, features, matches
            )
        shutil.rmtree(self.folder.path / "sfm_reference", ignore_errors=True)
        return sfm

    def _of_photos_alone(self, conf: dict) -> tuple[str, dict, pycolmap.Reconstruction]:
        """Reconstruct poses and points; if photos are missing, again with more keypoints.

        Returns:
            The folder of the model with the most images, the configuration of its features, and
            the model.
        """
        adaptive = features_confs.keypoints_of(conf["model"]) == "adaptive"
        if not adaptive or len(self.names) > mapper.VERY_FEW:
            return SFM, conf, self._reconstruct(conf, SFM)
        model = features_confs.with_keypoints(conf["model"], "colmap")
        more = {**conf, "output": f"{conf['output']}{MORE}", "model": model}
        found: list[tuple[str, dict, pycolmap.Reconstruction]] = []

        def attempt(folder: str, conf: dict, once: bool = False) -> bool:
            """Return whether all photos are in the best model so far."""
            with suppress(registration.NoModelError):
                found.append((folder, conf, self._reconstruct(conf, folder, once)))
            found.sort(key=lambda one: plausibility.size(one[2]), reverse=True)
            registered = found[0][2].num_reg_images() if found else 0
            logger.info("%d of %d photos are in the map.", registered, len(self.names))
            return registered == len(self.names)

        if not attempt(SFM, conf, once=True):
            logger.info("Trying again with more keypoints.")
            attempt(f"{SFM}{MORE}", more)
            if not found or found[0][0] == SFM:
                attempt(f"{SFM}{FURTHER}", conf)
        if not found:
            raise registration.NoModelError(registration.nothing(self.image_dir))
        return found[0]

    def _fitting(
        self, conf: dict, folder: str, sfm: pycolmap.Reconstruction
    ) -> tuple[str, pycolmap.Reconstruction, cropping.Fit]:
        """Reconstruct again with a camera for each photo, if some do not fit to those they share.

        Args:
            conf: configuration of the features.
            folder: of the model.
            sfm: the model.

        Returns:
            The folder, the model and its fit: the new ones if they have as many photos, all of
            which fit.
        """
        fit = cropping.find(sfm)
        cameras = {sfm.images[i].camera_id for i in sfm.reg_image_ids()}
        is_shared = len(cameras) < sfm.num_reg_images()
        if not (fit.altered and is_shared and self.camera_mode == pycolmap.CameraMode.AUTO):
            return folder, sfm, fit
        logger.info("Trying again with a camera for each photo.")
        with suppress(registration.NoModelError):
            other, mode = f"{SFM}{OWN}", pycolmap.CameraMode.PER_IMAGE
            found = self._reconstruct(conf, other, camera_mode=mode)
            its_fit = cropping.find(found)
            if found.num_reg_images() >= sfm.num_reg_images() and its_fit.gain <= cropping.GAIN:
                return other, found, its_fit
        return folder, sfm, fit

    def _reconstruct(
        self,
        conf: dict,
        sfm: str,
        once: bool = False,
        camera_mode: pycolmap.CameraMode | None = None,
    ) -> pycolmap.Reconstruction:
        features, descriptors = self._describe(conf)
        pairs = self._pairs(descriptors)
        matches = self._match(pairs, features)
        for number in () if self.exhaustive else range(1, ROUNDS + 1):
            before, pairs = pairs, self.folder.path / f"pairs-db-{self.num_covis}-{number}.txt"
            with self.folder.stage("verification"):
                pairs_from_verification.main(
                    *(pairs, self.image_dir, before, features, matches, descriptors),
                    *(self.num_covis, self.num_covis if number == 1 else 0),
                    *(self.camera_mode, self.names),
                )
            self._match(pairs, features, matches)
        with self.folder.stage("reconstruction"):
            return reconstruction.main(
                *(self.folder.path / sfm, self.image_dir, pairs, features, matches),
                camera_mode=camera_mode or self.camera_mode,
                image_list=self.names,
                once=once,
                checked=False,
            )

    def _describe(self, conf: dict) -> tuple[Path, Path]:
        """Return the files of the features and of the global descriptors."""
        with self.folder.stage("extract_features"):
            features = extract_features.main(
                *(conf, self.image_dir, self.folder.path),
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
                pairs = self.folder.path / "pairs-db-exhaustive.txt"
                pairs_from_exhaustive.main(pairs, self.names)
            else:
                pairs = self.folder.path / f"pairs-db-{self.num_covis}.txt"
                pairs_from_retrieval.main(descriptors, pairs, self.num_covis)
        return pairs

    def _match(self, pairs: Path, features: Path, matches: Path | None = None) -> Path:
        conf = matchers_confs.confs[self.matcher]
        with self.folder.stage("match_map"):
            if matches is not None:
                matches = match_features.main(conf, pairs, features, matches=matches)
            else:
                matches = match_features.main(conf, pairs, features.stem, self.folder.path)
        self.matches[features.stem] = matches
        return matches


def _drop_others(folder: RunFolder, built: Map) -> None:
    """Delete the files of other attempts to build a map."""
    kept = built.features.stem
    plain = kept.removesuffix(MORE)
    for name in {plain, f"{plain}{MORE}"} - {kept}:
        begins = f"{name}.h5", f"{name}_matches", f"{RETRIEVAL['output']}_{name}."
        folder.delete(other for other in folder.written if other.startswith(begins))
    folder.delete({SFM, *(f"{SFM}{suffix}" for suffix in (MORE, FURTHER, OWN))} - {built.sfm.name})


def keep_projection(conf: dict, folder: Path) -> dict:
    """Copy the projection of a feature to a folder and return the configuration with the copy."""

    def copy(projection: str) -> str:
        source, prefix = projections.find(projection), projections.split_prefix(projection)[1]
        with replacing(folder / source.name) as temporary:
            shutil.copyfile(source, temporary)
        return f"{folder / source.name}{prefix and f'@{prefix}'}"

    return with_projection(conf, copy)
