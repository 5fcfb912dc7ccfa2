"""Localize one photo at a time in a map that is held in memory."""

import time
from pathlib import Path

import numpy as np
import pycolmap
import torch

from .. import aggregators, extractors, matchers
from ..localization import intrinsics, mirrored, query
from ..localization.confidence import DEFAULT_GATE, Gate
from ..localization.query import merged
from ..localize_sfm import RANSAC_THRESH
from ..pairs_from_retrieval import rank
from ..runtime import parallel
from ..utils.cli import InputError
from ..utils.codes import FLOATS, to_integers
from ..utils.feature_files import to_colmap
from .contents import read
from .map import RETRIEVAL


class Localizer:
    """Localizes photos in a map, with the poses of `pipelines.localize`.

    Photos are matched only with keypoints of map images that show a point: the others cannot help.

    Args:
        map_dir: the folder of a map from `maps.main` or `pipelines.localize`, or a file from
            `hloc_reduce.compact`.
        num_loc: the number of most similar map images that a photo is matched with.
        ransac_thresh: RANSAC inlier threshold in pixels.
        gate: what a pose must have to be trusted.

    Raises:
        InputError: if it is not a map.

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
    ):
        contents = read(Path(map_dir))
        self.num_loc, self.ransac_thresh = num_loc, ransac_thresh
        self.preprocessing, self.cameras = contents.preprocessing, contents.cameras
        # queries stay floats, rounded as in a feature file
        self.dtype = contents.storage if contents.storage in FLOATS else FLOATS[0]
        self.matcher = matchers.load(contents.matcher).eval()
        self.gate = gate.of_matches(contents.matcher, contents.dim)
        self.device = "cuda" if torch.cuda.is_available() else "cpu"
        coded = contents.storage not in FLOATS and self.matcher.takes_codes
        # a code is rounded much more than integers are, and they are faster
        self.as_integers = coded and self.device == "cpu"
        self.extractor = contents.extractor.eval().to(self.device)
        self.vlad = aggregators.load(RETRIEVAL["model"]).eval()
        self.vlad.vocabulary = contents.vocabulary
        self.reference, self.names = contents.reference, contents.names
        self.global_descriptors = contents.global_descriptors
        self.describe = lambda name: self._to_device(contents.describe(name))
        if not contents.on_demand:
            self.describe = {name: self.describe(name) for name in self.names}.__getitem__
        self.shown = {
            name: torch.from_numpy(rows).to(self.device) for name, rows in contents.shown.items()
        }

    def _to_device(self, descriptors: np.ndarray) -> torch.Tensor:
        """Return descriptors (N, D) as they are matched."""
        matched = to_integers(descriptors) if self.as_integers else descriptors
        return torch.from_numpy(matched).to(self.device)

    def localize(
        self, image: Path | str | np.ndarray, camera: pycolmap.Camera | None = None
    ) -> tuple[pycolmap.Rigid3d | None, dict]:
        """Localize a photo.

        Args:
            image: its file, or its pixels (H, W) or (H, W, 3) RGB, uint8.
            camera: its intrinsics; default: those of the map's camera if it took the photo, by its
                EXIF data, else from EXIF data or guessed, and estimated with the pose.

        Returns:
            The pose, camera from world, in the units of the map, or None if the photo cannot be
            localized, for the `reason` in info; and info as from `localization.query.localize`,
            with `points2D` (M, 2) in COLMAP's pixels, `retrieved`, names of map images, best first,
            `intrinsics`, "given" or their source (`intrinsics.infer`), and `seconds` by stage.

        Raises:
            InputError: if the image cannot be read, or the camera has another size.
        """
        image = image if isinstance(image, np.ndarray) else Path(image)
        seconds: dict[str, float] = {}
        start = time.perf_counter()

        def lap(stage: str) -> None:
            seconds[stage] = time.perf_counter() - start - sum(seconds.values())

        source, refinement = "given", {}
        if camera is None:
            camera, source = intrinsics.infer(image, self.cameras)
            refinement = intrinsics.REFINEMENTS[source]
        features = self._extract(image)
        width, height = map(int, features["image_size"])
        if (camera.width, camera.height) != (width, height):
            raise InputError(
                f"The camera has {camera.width}x{camera.height} pixels, the photo has "
                f"{width}x{height}."
            )
        lap("extraction")
        retrieved = self._retrieve(features["descriptors"])
        lap("retrieval")
        matches = self._match(features["descriptors"], retrieved)
        lap("matching")
        cam_from_world, info = self._estimate(features, matches, camera, refinement)
        lap("pose")
        if mirrored.is_doubtful(info["reason"] is None, info["agreement"], info["confidence"]):
            flipped = self._extract(image, flip=True)
            matches = self._match(flipped["descriptors"], retrieved)
            camera = mirrored.mirror(camera)
            _, other = self._estimate(flipped, matches, camera, refinement, thorough=False)
            info["reason"] = mirrored.refusal(info["confidence"], other["confidence"])
            lap("mirror_image")
        info |= {
            "points2D": features["keypoints"][info["keypoints"]],
            "retrieved": retrieved,
            "intrinsics": source,
            "seconds": seconds,
        }
        return cam_from_world if info["reason"] is None else None, info

    def _extract(self, image: Path | np.ndarray, flip: bool = False) -> dict:
        """Extract features as a feature file has them: keypoints (N, 2), descriptors (N, D)."""
        preprocessing = {**self.preprocessing, "mirrored": flip}
        features: dict = extractors.extract(self.extractor, image, preprocessing, self.device)
        rounded = features["descriptors"].T.astype(self.dtype)
        descriptors = torch.from_numpy(rounded.astype(np.float32, order="C"))
        keypoints = to_colmap(features["keypoints"])
        return {**features, "descriptors": descriptors, "keypoints": keypoints}

    def _estimate(
        self,
        features: dict,
        matches: dict[str, np.ndarray],
        camera: pycolmap.Camera,
        refinement: dict,
        thorough: bool = True,
    ) -> tuple[pycolmap.Rigid3d | None, dict]:
        """Estimate the pose of a photo from its matches, see `localization.query.localize`."""
        config = {"estimation": {"ransac": {"max_error": self.ransac_thresh}}}
        return query.localize(
            *(self.reference, features["keypoints"], camera, matches),
            merged(config, refinement),
            self.gate.of_photo(float(features["blur"])),
            thorough,
        )

    def _retrieve(self, descriptors: torch.Tensor) -> list[str]:
        """Return the names of the map images most similar to local descriptors (N, D)."""
        query = self.vlad({"descriptors": descriptors.T[None]})["global_descriptor"]
        query = query.half().float().numpy()  # rounded as in the map
        return [self.names[j] for j in rank(query, self.global_descriptors, self.num_loc)[0]]

    def _match(self, descriptors: torch.Tensor, names: list[str]) -> dict[str, np.ndarray]:
        """Match descriptors (N, D) with those of map images that show a point."""
        query = self._to_device(descriptors.numpy())

        def match(name: str) -> np.ndarray:
            described, shown = self.describe(name), self.shown[name]
            return self.matcher.match_rows(query, described, shown).cpu().numpy()

        return dict(zip(names, parallel.ordered("match", match, names), strict=True))
