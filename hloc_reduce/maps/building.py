"""The stages by which a map is built, with several attempts for photos without poses."""

import shutil
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
    reconstruction,
    triangulation,
)
from ..confs import features as features_confs
from ..confs import matchers as matchers_confs
from ..extract_features import keep_readable
from ..localization import exif, intrinsics
from ..mapping import mapper, plausibility, registration
from ..runtime import provenance
from ..runtime.outputs import RunFolder
from ..utils import cli, colmap
from ..utils.parsers import parse_pairs, parse_retrieval, write_pairs
from . import contradictions, cropping, mirrored_photos, misfits, precision
from .map import FINISHED, RETRIEVAL, SFM, Map, keep_projection, models, write

# suffixes of the models of later attempts
MORE = "-keypoints_colmap"  # also of its features
FURTHER = "-further"  # with the same keypoints as the first one
UNMIRRORED = "-unmirrored"  # without the mirrored photos of another attempt
ALIKE = "-alike"  # without photos whose intrinsics are unlike those of the others
OWN = "-per_image"  # with a camera for each photo
MIRRORED = "mirrored"  # folder of what is known of mirror images
ROUNDS = 3  # of additional pairs, in which larger sets of photos get connected


@dataclass
class Building:
    """A map that is being built; `names` loses images that cannot be read.

    If `exhaustive`, images without covisible ones are paired with all others.
    `matches` are its match files by the names of their feature files. `mirrored` and
    `unlike_others` are images that are left out; `names` has not those of another size.
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
    mirrored: list[str] = field(default_factory=list)
    unlike_others: list[str] = field(default_factory=list)

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
            folder, sfm, fit = SFM, self._of_model(conf, model, reference), cropping.NOT_TRIED
        else:
            self.unlike_others = exif.of_another_size(self.image_dir, self.names)
            self.names = self._kept
            folder, conf, sfm = self._of_photos_alone(conf)
            folder, sfm, fit = self._fitting(conf, folder, sfm)
        names = {sfm.images[i].name for i in sfm.reg_image_ids()}
        cameras = intrinsics.of_map(sfm, self.image_dir, names - {*fit.altered})
        if fit.gain > cropping.GAIN:
            cameras = cameras._replace(known={}, typical={})  # they may be wrong
        spread, fitting_badly, uncertain = 1.0, [], {}
        if model is None:
            with self.folder.stage("judge_matches"):
                verified = colmap.read_verified(self.folder.path / folder / "database.db")
                fitting_badly = misfits.find(sfm, verified)
                uncertain = precision.find(sfm)
            doubts = precision.doubts(uncertain, sfm, cameras.typical)
            spread = self._check(folder, sfm, fit, [*misfits.doubts(fitting_badly), *doubts])
        with self.folder.stage("judge_poses"):
            contradicting = contradictions.find(sfm, self.matches[conf["output"]])
        cropped = exif.cropped(self.image_dir, names) if model is None else []
        written = write(
            *(self.folder.path, conf, sfm, cameras),
            feature=feature,
            matcher=self.matcher,
            image_dir=str(self.image_dir.resolve()),
            model=str(model.resolve()) if model is not None else None,
            camera_mode=self.camera_mode.name.lower() if model is None else None,
            keypoints=keypoints,
            sfm=folder,
            images=len({*self.names, *self.unlike_others}),
            images_contradicting_others=contradicting,
            images_of_uncertain_position=uncertain,
            images_fitting_badly=fitting_badly,
            doubtful_focal_lengths=spread,
            gain_of_free_principal_points=fit.gain,
            images_altered=fit.altered,
            images_cropped=cropped,
            images_mirrored=self.mirrored,
            images_unlike_others=self.unlike_others,
            seconds=self.folder.seconds(),
        )
        built = Map(self.folder.path)
        built.warn()
        drop_others(self.folder, built)
        provenance.write(self.folder.path / FINISHED, written | {"bytes": self.folder.bytes()})
        return built

    def _check(
        self,
        folder: str,
        sfm: pycolmap.Reconstruction,
        fit: cropping.Fit,
        doubts: list[str],
    ) -> float:
        """Call `registration.check`, and name the photos that may be why the model is refused."""
        sfm_dir = self.folder.path / folder
        try:
            return registration.check(sfm_dir, self.accept_partial, self._left_out, doubts)
        except cli.InputError:
            names = {sfm.images[i].name for i in sfm.reg_image_ids()}
            cropping.warn(fit, self.unlike_others, exif.cropped(self.image_dir, names))
            mirrored_photos.warn(self.mirrored)
            raise

    def _of_model(
        self, conf: dict, model: Path, reference: pycolmap.Reconstruction
    ) -> pycolmap.Reconstruction:
        """Triangulate the map with the poses of a model."""
        features, descriptors = self._describe(conf)
        if len(self.names) < len(reference.images):
            model = colmap.write_part(model, set(self.names), self.folder.path / "sfm_reference")
            reference = colmap.read_model(model)
        pairs = self._pairs_of_model(reference, descriptors)
        matches = self._match(pairs, features)
        with self.folder.stage("triangulation"):
            sfm = triangulation.main(
                self.folder.path / SFM, model, self.image_dir, pairs, features, matches
            )
        shutil.rmtree(self.folder.path / "sfm_reference", ignore_errors=True)
        return sfm

    def _pairs_of_model(self, reference: pycolmap.Reconstruction, descriptors: Path) -> Path:
        """Pair covisible images, and those without any as if the model had no points."""
        others = dict(pairs_from_covisibility.covisible(reference, self.num_covis))
        alone = [name for name, seen in others.items() if not seen]
        if len(alone) == len(others):
            return self._pairs(descriptors)
        pairs = self.folder.path / f"pairs-db-{self.num_covis}.txt"
        with self.folder.stage("pairs"):
            if alone:
                logger.info(
                    "%d of %d photos share no point of the model with others, so they are paired "
                    "with %s: %s.",
                    *(len(alone), len(others)),
                    "all others" if self.exhaustive else "the most similar ones",
                    cli.some(alone),
                )
            if self.exhaustive:
                others |= {name: [other for other in others if other != name] for name in alone}
            elif alone:
                pairs_from_retrieval.main(
                    *(descriptors, pairs, self.num_covis), query_list=alone, db_list=[*others]
                )
                others |= parse_retrieval(pairs)
            number = write_pairs(((a, b) for a in others for b in others[a]), pairs)
        logger.info("Found %d pairs of %d images.", number, len(others))
        return pairs

    @property
    def _left_out(self) -> set[str]:
        return {*self.mirrored, *self.unlike_others}

    @property
    def _kept(self) -> list[str]:
        """The images that are not left out."""
        left_out = self._left_out
        return [name for name in self.names if name not in left_out]

    def _of_photos_alone(self, conf: dict) -> tuple[str, dict, pycolmap.Reconstruction]:
        """Reconstruct poses and points: also with more keypoints, and without mirrored photos.

        Returns:
            The folder of the model with the most images, the configuration of its features, and
            the model.
        """
        adaptive = features_confs.keypoints_of(conf["model"]) == "adaptive"
        several = adaptive and len(self.names) <= mapper.VERY_FEW
        found: list[tuple[str, dict, pycolmap.Reconstruction]] = []
        errors: list[registration.NoModelError] = []

        def attempt(folder: str, conf: dict, once: bool = False) -> bool:
            """Return whether all photos are in the best model so far."""
            try:
                found.append((folder, conf, self._reconstruct(conf, folder, once)))
            except registration.NoModelError as error:
                errors.append(error)
            found.sort(key=lambda one: plausibility.size(one[2]), reverse=True)
            registered = found[0][2].num_reg_images() if found else 0
            number = len(self._kept)
            logger.info("%d of %d photos are in the map.", registered, number)
            return registered == number

        if not attempt(SFM, conf, once=several) and several:
            logger.info("Trying again with more keypoints.")
            model = features_confs.with_keypoints(conf["model"], "colmap")
            more = {**conf, "output": f"{conf['output']}{MORE}", "model": model}
            attempt(f"{SFM}{MORE}", more)
            if not found or found[0][1] is conf:
                attempt(f"{SFM}{FURTHER}", conf)
        if found:
            folder, conf, sfm = found[0]
            self.mirrored = self._find_mirrored(conf, sfm)
            if self.mirrored:
                named = cli.some(self.mirrored)
                logger.info("Trying again without mirrored photos: %s.", named)
                found.clear()
                attempt(f"{folder}{UNMIRRORED}", conf)
        if not found:
            cropping.warn(cropping.NOT_TRIED, self.unlike_others)
            mirrored_photos.warn(self.mirrored)
            raise errors[-1]
        return found[0]

    def _find_mirrored(self, conf: dict, sfm: pycolmap.Reconstruction) -> list[str]:
        features, descriptors = self._describe(conf)
        with self.folder.stage("mirror_images"):
            return mirrored_photos.find(
                *(sfm, self._kept, conf, self.matcher, self.image_dir),
                *(features, descriptors, self.folder.path / MIRRORED),
            )

    def _fitting(
        self, conf: dict, folder: str, sfm: pycolmap.Reconstruction
    ) -> tuple[str, pycolmap.Reconstruction, cropping.Fit]:
        """Reconstruct again if the photos do not fit.

        First with a camera for each photo, if they share some; then without the fewer than half
        whose intrinsics are unlike those of the others.

        Args:
            conf: configuration of the features.
            folder: of the model.
            sfm: the model.

        Returns:
            The folder, the model and its fit: the new ones if they have all other photos, which
            fit.
        """
        fit = self._fit(sfm)
        cameras = {sfm.images[i].camera_id for i in sfm.reg_image_ids()}
        is_shared = len(cameras) < sfm.num_reg_images()
        auto = self.camera_mode == pycolmap.CameraMode.AUTO

        def attempt(
            suffix: str, camera_mode: pycolmap.CameraMode
        ) -> tuple[str, pycolmap.Reconstruction, cropping.Fit] | None:
            with suppress(registration.NoModelError):
                found = self._reconstruct(conf, f"{SFM}{suffix}", camera_mode=camera_mode)
                its_fit = self._fit(found)
                fits = its_fit is not cropping.NOT_TRIED and its_fit.gain <= cropping.GAIN
                wanted = {sfm.images[i].name for i in sfm.reg_image_ids()} & {*self._kept}
                if fits and found.num_reg_images() >= len(wanted):
                    return f"{SFM}{suffix}", found, its_fit
            return None

        if fit.gain > cropping.GAIN and is_shared and auto:
            logger.info("Trying again with a camera for each photo.")
            if found := attempt(OWN, pycolmap.CameraMode.PER_IMAGE):
                return found
        if 0 < 2 * len(fit.altered) < sfm.num_reg_images():
            logger.info("Trying again without %s.", cli.some(fit.altered))
            before = self.unlike_others
            self.unlike_others = sorted([*before, *fit.altered])
            if found := attempt(ALIKE, self.camera_mode):
                return found
            self.unlike_others = before
        return folder, sfm, fit

    def _fit(self, sfm: pycolmap.Reconstruction) -> cropping.Fit:
        with self.folder.stage("judge_intrinsics"):
            return cropping.find(sfm)

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
        names = self._kept
        if len(names) < len(self.names):
            kept = [pair for pair in parse_pairs(pairs) if {*pair} <= {*names}]
            pairs = self.folder.path / f"{pairs.stem}{sfm.removeprefix(SFM)}-kept.txt"
            write_pairs(kept, pairs)
        with self.folder.stage("reconstruction"):
            return reconstruction.main(
                *(self.folder.path / sfm, self.image_dir, pairs, features, matches),
                camera_mode=camera_mode or self.camera_mode,
                image_list=names,
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
            name = f"{features.stem}_{conf['output']}_{pairs.stem}.h5"
            matches = matches or self.folder.path / name
            match_features.main(conf, pairs, features, matches=matches)
        self.matches[features.stem] = matches
        return matches


def drop_others(folder: RunFolder, built: Map) -> None:
    """Delete the files of other attempts to build a map."""
    kept = built.features.stem
    plain = kept.removesuffix(MORE)
    for name in {plain, f"{plain}{MORE}"} - {kept}:
        begins = f"{name}.h5", f"{name}_matches", f"{RETRIEVAL['output']}_{name}."
        folder.delete(other for other in folder.written if other.startswith(begins))
    folder.delete({MIRRORED, *models(folder.written)} - {built.sfm.name})
