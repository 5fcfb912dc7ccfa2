"""Compact maps: one file with all that localization needs. docs/map-format.md describes it."""

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property, lru_cache
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
from ..retrieval.ranking import rank
from ..retrieval.vlad import VOCABULARY, read_vocabulary
from ..utils.cli import InputError, choose, naming
from ..utils.codes import CODED, FLOATS, QUANTIZED, STORAGES, check_levels, restore
from ..utils.feature_files import upright
from ..utils.files import file_sha256, replacing
from ..utils.images import TURNS
from ..utils.parsers import check_names
from . import images, older, signs, tensors, visible
from .broken import reading
from .names import Names
from .points import Coordinates, Grid

VERSION = 4
SUFFIX = ".hlm"
FEATURES = "keypoints", "descriptors", "image_size"  # of an image, see `matchers.base.Matcher`
# what a file may ask for
MAX_DIM, MAX_GLOBAL, MAX_SIDE, LEAST_OCTAVE = 512, 2**14, 4096, -1
# of these, a query of a large map needs little, all over the file
PARTS = "retrieval", "images", "names", "descriptors", "coordinates", "visible"
CACHED = 128  # images whose visible points stay in memory
PROJECTION = re.compile(r"[\w+-]+(@\d+)?")  # a name, and a prefix of a nested one


