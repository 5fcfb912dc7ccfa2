"""ONNX files of `hloc_reduce.export`, run by ONNX Runtime."""

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..utils.cli import InputError
from .matching import Features

Content = tuple[Any, dict[str, str]]  # a session, and the metadata of its file


def read(path: Path, kind: str, keys: Sequence[str]) -> Content:
    """Read a file.

    Args:
        path: the file.
        kind: what it must be, such as "feature".
        keys: of the metadata that tell that it is.

    Raises:
        InputError: when ONNX Runtime is not installed, or the file is missing, broken or of another
            kind.
    """
    try:
        import onnxruntime
    except ImportError:
        raise InputError("ONNX files need: pip install onnxruntime.") from None
    if not path.is_file():
        raise InputError(f"There is no file {path}.")
    try:
        session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
        metadata = session.get_modelmeta().custom_metadata_map
        return session, {**metadata, **{key: metadata[key] for key in keys}}
    except Exception as error:  # ONNX Runtime raises RuntimeError and others of its own
        reason = str(error).splitlines()[0][:200]
        raise InputError(f"{path} is not a {kind} of hloc_reduce.export ({reason}).") from None


class OnnxLightGlue:
    """LightGlue for one feature that `hloc_reduce.export --matcher` wrote.

    Args:
        path: the ONNX file.
        feature: the name of the feature that it must be for.
        projection: the content of the file of its projection, None without one.
        max_keypoints: the number of keypoints of an image that are matched, the first ones.

    Raises:
        InputError: when ONNX Runtime is not installed, or the file is broken or for another
            feature.
    """

    feature_keys: tuple[str, ...] = ("keypoints", "descriptors", "image_size")
    takes_codes = False

    def __init__(
        self, path: Path, feature: str, projection: bytes | None, max_keypoints: int | None
    ):
        self._session, metadata = read(path, "matcher", ("matcher", "feature", "made_from"))
        if metadata["feature"] != feature:
            raise InputError(f"{path} matches {metadata['feature']}, the map has {feature}.")
        made_from = json.loads(metadata["made_from"])
        known = made_from.get("projection_sha256")
        if projection is not None and known != hashlib.sha256(projection).hexdigest():
            raise InputError(f"{path} is for another projection {feature} than that of the map.")
        self._number = max_keypoints

    def prepare(self, features: Features) -> dict[str, np.ndarray]:
        """Return the features of an image as `match` takes them."""
        return {
            "keypoints": features["keypoints"][: self._number],
            "descriptors": np.ascontiguousarray(features["descriptors"].T[: self._number]),
            "image_size": np.asarray(features["image_size"]),
        }

    def match(self, query: dict, image: dict, rows: np.ndarray) -> np.ndarray:
        """Match a photo with some keypoints of a map image, see `Matching.match`."""
        if not (len(query["keypoints"]) and len(image["keypoints"])):
            return np.zeros((0, 2), np.int64)
        given = {f"{key}{i}": one[key] for i, one in enumerate((query, image)) for key in one}
        matches, scores = self._session.run(["matches0", "matching_scores0"], given)
        kept = np.flatnonzero(np.isin(matches, rows))
        # as float16, as a match file has them
        kept = kept[np.argsort(-scores[kept].astype(np.float16), kind="stable")]
        return np.stack([kept, matches[kept]], axis=1)

    def match_points(
        self, query: dict, descriptors: np.ndarray, images: Sequence[tuple[np.ndarray, Features]]
    ) -> list[np.ndarray]:
        """Match a photo with images that share descriptors, see `Matching.match_points`."""
        return [
            self.match(
                query,
                self.prepare({**others, "descriptors": descriptors[rows].T}),
                np.arange(len(rows)),
            )
            for rows, others in images
        ]
