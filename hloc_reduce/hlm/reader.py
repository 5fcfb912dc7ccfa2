"""Compact maps: one file with all that localization needs. docs/map-format.md describes it."""

import json
import re
from collections.abc import Iterable, Mapping
from pathlib import Path, PurePath
from typing import Any

import numpy as np
import pycolmap

from .. import projections
from ..confs import features as features_confs
from ..confs import matchers as matchers_confs
from ..confs import retrieval as retrieval_confs
from ..localization import intrinsics
from ..localization.frame import Frame
from ..localization.projection import reprojection_errors
from ..projections.layers import Layer
from ..projections.layers import read as read_layers
from ..retrieval.vlad import VOCABULARY, read_vocabulary
from ..utils.cli import InputError, choose, naming
from ..utils.codes import CODED, FLOATS, QUANTIZED, STORAGES, check_levels, restore
from ..utils.feature_files import upright
from ..utils.files import file_sha256, replacing
from ..utils.images import TURNS
from ..utils.parsers import check_names
from . import points as points_of_map
from . import signs

VERSION = 2
VERSION_RETRIEVAL = 3  # of files whose global descriptors are not VLAD's
# that are read; in the first one, all coordinates have the same bits
VERSIONS = 1, VERSION, VERSION_RETRIEVAL
SUFFIX = ".hlm"
FEATURES = "keypoints", "descriptors", "image_size"  # of an image, see `matchers.base.Matcher`
# what a file may ask for
MAX_DIM, MAX_GLOBAL, MAX_SIDE, LEAST_OCTAVE = 512, 2**14, 4096, -1
PROJECTION = re.compile(r"[\w+-]+(@\d+)?")  # a name, and a prefix of a nested one


