"""Localize one photo at a time in a map that is held in memory."""

import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap

from ..localization import gate as gates
from ..localization import intrinsics, mirrored, query, stage, views
from ..localization.gate import DEFAULT_GATE, Gate
from ..localization.query import merged, ransac_options
from ..localize_sfm import RANSAC_THRESH
from ..retrieval.ranking import rank
from ..runtime import parallel
from ..utils.cli import InputError
from ..utils.codes import FLOATS, restore, store
from ..utils.feature_files import to_colmap
from .contents import read


class Localizer:
    """Localizes photos in a map, with the poses of `pipelines.localize`.

    Photos are matched only with keypoints of map images that show a point: the others cannot help.

    Args:
        map_dir: the folder of a map from `maps.main` or `pipelines.localize`, or a file from
            `hloc_reduce.compact`.
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
        map_dir: Path | str,
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
        contents = read(Path(map_dir), feature_file, matcher, matcher_file)
        self.num_loc, self.ransac_thresh = num_loc, ransac_thresh
        self.workers = parallel.cores()
        self.preprocessing, self.cameras = contents.preprocessing, contents.cameras
        self.doubts = contents.doubts
        # queries stay floats, rounded as in a feature file
        self.dtype = contents.storage if contents.storage in FLOATS else FLOATS[0]
        # the matchers that photos are tried with, and what each needs to trust a pose
        self.steps = [
            (step.match, gate.of_matches(step.matcher, contents.dim)) for step in contents.steps
        ]
        self.engine, self.reference = contents.engine, contents.reference
        self.names = contents.names
        self._describe, self._similarity = contents.describe, contents.similarity

    def localize(
        self, image: Path | str | np.ndarray, camera: pycolmap.Camera | None = None
    ) -> tuple[pycolmap.Rigid3d | None, dict]:
        """Localize a photo.

        Args:
            image: its file, or its pixels (H, W) or (H, W, 3) RGB, uint8. If the feature needs
                upright photos, pixels are taken to be upright, and a file whose EXIF data do not
                tell which side is up is tried all four ways.
            camera: its intrinsics; default: those of the map's camera if it took the photo, by its
                EXIF data; else from EXIF data or guessed, and estimated with the pose, or those of
                the map's photos if these fit a guess.

        Returns:
            The pose, camera from world, in the units of the map, or None if the photo cannot be
            localized, for the `reason` in info; and info as from `localization.query.localize`,
            with `points2D` (M, 2) in COLMAP's pixels, `again`, whether its matches are those of a
            second matcher, `turned`, by how many degrees, counterclockwise, the photo had to be
            turned to look like the map's, `retrieved`, names of map images, best first,
            `intrinsics`, "given" or their source (`intrinsics.infer`), `map_doubts`, why the map,
            and the pose with it, may be wrong, in a few words each, and `seconds` by stage.

        Raises:
            UnreadableImage: if the image cannot be read.
            InputError: if the camera has another size.
        """
        image = image if isinstance(image, np.ndarray) else Path(image)
        source, refinement = "given", {}
        if camera is None:
            camera, source = intrinsics.infer(image, self.cameras)
            refinement = intrinsics.refinement(camera, source, self.cameras)
        seconds: dict[str, float] = {}
        best: tuple[pycolmap.Rigid3d | None, dict] | None = None
        for found in self._tries(image, camera, refinement, seconds):
            if best is None or _quality(found[1]) > _quality(best[1]):
                best = found
            if best[1]["reason"] is None or source == "none":  # no other try helps
                break
        assert best is not None
        cam_from_world, info = best
        info |= {"intrinsics": source, "map_doubts": self.doubts, "seconds": seconds}
        return cam_from_world if info["reason"] is None else None, info

    def _tries(
        self,
        image: Path | np.ndarray,
        camera: pycolmap.Camera,
        refinement: dict,
        seconds: dict[str, float],
    ) -> Iterator[tuple[pycolmap.Rigid3d | None, dict]]:
        """Localize a photo by each matcher, and as it looks turned, and yield each pose and info.

        Args:
            image: its file or pixels.
            camera: its intrinsics.
            refinement: options of `localization.query.localize`.
            seconds: those of each stage, which are added to.
        """
        start = time.perf_counter() - sum(seconds.values())

        def lap(stage: str) -> None:
            now = time.perf_counter() - start - sum(seconds.values())
            seconds[stage] = seconds.get(stage, 0.0) + now

        for turns in (0, *self._other_turns(image)):
            features = self._extract(image, turns)
            width, height = map(int, features["image_size"])
            if (camera.width, camera.height) != (width, height):
                raise InputError(
                    f"The camera has {camera.width}x{camera.height} pixels, the photo has "
                    f"{width}x{height}."
                )
            lap("extraction")
            retrieved = self._retrieve(features, image, turns)
            lap("retrieval")
            for i, (match, gate) in enumerate(self.steps):
                matches = match(features, retrieved)
                lap("matching")
                cam_from_world, info = self._estimate(features, matches, camera, refinement, gate)
                lap("pose")
                if info["reason"] is None and gates.may_be_mirrored(info["measures"], gate):
                    flipped = self._extract(image, turns, flip=True)
                    given = mirrored.mirror(camera), mirrored.mirror_options(refinement), gate
                    matches = match(flipped, retrieved)
                    _, other = self._estimate(flipped, matches, *given, thorough=False)
                    measures = replace(info["measures"], mirror_image=other["confidence"])
                    info |= gates.verdict(measures, gate)
                    lap("mirror_image")
                info |= {
                    "points2D": to_colmap(features["keypoints"][info["keypoints"]]),
                    "retrieved": retrieved,
                    "again": i > 0,
                    "turned": 90 * turns,
                }
                yield cam_from_world, info
            if not len(features["keypoints"]):
                return

    def _other_turns(self, image: Path | np.ndarray) -> tuple[int, ...]:
        """Return the other ways to show a photo to the feature, see `views.other_turns`."""
        if isinstance(image, np.ndarray) or self.engine.rotation_invariant:
            return ()
        return views.other_turns(image, self.cameras, self.preprocessing)

    def _extract(self, image: Path | np.ndarray, turns: int = 0, flip: bool = False) -> dict:
        """Extract features, float32 and rounded as in a feature file, see `matchers.Matcher`."""
        shown = {**self.preprocessing, "turns": turns, "mirrored": flip}
        features = self.engine.extract(image, shown)
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
        )

    @parallel.one_thread()
    def _retrieve(self, features: dict, image: Path | np.ndarray, turns: int) -> list[str]:
        """Return the names of the map images that are most similar to a photo, best first."""
        query = self._describe(features, image, turns)
        return [self.names[j] for j in rank(self._similarity(query)[None], self.num_loc)[0]]


def _quality(info: dict) -> tuple[bool, float]:
    return info["reason"] is None, info["confidence"]
