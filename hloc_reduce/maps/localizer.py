"""Localize one photo at a time in a map that is held in memory."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pycolmap

from ..localization import gate as gates
from ..localization import intrinsics, mirrored, panoramas, query, rig_pose, stage, views
from ..localization.gate import DEFAULT_GATE, Gate
from ..localization.near import Guess, Surroundings
from ..localization.query import merged, ransac_options
from ..localization.records import nearness
from ..localization.views import View
from ..localize_sfm import RANSAC_THRESH
from ..runtime import parallel
from ..runtime.laps import Laps
from ..utils.cli import InputError
from ..utils.codes import FLOATS, restore, store
from ..utils.feature_files import to_colmap
from ..utils.images import read_image
from .contents import read
from .given import Image, Photo, check_pose, check_rig
from .tracker import Tracker


class _Query(NamedTuple):
    """A photo, its intrinsics and options, and how it is shown, with its features."""

    photo: Photo
    camera: pycolmap.Camera
    refinement: dict
    view: View
    features: dict


class Localizer:
    """Localizes photos in a map, with the poses of `pipelines.localize`.

    Photos are matched only with keypoints of map images that show a point: the others cannot help.

    Args:
        map_dir: the folder of a map from `maps.main` or `pipelines.localize`, or a file from
            `hloc_reduce.compact`, or several files of one place.
        num_loc: the number of most similar map images that a photo is matched with.
        ransac_thresh: RANSAC inlier threshold in pixels; larger in proportion in photos whose
            longer side exceeds 1,600 pixels.
        gate: what a pose must have to be trusted.
        onnx: with a file from `hloc_reduce.compact`, the ONNX file of its feature from
            `hloc_reduce.export`: features are extracted by ONNX Runtime instead of torch.
        matcher: one of `confs.matchers.names`; default: the map's.
        matcher_onnx: with `onnx`, the ONNX file of LightGlue from `hloc_reduce.export`, for a map
            or a `matcher` that needs it.

    Raises:
        InputError: if it is not a map, a matcher does not suit it, an ONNX file is of another
            feature, or a number is too small.

    Example:
        >>> localizer = Localizer("outputs/map")  # doctest: +SKIP
        >>> cam_from_world, info = localizer.localize("photo.jpg")  # doctest: +SKIP
    """

    def __init__(
        self,
        map_dir: Path | str | Sequence[Path | str],
        num_loc: int = 50,
        ransac_thresh: float = RANSAC_THRESH,
        gate: Gate = DEFAULT_GATE,
        onnx: Path | str | None = None,
        matcher: str | None = None,
        matcher_onnx: Path | str | None = None,
    ):
        if num_loc < 1:
            raise InputError(f"num_loc is {num_loc}: at least 1.")
        stage.check_threshold(ransac_thresh)
        feature_file, matcher_file = (
            None if path is None else Path(path) for path in (onnx, matcher_onnx)
        )
        if isinstance(map_dir, Path | str):
            path: Path | list[Path] = Path(map_dir)
        else:
            path = [Path(file) for file in map_dir]
        contents = read(path, feature_file, matcher, matcher_file)
        self.num_loc, self.ransac_thresh = num_loc, ransac_thresh
        self.workers = parallel.cores()
        self.preprocessing, self.cameras = contents.preprocessing, contents.cameras
        self.doubts, self.frame = contents.doubts, contents.frame
        # queries stay floats, rounded as in a feature file
        self.dtype = contents.storage if contents.storage in FLOATS else FLOATS[0]
        # the matchers that photos are tried with, and what each needs to trust a pose
        self.steps = [
            (step.match, gate.of_matches(step.matcher, contents.dim)) for step in contents.steps
        ]
        self.engine, self.reference = contents.engine, contents.reference
        self.names = contents.names
        self._surroundings = Surroundings(self.reference, self.names, contents.views)
        self._describe, self._find = contents.describe, contents.retrieve

    def localize(
        self,
        image: Image,
        camera: pycolmap.Camera | None = None,
        mask: Image | None = None,
        near: pycolmap.Rigid3d | None = None,
        radius: float | None = None,
    ) -> tuple[pycolmap.Rigid3d | None, dict]:
        """Localize a photo.

        Args:
            image: its file, or its pixels (H, W) or (H, W, 3) RGB, uint8. If the feature needs
                upright photos, pixels are taken to be upright, and a file whose EXIF data do not
                tell which side is up is tried all four ways.
            camera: its intrinsics; default: those of the map's camera if it took the photo, by its
                EXIF data; else from EXIF data or guessed, and estimated with the pose, or those of
                the map's photos if these fit a guess.
            mask: its file, or its pixels (H, W), bool or uint8, of the size of the photo as it is
                stored: keypoints where it is 0 are dropped; default: none are.
            near: about its pose, camera from world, as of a moment ago: the photo is matched with
                the map images that see the same instead of those that look alike. If it cannot be
                localized so, it is as without `near`.
            radius: how far off the position of `near` may be, in the units of the map; default: a
                fifth of the distance to what it sees. Its rotation may be off by 10 degrees.

        Returns:
            The pose, camera from world, in the units of the map, or None if the photo cannot be
            localized, for the `reason` in info; and info as from `localization.query.localize`,
            with `points2D` (M, 2) in COLMAP's pixels, `again`, whether its matches are those of a
            second matcher, `turned`, by how many degrees, counterclockwise, beyond what its EXIF
            data say, the photo had to be turned to look like the map's, `retrieved`, names of map
            images, best first, `near`, whether these are those about `near`, `intrinsics`, "given"
            or their source (`intrinsics.infer`), `map_doubts`, why the map, and the pose with it,
            may be wrong, in a few words each, `wgs84`, where on Earth the camera is and where it
            looks, see `frame.Frame.wgs84`, None without a pose or if the map does not know, and
            `seconds` by stage.

        Raises:
            UnreadableImage: if the image cannot be read.
            InputError: if the camera or the mask has another size, the mask is all 0, or `near` is
                far from the map.
        """
        photo = Photo.of(image, mask)
        laps, source, refinement = Laps(), "given", {}
        if camera is None:
            camera, source = intrinsics.infer(photo.image, self.cameras)
            refinement = intrinsics.refinement(camera, source, self.cameras)
        guess = None
        if near is not None:
            check_pose(near)
            self._surroundings.check(near)
            guess = self._surroundings.guess(near, radius, camera)
            laps.end("retrieval")
        best: tuple[pycolmap.Rigid3d | None, dict] | None = None
        for found in self._tries(photo, camera, refinement, laps, guess):
            if best is None or nearness(found[1]) > nearness(best[1]):
                best = found
            if best[1]["reason"] is None or source == "none":  # no other try helps
                break
        assert best is not None
        cam_from_world, info = best
        cam_from_world = cam_from_world if info["reason"] is None else None
        info |= {
            "intrinsics": source,
            "map_doubts": self.doubts,
            "wgs84": self.frame.wgs84(cam_from_world) if cam_from_world else None,
            "seconds": laps.seconds,
        }
        return cam_from_world, info

    def is_far(self, cam_from_world: pycolmap.Rigid3d) -> bool:
        """Tell whether a pose is so far from the map that `localize` refuses it as `near`."""
        return self._surroundings.is_far(cam_from_world)

    def track(self, camera: pycolmap.Camera | None = None, radius: float | None = None) -> Tracker:
        """Return what localizes the frames of a video near where the one before was.

        Args:
            camera: intrinsics of all frames; default: see `localize`.
            radius: see `localize`.
        """
        return Tracker(self.localize, self.is_far, camera, radius)

    def _tries(
        self,
        photo: Photo,
        camera: pycolmap.Camera,
        refinement: dict,
        laps: Laps,
        guess: Guess | None,
    ) -> Iterator[tuple[pycolmap.Rigid3d | None, dict]]:
        """Yield the pose and the info by each matcher, in each way that the photo may be shown.

        Args:
            photo: the photo.
            camera: its intrinsics.
            refinement: options of `localization.query.localize`.
            laps: times the stages.
            guess: of the pose: first, the photo is matched with its images.
        """
        for view in (views.USUAL, *self._other_views(photo.image)):
            features = self._described(photo, view, camera, laps)
            query = _Query(photo, camera, refinement, view, features)
            if guess and view == views.USUAL and len(guess.images):
                yield self._match(query, guess.images, 0, laps, guess)
            retrieved = self._retrieve(features, photo.image, view)
            laps.end("retrieval")
            for i in range(len(self.steps)):
                yield self._match(query, retrieved, i, laps)
            if not len(features["keypoints"]):
                return

    def _match(
        self, query: "_Query", names: list[str], step: int, laps: Laps, guess: Guess | None = None
    ) -> tuple[pycolmap.Rigid3d | None, dict]:
        """Localize a photo by a matcher and some map images.

        Args:
            query: the photo.
            names: the images, best first.
            step: index of the matcher.
            laps: times the stages.
            guess: of the pose.
        """
        (match, gate), features = self.steps[step], query.features
        matches = match(features, names)
        laps.end("matching")
        given = query.camera, query.refinement, gate
        cam_from_world, info = self._estimate(features, matches, *given, guess=guess)
        laps.end("pose")
        if info["reason"] is None and gates.may_be_mirrored(info["measures"], gate):
            flipped = self._extract(query.photo, query.view, flip=True)
            mirror = mirrored.mirror(query.camera), mirrored.mirror_options(query.refinement), gate
            _, other = self._estimate(flipped, match(flipped, names), *mirror, thorough=False)
            measures = replace(info["measures"], mirror_image=other["confidence"])
            info |= gates.verdict(measures, gate)
            laps.end("mirror_image")
        return cam_from_world, info | {
            "points2D": to_colmap(features["keypoints"][info["keypoints"]]),
            "retrieved": names,
            "near": guess is not None,
            "again": step > 0,
            "turned": 90 * query.view.turns,
        }

    def _described(
        self,
        photo: Photo,
        view: View,
        camera: pycolmap.Camera,
        laps: Laps,
        name: str = "The camera",
    ) -> dict:
        """Return the features of a photo; the name is that of the camera.

        Raises:
            InputError: if its camera has another size.
        """
        features = self._extract(photo, view)
        width, height = map(int, features["image_size"])
        if (camera.width, camera.height) != (width, height):
            raise InputError(
                f"{name} has {camera.width}x{camera.height} pixels, the photo has {width}x{height}."
            )
        laps.end("extraction")
        return features

    def localize_rig(
        self,
        images: Sequence[Image],
        cameras: Sequence[pycolmap.Camera],
        cams_from_rig: Sequence[pycolmap.Rigid3d],
        names: Sequence[str] = (),
        masks: Sequence[Image | None] = (),
    ) -> tuple[pycolmap.Rigid3d | None, dict]:
        """Localize photos that cameras which are fixed to each other took at one moment.

        Photos are matched one by one, and the matches of all give one pose. Unless it is certain,
        they are matched with the map images about it, too.

        Args:
            images: of each camera the file, or the pixels (H, W) or (H, W, 3) RGB, uint8; upright.
            cameras: their intrinsics.
            cams_from_rig: their poses in the rig, camera from rig, in the units of the map.
            names: of the cameras, for messages; default: camera 0, camera 1, and so on.
            masks: of each camera as for `localize`, None for a photo that is not masked.

        Returns:
            The pose, rig from world, in the units of the map, or None if the rig cannot be
            localized, for the `reason` in info; and info: `probability`, `confidence`, `agreement`,
            `num_inliers`, `num_correspondences`, `measures` and `again` of all cameras together, as
            from `localize`; the `covariance` (6, 6) of the pose, see `measures.rig_covariance`,
            None if it is not determined; `cameras`, a dict for each with its `num_matches`,
            `num_correspondences` and `num_inliers`, `points2D` (M, 2), `points3D` (M, 3) and
            `inliers` (M,) bool, and `retrieved`; `map_doubts`; `wgs84` of the rig, as from
            `localize`; and `seconds` by stage.

        Raises:
            UnreadableImage: if an image cannot be read.
            InputError: if there is no camera, there are not as many images, cameras and poses, or a
                camera or a mask has another size than its photo.
        """
        number = len(images)
        given = masks or [None] * number
        check_rig(images, cameras, cams_from_rig, names or [""] * number, given)
        laps, photos = Laps(), []
        named = names or [f"camera {i}" for i in range(number)]
        for image, mask, camera, name in zip(images, given, cameras, named, strict=True):
            photo = Photo.of(image, mask)
            features = self._described(photo, views.USUAL, camera, laps, name)
            photos.append((features, self._retrieve(features, photo.image, views.USUAL)))
            laps.end("retrieval")
        rig = [*zip(named, cameras, cams_from_rig, strict=True)]
        for again in range(len(self.steps)):
            pose, of_cameras = self._try_rig(photos, rig, self.steps[again], laps)
            if pose.refusal is None:
                break
        rig_from_world = pose.rig_from_world if pose.refusal is None else None
        info = {
            **gates.verdict(pose.measures, self.steps[again][1]),
            "reason": pose.refusal,
            "confidence": round(max(0.0, pose.measures.confidence), 2),
            "agreement": round(pose.measures.agreement, 3),
            "num_inliers": pose.measures.num_inliers,
            "num_correspondences": pose.measures.num_matches,
            "again": again > 0,
            "covariance": pose.covariance,
            "cameras": of_cameras,
            "map_doubts": self.doubts,
            "wgs84": rig_from_world and self.frame.wgs84(rig_from_world),
            "seconds": laps.seconds,
        }
        return rig_from_world, info

    def localize_panorama(
        self, image: Path | str | np.ndarray
    ) -> tuple[pycolmap.Rigid3d | None, dict]:
        """Localize a panorama of all directions, an equirectangular photo, by views of it.

        Args:
            image: its file, or its pixels (H, 2 H) or (H, 2 H, 3) RGB, uint8; upright. It is not
                masked.

        Returns:
            The pose of a camera that looks at the centre of the panorama, from world, and info of
            its views, both as from `localize_rig`; and their poses `cams_from_rig` in info.

        Raises:
            UnreadableImage: if the image cannot be read.
            InputError: if it is not twice as wide as high, or too small.
        """
        given = Photo.of(image, None).image
        pixels = given if isinstance(given, np.ndarray) else read_image(given)
        panoramas.check(pixels.shape)
        views = panoramas.views_of(pixels.shape[1::-1])
        names, cameras, cams_from_rig = zip(*views, strict=True)
        shown = panoramas.render(pixels, views)
        pose, info = self.localize_rig(shown, cameras, cams_from_rig, names)
        return pose, info | {"cams_from_rig": cams_from_rig}

    def _try_rig(
        self, photos: list[tuple[dict, list[str]]], rig: list[tuple], step: tuple, laps: Laps
    ) -> tuple[rig_pose.RigPose, list[dict]]:
        """Localize a rig by one matcher, and return the pose and the info of each camera.

        A camera in the dark may retrieve other places. So unless the pose is certain, each photo is
        matched with the map images about it, too, and the pose by all these matches is judged.

        Args:
            photos: of each camera the features, and the map images that are most similar.
            rig: of each camera its name, intrinsics and pose in the rig.
            step: what matches, and what a pose must have to be trusted.
            laps: times the stages.
        """
        match, gate = step
        matches = [match(features, retrieved) for features, retrieved in photos]
        laps.end("matching")
        found = self._estimate_rig(photos, matches, rig, gate)
        laps.end("pose")
        likely = found[0].rig_from_world
        if likely is None or not found[0].may_gain or self.is_far(likely):
            return found
        more: list[dict[str, np.ndarray]] = []
        for photo, known, (_, camera, cam_from_rig) in zip(photos, matches, rig, strict=True):
            near = self._surroundings.guess(cam_from_rig * likely, None, camera).images
            others = [name for name in near if name not in known]
            more.append({**known, **match(photo[0], others)} if others else known)
        laps.end("matching")
        if list(map(len, more)) == list(map(len, matches)):
            return found
        found = self._estimate_rig(photos, more, rig, gate)
        laps.end("pose")
        return found

    def _estimate_rig(
        self,
        photos: list[tuple[dict, list[str]]],
        matches: list[dict[str, np.ndarray]],
        rig: list[tuple],
        gate: Gate,
    ) -> tuple[rig_pose.RigPose, list[dict]]:
        """Estimate the pose of a rig from the matches of each camera, see `_try_rig`."""
        sights, infos = [], []
        for (features, _), found, (name, camera, pose) in zip(photos, matches, rig, strict=True):
            keypoints = to_colmap(features["keypoints"])
            given = found, ransac_options(self.ransac_thresh, camera), gate, name, camera, pose
            sight, info = rig_pose.sight(self.reference, keypoints, *given)
            sights.append(sight)
            del info["keypoints"]
            infos.append(info | {"points2D": sight.points2D, "retrieved": list(found)})
        pose = rig_pose.estimate(sights, gate)
        for info, inliers in zip(infos, pose.inliers, strict=True):
            info |= {"inliers": inliers, "num_inliers": int(inliers.sum())}
        return pose, infos

    def _other_views(self, image: Path | np.ndarray) -> list[View]:
        """Return the other ways to show a photo to the feature, if it needs them."""
        if self.engine.rotation_invariant:
            return []
        return views.others(image, self.cameras, self.preprocessing)

    def _extract(self, photo: Photo, view: View, flip: bool = False) -> dict:
        """Extract features, float32 and rounded as in a feature file, see `matchers.Matcher`."""
        shown = {**self.preprocessing, **view.how, "mirrored": flip}
        features = self.engine.extract(photo.image, shown, photo.kept)
        stored, _ = store({key: np.asarray(part) for key, part in features.items()}, self.dtype)
        rounded = {key: part.astype(np.float32) for key, part in stored.items()}
        return {**rounded, "descriptors": restore(stored, {}).T}

    @parallel.one_thread()
    def _estimate(
        self,
        features: dict,
        matches: dict[str, np.ndarray],
        camera: pycolmap.Camera,
        refinement: dict,
        gate: Gate,
        thorough: bool = True,
        guess: Guess | None = None,
    ) -> tuple[pycolmap.Rigid3d | None, dict]:
        """Estimate the pose of a photo from its matches, see `localization.query.localize`."""
        return query.localize(
            self.reference,
            to_colmap(features["keypoints"]),
            camera,
            matches,
            config=merged(ransac_options(self.ransac_thresh, camera), refinement),
            gate=gate,
            thorough=thorough,
            workers=self.workers,
            guess=guess,
        )

    @parallel.one_thread()
    def _retrieve(self, features: dict, image: Path | np.ndarray, view: View) -> list[str]:
        """Return the names of the map images that are most similar to a photo, best first."""
        return self._find(self._describe(features, image, view.turns), self.num_loc)