class CompactMap:
    """A compact map, as a `localization.references.Reference`: its images show points.

    The file is opened, not read: each method reads what it needs, and checks that.

    Args:
        path: the file.

    Attributes:
        feature: name of the feature.
        conf: its configuration.
        storage: of the points' descriptors.
        matcher: a key of `confs.matchers`.
        retrieval: a key of `confs.retrieval`.
        cameras: what the map tells about the intrinsics of other photos.
        doubts: why it may be wrong.
        frame: its unit, and where on Earth it is.
        made_from: id of the map that it was made from, or a fingerprint of the model; None if it
            does not tell.
        names: the images, sorted.
        points: the coordinates.
        vocabulary: (W, D) float32, of the global descriptors; None if they have none.
        dim: dimension of the descriptors.
        projection: content of the file of the projection, None without one.

    Raises:
        InputError: when the file is missing, broken or of another version. All methods raise it
            when the part that they read is broken.
    """

    def __init__(self, path: Path):
        self.path = path
        with reading(path):
            told, arrays = tensors.read(path)
            metadata = json.loads(told["map"])
            version = metadata["version"]
            if version not in (*older.VERSIONS, VERSION):
                raise InputError(
                    f"{path} is a compact map of version {version}, not {VERSION} or older."
                )
            with naming(path):
                if version != VERSION:
                    metadata, arrays = older.convert(metadata, arrays, path)
                self._read(metadata, arrays)

    def _read(self, metadata: dict, arrays: Mapping[str, np.ndarray]) -> None:
        number, shipped = int(metadata["points"]), dict(metadata.get("shipped", {}))
        table = _array(arrays, "images", np.uint8, (None, images.ROW.itemsize))
        self._table = np.ascontiguousarray(table).view(images.ROW)[:, 0]
        packed = _array(arrays, "names", np.uint8, (None,))
        self._names = Names(packed, len(table), self.path)
        self.names: Sequence[str] = self._names
        self._cameras = _array(arrays, "cameras", np.uint8, (None, None))
        bits, step = [int(number) for number in metadata["bits"]], float(metadata["step"])
        self._grid = Grid(np.array(metadata["least"], np.float64), step, bits)
        coordinates = _array(arrays, "coordinates", np.uint8, (None,))
        self.points = Coordinates(coordinates, number, self._grid)
        self._center_step = float(metadata["center_step"])
        if not np.isfinite(self._grid.least + self._center_step * 2.0**31).all():
            raise ValueError("centers that are not finite")
        self._packed = _array(arrays, "visible", np.uint8, (None,))
        self.visible_of = lru_cache(CACHED)(self._visible_of)
        self.storage = choose("storage", metadata["storage"], STORAGES)
        self._read_feature(metadata)
        self._read_projection(metadata, arrays, shipped)
        self._read_descriptors(metadata, arrays)
        self._read_retrieval(metadata, arrays, shipped)

    def _read_descriptors(self, metadata: dict, arrays: Mapping[str, np.ndarray]) -> None:
        kind = np.dtype(self.storage) if self.storage in FLOATS else np.uint8
        self._descriptors = found = _array(arrays, "descriptors", kind, (len(self.points), None))
        self._key = QUANTIZED.get(self.storage, "descriptors")
        self._attrs: dict[str, Any] = {}
        if self.storage in CODED:
            levels = arrays.get("levels")
            if levels is None:  # they ship with the projection
                levels = projections.levels(self.conf["model"]["projection"], self.storage)
                levels = levels.astype(np.float16)
            self._attrs["levels"] = check_levels(levels, self.storage, found.shape[1])
        elif self.storage not in FLOATS:
            scale, offset = map(float, metadata["scale"])
            self._attrs |= {"scale": scale, "offset": offset}
        self.dim = len(self._attrs.get("levels", found.T))
        numbers = [*self._attrs.values()] if "scale" in self._attrs else []
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
        self.made_from = metadata.get("made_from")
        self.cameras = intrinsics.from_dict(metadata)
        orientations = self.cameras.orientations
        turns = {TURNS.get(one, 0) for one in orientations}
        is_upright = self.conf["preprocessing"].get("upright") and len(turns) == 1
        self._turns = turns.pop() if is_upright else 0

    def _read_projection(
        self, metadata: dict, arrays: Mapping[str, np.ndarray], shipped: dict
    ) -> None:
        self.projection: bytes | None = None
        projection = self.conf["model"].get("projection")
        if projection is None:
            return
        if not PROJECTION.fullmatch(projection):
            raise ValueError(f"the projection {projection!r}")
        self._suffix = metadata.get("projection_suffix", ".safetensors")
        if self._suffix not in (".safetensors", ".pth"):
            raise ValueError(f"a projection of type {self._suffix!r}")
        if "projection" in arrays:
            self.projection = arrays["projection"].tobytes()
            return
        if projections.checksum(projection) != shipped["projection"]:
            raise InputError(f"{self.path} needs another {projection} than the one that ships.")
        self.projection = projections.find(projection).read_bytes()

    def _read_retrieval(
        self, metadata: dict, arrays: Mapping[str, np.ndarray], shipped: dict
    ) -> None:
        self.retrieval = str(metadata.get("retrieval", retrieval_confs.VLAD))
        retrieval_confs.get(self.retrieval)
        self.vocabulary: np.ndarray | None = None
        if "vocabulary" in arrays:
            found = _array(arrays, "vocabulary", np.float16, (None, self.dim))
            self.vocabulary = found.astype(np.float32)
        elif self.retrieval == retrieval_confs.VLAD or "vocabulary" in shipped:
            self.vocabulary = read_vocabulary()
            if shipped.get("vocabulary") not in (None, file_sha256(VOCABULARY)):
                raise InputError(f"{self.path} needs another vocabulary than the one that ships.")
        number = int(metadata.get("global_dim", 0))
        if self.vocabulary is not None:
            if self.vocabulary.shape[1] != self.dim or not np.isfinite(self.vocabulary).all():
                raise ValueError(f"a vocabulary of shape {self.vocabulary.shape}, or not finite")
            number = number or self.vocabulary.size
        if not 0 < number <= MAX_GLOBAL:
            raise ValueError(f"global descriptors of {number} numbers")
        self._global_dim, width = number, -(-signs.count(number) // 8)
        self._signs = _array(arrays, "retrieval", np.uint8, (len(self.names), width))
        self._coarse: signs.Signs | None = None
        if "coarse" in arrays:
            columns = _array(arrays, "coarse", np.uint8, (None, len(self.names)))
            if not 0 < len(columns) <= width:
                raise ValueError(f"coarse of {len(columns)} bytes an image")
            self._coarse = signs.Signs(columns, number)
            for part in PARTS:
                tensors.read_by_pages(arrays[part])

    @cached_property
    def _every_sign(self) -> signs.Signs:
        return signs.Signs(signs.columns(self._signs), self._global_dim)

    def _is_blind(self, rows: np.ndarray) -> np.ndarray:
        """Return which images (N,) show no point (N,) bool."""
        ends = self._table["end"]
        return np.where(rows > 0, ends[rows - 1], 0) == ends[rows]

    def global_descriptors(self) -> np.ndarray:
        """Return those of the images (I, G) float32 as their signs tell them.

        Norms are 1, or 0 for images without points.
        """
        found = self._every_sign.descriptors()
        found[self._is_blind(np.arange(len(found)))] = 0
        return found

    def retrieve(self, descriptor: np.ndarray, number: int) -> tuple[np.ndarray, np.ndarray]:
        """Find the images that are most similar to a photo.

        Args:
            descriptor: (G,) float32, its global descriptor.
            number: of images, at most.

        Returns:
            Their rows (N,), best first, and similarity (N,), -inf for images without points.
        """
        if self._coarse is None:
            rows = np.arange(len(self.names))
            similarity = self._every_sign.similarity(descriptor)
        else:
            rough = self._coarse.similarity(descriptor)
            some = min(len(rough), max(signs.LEAST, signs.CANDIDATES * number))
            rows = np.sort(np.argpartition(-rough, some - 1)[:some])
            packed = signs.columns(self._signs[rows])
            similarity = signs.Signs(packed, self._global_dim).similarity(descriptor)
        similarity[self._is_blind(rows)] = -np.inf
        best = rank(similarity[None], number)[0]
        return rows[best], similarity[best]

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
        found = self._descriptors[points]
        if self.storage in FLOATS and not np.isfinite(found).all():
            raise InputError(f"{self.path} is broken: its descriptors are not finite.")
        return {self._key: found.T}, {self._key: self._attrs}

    def descriptors(self, points: np.ndarray, unbiased: bool = False) -> np.ndarray:
        """Return the descriptors (K, D) float32 of points (K,), see `codes.restore`."""
        return restore(*self._stored(points), unbiased)

    def row(self, name: str) -> int:
        """Return the row of an image."""
        row = self._names.row(name)
        if row is None:
            raise InputError(f"{self.path} has no image {name}, or is broken.")
        return row

    def check_names(self) -> None:
        """Refuse images of the same name, or whose name is a folder of another one.

        Raises:
            InputError: then.
        """
        names = list(self.names)
        folders = {str(folder) for name in names for folder in PurePath(name).parents}
        if len(set(names)) != len(names) or folders & set(names) or sorted(names) != names:
            raise InputError(
                f"{self.path} is broken: it has images of the same name, or one in another one."
            )

    def visible(self, name: str) -> np.ndarray:
        """Return the points (M,) int64 that an image shows, ascending."""
        return self.visible_of(self.row(name))

    def _visible_of(self, row: int) -> np.ndarray:
        """Return the points (M,) int64 that the image of a row shows, ascending."""
        with reading(self.path):
            begin = int(self._table["end"][row - 1]) if row else 0
            end = int(self._table["end"][row])
            if not begin <= end <= len(self._packed):
                raise ValueError(f"visible points from {begin} to {end}")
            return visible.unpack(self._packed[begin:end], len(self.points))

    @property
    def num_cameras(self) -> int:
        """The number of different intrinsics."""
        return len(self._cameras)

    def camera_number(self, name: str) -> int:
        """Return the number of the camera of an image."""
        return int(self._table["camera"][self.row(name)])

    def camera(self, name: str) -> pycolmap.Camera:
        """Return the intrinsics of an image."""
        with reading(self.path):
            return images.read_camera(self._cameras[self.camera_number(name)])

    def pose(self, name: str) -> pycolmap.Rigid3d:
        """Return the pose of an image, camera from world."""
        row = self.row(name)
        rotations, centers = self._poses(self._table[row : row + 1])
        rotation = pycolmap.Rotation3d(rotations[0])
        return pycolmap.Rigid3d(rotation, -(rotation.matrix() @ centers[0]))

    def _poses(self, table: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the rotations (N, 4), x, y, z, w, and positions (N, 3) in rows of the table."""
        centers = self._grid.least + self._center_step * table["center"]
        return images.rotations(table), centers

    def views(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the positions (I, 3) and the optical axes (I, 3) of all images."""
        rotations, positions = self._poses(self._table)
        x, y, z, w = rotations.T
        axes = [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)]
        return positions, np.stack(axes, axis=1)

    def __contains__(self, name: str) -> bool:
        return name in self.names

    def num_keypoints(self, name: str) -> int:
        """Return the number of points that an image shows: these are its keypoints."""
        return len(self.visible(name))

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
                camera = self.camera(name)
                found[key] = np.array([camera.width, camera.height], np.float32)
        return upright(found, self._turns)

    def projections(self, name: str) -> np.ndarray:
        """Return the projections (M, 2) of the points that an image shows, COLMAP's pixels."""
        points = self.points[self.visible(name)]
        given = np.zeros((len(points), 2))
        _, found = reprojection_errors(given, points, self.pose(name), self.camera(name))
        return np.nan_to_num(found, posinf=0.0, neginf=0.0)

    def lift(self, name: str, keypoints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the ids and the coordinates of points that an image shows."""
        rows = self.visible(name)[keypoints]
        return rows, self.points[rows]

    def clusters(self, names: list[str]) -> list[list[str]]:
        """Return the images in one cluster."""
        return [names]

    def floors(self, names: list[str]) -> list[list[str]]:
        """Return all images together: a map has one frame."""
        return [names]

    def fallback(self, names: list[str]) -> pycolmap.Rigid3d:
        """Return the pose of the first of some images, or without them of the first of all."""
        return self.pose(names[0] if names else self.names[0])


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
    arrays: Mapping[str, np.ndarray],
    name: str,
    dtype: type | np.dtype,
    shape: tuple[int | None, ...],
) -> np.ndarray:
    """Return an array; raise a ValueError if it has another type or shape."""
    found = arrays[name]
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


def is_compact(path: Path | Sequence[Path]) -> bool:
    """Tell whether a path is that of a compact map, or all of several are."""
    return all(one.suffix == SUFFIX for one in ([path] if isinstance(path, Path) else path))