class CompactMap:
    """A compact map, as a `localization.references.Reference`: its images show points.

    Args:
        path: the file.

    Attributes:
        feature: name of the feature.
        conf: its configuration.
        storage: of the points' descriptors.
        matcher: a key of `confs.matchers`.
        retrieval: a key of `confs.retrieval`.
        cameras: what the map tells about the intrinsics of other photos.
        frame: its unit, and where on Earth it is.
        camera_number, camera_of: the number of each image's camera, and its intrinsics.
        names: the images, sorted.
        points: the coordinates.
        vocabulary: (W, D) float32, of the global descriptors; None if they have none.
        dim: dimension of the descriptors.
        projection: content of the file of the projection, None without one.

    Raises:
        InputError: when the file is missing, broken or of another version.
    """

    def __init__(self, path: Path):
        from safetensors import SafetensorError, safe_open

        self.path = path
        try:
            with safe_open(path, "np") as file:
                tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
                metadata = json.loads((file.metadata() or {})["map"])
            if metadata["version"] not in VERSIONS:
                raise InputError(
                    f"{path} is a compact map of version {metadata['version']}, not "
                    f"{' or '.join(map(str, VERSIONS[1:]))}."
                )
            if metadata["version"] == 1:
                metadata["bits"] = 3 * [metadata["bits"]]
            with naming(path):
                self._read(metadata, tensors)
        except FileNotFoundError:
            raise InputError(f"There is no map {path}.") from None
        except InputError:
            raise
        except (
            OSError,
            SafetensorError,
            KeyError,
            ValueError,
            TypeError,
            IndexError,
            RecursionError,
            OverflowError,
            AttributeError,
            RuntimeError,
        ) as error:
            said = str(error).splitlines()[0][:200] if str(error) else type(error).__name__
            raise InputError(f"{path} is not a compact map, or broken ({said}).") from None

    def _read(self, metadata: dict, tensors: Mapping[str, np.ndarray]) -> None:
        names = _array(tensors, "names", np.uint8, (None,)).tobytes().decode().split("\n")
        self.names, number = check_names(names, self.path), int(metadata["points"])
        folders = {str(folder) for name in names for folder in PurePath(name).parents}
        if len(set(names)) != len(names) or folders & set(names):
            raise ValueError("images of the same name, or an image in another one")
        count = len(names)
        self._rotations = _array(tensors, "rotations", np.float32, (count, 4))
        self._translations = _array(tensors, "translations", np.float64, (count, 3))
        cameras = [intrinsics.from_list(values) for values in metadata["cameras"]]
        used = _array(tensors, "camera_of_image", np.uint32, (count,))
        self.camera_number = dict(zip(names, used.tolist(), strict=True))
        self.camera_of = {name: cameras[i] for name, i in self.camera_number.items()}
        bits, step = [int(number) for number in metadata["bits"]], float(metadata["step"])
        least = np.array(metadata["least"], np.float64)
        coordinates = _array(tensors, "coordinates", np.uint8, (None,))
        self.points = points_of_map.Coordinates(coordinates, number, least, step, bits)
        counts = _array(tensors, "num_visible", np.uint32, (count,)).astype(np.int64)
        packed = _array(tensors, "visible", np.uint8, (None,))
        self._visible = points_of_map.Visible(packed, metadata["visible"], counts, number)
        self._rows = {name: row for row, name in enumerate(names)}
        self._read_descriptors(metadata, tensors)
        self._read_feature(metadata)
        self._read_projection(metadata, tensors)
        self._read_retrieval(metadata, tensors)
        norms = np.linalg.norm(self._rotations.astype(np.float64), axis=1)
        finite = np.isfinite(norms).all() and np.isfinite(self._translations).all()
        if not (finite and norms.min() > 0):
            raise ValueError("numbers that are not finite")

    def _read_descriptors(self, metadata: dict, tensors: Mapping[str, np.ndarray]) -> None:
        self.storage = choose("storage", metadata["storage"], STORAGES)
        kind = np.dtype(self.storage) if self.storage in FLOATS else np.uint8
        found = _array(tensors, "descriptors", kind, (None, len(self.points)))
        self._key = QUANTIZED.get(self.storage, "descriptors")
        self._attrs: dict[str, Any] = {}
        self._descriptors = found
        if self.storage in CODED:
            self._attrs["levels"] = check_levels(tensors["levels"], self.storage, len(found))
        elif self.storage not in FLOATS:
            scale, offset = map(float, metadata["scale"])
            self._attrs |= {"scale": scale, "offset": offset}
        self.dim = len(self._attrs.get("levels", found))
        numbers = found if self.storage in FLOATS else np.array(metadata["scale"], float)
        if not (0 < self.dim <= MAX_DIM and np.isfinite(numbers).all()):
            raise ValueError(f"descriptors of {self.dim} numbers, or not finite")

    def _read_feature(self, metadata: dict) -> None:
        self.feature = PurePath(metadata["feature"]).name
        check_names([self.feature], self.path)
        conf = features_confs.check(metadata["conf"], self.path)
        check_model(conf["model"], self.feature)
        if not 0 < (conf["preprocessing"]["resize_max"] or MAX_SIDE) <= MAX_SIDE:
            raise ValueError(f"photos of more than {MAX_SIDE} pixels")
        self.conf: dict[str, Any] = {
            "output": f"feats-{self.feature}",
            **conf,
            "storage": self.storage,
        }
        self.matcher = choose("matcher", metadata["matcher"], matchers_confs.confs)
        self.doubts = [str(doubt) for doubt in metadata.get("doubts", [])]
        self.frame = Frame.from_json(metadata.get("frame"))
        sizes = {(int(width), int(height)) for width, height in metadata["sizes"]}
        known = metadata["known"].items()
        models, focal = {str(m) for m in metadata["models"]}, metadata.get("focal_lengths")
        typical = intrinsics.from_rows(metadata.get("typical", []))
        orientations = {int(one) for one in metadata.get("orientations", [])}
        told = intrinsics.MapCameras(
            {str(name): intrinsics.from_list(values) for name, values in known},
            sizes,
            models,
            intrinsics.to_range(focal),
            typical,
            orientations,
        )
        self.cameras = intrinsics.with_lenses(told, self.camera_of.values())
        turns = {TURNS.get(one, 0) for one in orientations}
        is_upright = self.conf["preprocessing"].get("upright") and len(turns) == 1
        self._turns = turns.pop() if is_upright else 0

    def _read_projection(self, metadata: dict, tensors: Mapping[str, np.ndarray]) -> None:
        self.projection: bytes | None = None
        projection = self.conf["model"].get("projection")
        if projection is None:
            return
        if not PROJECTION.fullmatch(projection):
            raise ValueError(f"the projection {projection!r}")
        self._suffix = metadata["projection_suffix"]
        if self._suffix not in (".safetensors", ".pth"):
            raise ValueError(f"a projection of type {self._suffix!r}")
        if "projection" in tensors:
            self.projection = tensors["projection"].tobytes()
            return
        if projections.checksum(projection) != metadata["projection_sha256"]:
            raise InputError(f"{self.path} needs another {projection} than the one that ships.")
        self.projection = projections.find(projection).read_bytes()

    def _read_retrieval(self, metadata: dict, tensors: Mapping[str, np.ndarray]) -> None:
        self.retrieval = str(metadata.get("retrieval", retrieval_confs.VLAD))
        retrieval_confs.get(self.retrieval)
        self.vocabulary: np.ndarray | None = None
        if "vocabulary" in tensors:
            found = _array(tensors, "vocabulary", np.float16, (None, self.dim))
            self.vocabulary = found.astype(np.float32)
        elif self.retrieval == retrieval_confs.VLAD or "vocabulary_sha256" in metadata:
            self.vocabulary = read_vocabulary()
            if metadata.get("vocabulary_sha256") not in (None, file_sha256(VOCABULARY)):
                raise InputError(f"{self.path} needs another vocabulary than the one that ships.")
        number, size = int(metadata.get("global_dim", 0)), int(metadata["signs"])
        if self.vocabulary is not None:
            if self.vocabulary.shape[1] != self.dim or not np.isfinite(self.vocabulary).all():
                raise ValueError(f"a vocabulary of shape {self.vocabulary.shape}, or not finite")
            number = number or self.vocabulary.size
        if not 0 < number <= MAX_GLOBAL or size != signs.count(number):
            raise ValueError(f"{size} signs of global descriptors of {number} numbers")
        packed = _array(tensors, "retrieval", np.uint8, (len(self.names), -(-size // 8)))
        self._retrieval = signs.Signs(packed, number)

    def global_descriptors(self) -> np.ndarray:
        """Return those of the images (I, G) float32 as their signs tell them.

        Norms are 1, or 0 for images without points.
        """
        found = self._retrieval.descriptors()
        found[self._visible.counts == 0] = 0
        return found

    def similarity(self, descriptor: np.ndarray) -> np.ndarray:
        """Return the similarity (I,) of a global descriptor (G,) to those of the images.

        It is -inf for images without points.
        """
        found = self._retrieval.similarity(descriptor)
        found[self._visible.counts == 0] = -np.inf
        return found

    @property
    def is_pickled(self) -> bool:
        """Whether the projection is in a format that only torch reads."""
        return self.projection is not None and self._suffix == ".pth"

    def layers(self) -> list[Layer] | None:
        """Return the layers of the projection, None without one.

        Raises:
            InputError: when it is broken.
        """
        if self.projection is None:
            return None
        prefix = projections.split_prefix(self.conf["model"]["projection"])[1]
        try:
            return read_layers(self.projection, prefix)
        except ValueError as error:
            raise InputError(f"{self.path}: its projection is broken ({error}).") from None

    def write_projection(self, folder: Path) -> dict:
        """Write the projection into a folder; return the configuration of the feature with it."""
        if self.projection is None:
            return self.conf
        name, prefix = projections.split_prefix(self.conf["model"]["projection"])
        file = folder / f"{name}{self._suffix}"
        with replacing(file) as temporary:
            temporary.write_bytes(self.projection)
        projection = f"{file}{prefix and f'@{prefix}'}"
        return {**self.conf, "model": {**self.conf["model"], "projection": projection}}

    def stored(self, name: str) -> tuple[dict[str, np.ndarray], dict[str, dict]]:
        """Return the descriptors of the points that an image shows, as a feature file has them."""
        return self._stored(self.visible(name))

    def _stored(self, points: np.ndarray) -> tuple[dict[str, np.ndarray], dict[str, dict]]:
        return {self._key: self._descriptors[:, points]}, {self._key: self._attrs}

    def descriptors(self, points: np.ndarray, unbiased: bool = False) -> np.ndarray:
        """Return the descriptors (K, D) float32 of points (K,), see `codes.restore`."""
        return restore(*self._stored(points), unbiased)

    def visible(self, name: str) -> np.ndarray:
        """Return the points (M,) int64 that an image shows, ascending."""
        return self._visible[self._rows[name]]

    def pose(self, name: str) -> pycolmap.Rigid3d:
        """Return the pose of an image, camera from world."""
        i = self._rows[name]
        return pycolmap.Rigid3d(rotation_of(self._rotations[i]), self._translations[i])

    def __contains__(self, name: str) -> bool:
        return name in self._rows

    def num_keypoints(self, name: str) -> int:
        """Return the number of points that an image shows: these are its keypoints."""
        return int(self._visible.counts[self._rows[name]])

    def features(self, name: str, keys: Iterable[str]) -> dict[str, np.ndarray]:
        """Return some features of an image, float32, see `matchers.base.Matcher`.

        Args:
            name: of the image.
            keys: `keypoints` (M, 2), the `projections` with hloc's pixel origin, and `image_size`
                (2,). With the last one, keypoints are `feature_files.upright`, if all images are
                stored turned in the same way.
        """
        found: dict[str, np.ndarray] = {}
        for key in keys:
            if key == "keypoints":
                found[key] = (self.projections(name) - 0.5).astype(np.float32)
            else:
                camera = self.camera_of[name]
                found[key] = np.array([camera.width, camera.height], np.float32)
        return upright(found, self._turns)

    def projections(self, name: str) -> np.ndarray:
        """Return the projections (M, 2) of the points that an image shows, COLMAP's pixels."""
        points = self.points[self.visible(name)]
        given = np.zeros((len(points), 2))
        _, found = reprojection_errors(given, points, self.pose(name), self.camera_of[name])
        return np.nan_to_num(found, posinf=0.0, neginf=0.0)

    def lift(self, name: str, keypoints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the ids and the coordinates of points that an image shows."""
        rows = self.visible(name)[keypoints]
        return rows, self.points[rows]

    def clusters(self, names: list[str]) -> list[list[str]]:
        """Return the images in one cluster."""
        return [names]

    def fallback(self, names: list[str]) -> pycolmap.Rigid3d:
        """Return the pose of the first of some images, or without them of the first of all."""
        return self.pose(names[0] if names else self.names[0])


def rotation_of(quaternion: np.ndarray) -> pycolmap.Rotation3d:
    """Return the rotation of a rounded quaternion (4,), x, y, z, w."""
    exact = quaternion.astype(np.float64)
    return pycolmap.Rotation3d(exact / np.linalg.norm(exact))


def check_model(model: dict, feature: str) -> None:
    """Refuse a feature whose extractor or weights a file cannot be trusted with, or does not have.

    Raises:
        InputError: for hloc's extractors and for weights in a file.
    """
    base = features_confs.base_of(model)
    for name in {str(model["name"]), str(base["name"])}:
        if name not in ("dog", "reduced", *features_confs.DEFAULT_NETWORKS):
            raise InputError(f"Compact maps cannot have {feature}: its extractor is {name}.")
    if base.get("weights") is not None:
        raise InputError(f"Compact maps cannot have {feature}: its weights are in a file.")
    octave = (base.get("options") or {}).get("first_octave", 0)
    if not octave >= LEAST_OCTAVE:
        raise InputError(f"Compact maps cannot have {feature}: its first_octave is {octave}.")


def _array(
    tensors: Mapping[str, np.ndarray],
    name: str,
    dtype: type | np.dtype,
    shape: tuple[int | None, ...],
) -> np.ndarray:
    """Return a tensor; raise a ValueError if it has another type or shape."""
    found = tensors[name]
    fits = len(found.shape) == len(shape) and all(
        size in (None, side) for side, size in zip(found.shape, shape, strict=True)
    )
    if found.dtype != dtype or not fits:
        raise ValueError(f"{name} of {found.dtype} {found.shape}")
    return found


def check_feature_keys(matcher: str, feature_keys: Iterable[str]) -> None:
    """Raise an InputError for a matcher that needs what images of a compact map do not have.

    Args:
        matcher: a key of `confs.matchers`.
        feature_keys: what it needs of the features of an image.
    """
    if missing := [key for key in feature_keys if key not in FEATURES]:
        raise InputError(
            f"Compact maps cannot have the matcher {matcher}, which needs {' and '.join(missing)} "
            "of keypoints: choose another --matcher."
        )


def is_compact(path: Path) -> bool:
    """Tell whether a path is that of a compact map."""
    return path.suffix == SUFFIX
