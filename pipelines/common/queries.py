"""The queries of pipelines.localize: their names and intrinsics, and whether photos changed."""

import hashlib
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Self

import pycolmap

from hloc_reduce import logger
from hloc_reduce.localization import intrinsics
from hloc_reduce.localization import panoramas as panorama_files
from hloc_reduce.localization.rigs import Frames, frames, of_rig
from hloc_reduce.maps.map import Map
from hloc_reduce.runtime import provenance
from hloc_reduce.runtime.outputs import CONF
from hloc_reduce.utils import cli
from hloc_reduce.utils import masks as masks_of
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.files import is_readable
from hloc_reduce.utils.images import check_readable, list_images
from hloc_reduce.utils.match_files import check_distinct
from hloc_reduce.utils.parsers import parse_query_lists

from .run import check_queries

SOURCES = {
    "rig": "those of the cameras of --rigs",
    "panorama": "those of views of panoramas",
    "map": "those of the map's camera, according to their EXIF data",
    "lens": "those of the map's photos of their size",
    "none": "not known, as photos of the map are by a fisheye or the like: give them by --queries",
    "EXIF": "from EXIF data and refined with the pose",
    "guess": "guessed and estimated with the pose, or those of the map's photos if they fit",
    "unknown": "guessed and estimated with the pose, of no map photo's size: perhaps cropped",
}
LISTED = "queries_with_intrinsics.txt"  # written for a folder of queries
NOT_IN_NAMES = r"[^\w.-]+"  # characters of a glob


@dataclass(frozen=True)
class Queries:
    """The queries of a run.

    Args:
        lists: the names of the queries of each list.
        inferred: intrinsics with their sources, as from `intrinsics.infer`, but none of unreadable
            photos; None if the lists have intrinsics.
        refinements: which of these are refined with the pose, see `intrinsics.refinement`.
        frames: those of rigs that have several photos.
        panoramas: sizes of the panoramas that the queries are views of; their frames have the names
            of the panoramas.
    """

    lists: dict[str, list[str]]
    inferred: dict[str, tuple[pycolmap.Camera, str]] | None = None
    refinements: Mapping[str, dict] = field(default_factory=dict)
    frames: Frames = field(default_factory=dict)
    panoramas: Mapping[str, panorama_files.Size] = field(default_factory=dict)

    @classmethod
    def find(
        cls,
        query_images: Path,
        queries: Path | None,
        built: Map,
        strict: bool,
        rigs: Path | None = None,
    ) -> Self:
        """Read the queries of lists, or of a folder, whose intrinsics are inferred.

        Args:
            query_images: folder of the photos.
            queries: query list with intrinsics, or a glob of several; None for the whole folder.
            built: the map.
            strict: stop at an unreadable photo.
            rigs: COLMAP's `rig_config.json`, whose intrinsics count if there is no list.

        Raises:
            InputError: when a list is wrong, a photo is missing, or, if `strict`, unreadable; or
                the rigs are wrong, or intrinsics of their photos are not known exactly.
        """
        if queries:
            given = parse_query_lists(queries)
            lists = {stem: [name for name, _ in part] for stem, part in given.items()}
            names = [name for part in lists.values() for name in part]
            check_queries(query_images, names, strict)
            return cls(lists, frames=frames(rigs, names) if rigs else {})
        names = list_images(query_images)
        check_distinct(names)
        inferred = intrinsics.infer_all(query_images, names, built.cameras, strict)
        of_rigs = frames(rigs, names) if rigs else {}
        if rigs:
            inferred |= of_rig(rigs, inferred)
            _check_exact(rigs, of_rigs, inferred)
        refinements = {
            name: intrinsics.refinement(*found, built.cameras) for name, found in inferred.items()
        }
        return cls({query_images.resolve().name: names}, inferred, refinements, of_rigs)

    @classmethod
    def of_panoramas(cls, query_images: Path, sizes: Mapping[str, panorama_files.Size]) -> Self:
        """Return the views of panoramas, see `localization.panoramas.find`."""
        inferred: dict[str, tuple[pycolmap.Camera, str]] = {}
        frames: dict[str, dict[str, pycolmap.Rigid3d]] = {}
        for panorama, size in sizes.items():
            views = panorama_files.views_of(size)
            names = panorama_files.view_names(panorama, views)
            inferred |= {n: (v.camera, "panorama") for n, v in zip(names, views, strict=True)}
            frames[panorama] = {n: v.cam_from_rig for n, v in zip(names, views, strict=True)}
        check_distinct([*inferred])
        lists = {query_images.resolve().name: [*inferred]}
        return cls(lists, inferred, {}, frames, sizes)

    @property
    def names(self) -> list[str]:
        """The names of all queries."""
        return [name for part in self.lists.values() for name in part]

    @property
    def photos(self) -> list[str]:
        """The names of the photos: those of the queries, or of the panoramas."""
        return [*self.panoramas] or self.names

    @property
    def photo_lists(self) -> dict[str, list[str]]:
        """The names of the photos of each list."""
        return {stem: self.photos for stem in self.lists} if self.panoramas else self.lists

    @property
    def sources(self) -> dict[str, str]:
        """Where the intrinsics of the queries are from."""
        if self.inferred is None:
            return dict.fromkeys(self.names, "list")
        return {name: source for name, (_, source) in self.inferred.items()}

    def write(self, path: Path) -> list[tuple[str, pycolmap.Camera | None]]:
        """Write the inferred intrinsics and return those of all queries, None if not known."""
        inferred = self.inferred or {}
        intrinsics.write_queries(inferred, path)
        return [(name, inferred[name][0] if name in inferred else None) for name in self.names]

    def log(self) -> None:
        """Log where inferred intrinsics are from."""
        sources = self.sources
        for source, said in SOURCES.items():
            if some := [name for name in sources if sources[name] == source]:
                logger.info("Intrinsics of %d queries are %s: %s", len(some), said, cli.some(some))


def find_queries(
    query_images: Path,
    queries: Path | None,
    built: Map,
    strict: bool,
    rigs: Path | None,
    are_panoramas: bool,
) -> Queries:
    """Find the queries of a run, see `Queries.find`; those of a folder may be panoramas.

    Args:
        query_images: folder of the photos.
        queries: query list, or a glob of several; None for the whole folder.
        built: the map.
        strict: stop at an unreadable photo.
        rigs: COLMAP's `rig_config.json`.
        are_panoramas: see `localization.panoramas.find`.

    Raises:
        InputError: as `Queries.find` and `panoramas.find`; or if there is no panorama, or there are
            some and rigs; or, if `strict`, one cannot be read.
    """
    if queries is not None:
        if are_panoramas:
            raise InputError("--panoramas have no intrinsics: leave out --queries.")
        return Queries.find(query_images, queries, built, strict, rigs)
    names = list_images(query_images)
    sizes = panorama_files.find(query_images, names, are_panoramas)
    if sizes:
        if rigs is not None:
            raise InputError(panorama_files.NO_RIGS.format(rigs))
        if strict:
            check_readable(query_images, [name for name in names if name not in sizes])
        # the views of unreadable ones are never written, so that their size does not matter
        sizes = {name: sizes.get(name, panorama_files.SMALLEST) for name in names}
        return Queries.of_panoramas(query_images, sizes)
    if are_panoramas:
        raise InputError(panorama_files.NONE.format(query_images))
    return Queries.find(query_images, queries, built, strict, rigs)


def _check_exact(
    rigs: Path, of_rigs: Frames, inferred: Mapping[str, tuple[pycolmap.Camera, str]]
) -> None:
    """Refuse photos of rigs whose intrinsics are estimated with their poses."""
    names = [name for photos in of_rigs.values() for name in photos if name in inferred]
    if unknown := [name for name in names if inferred[name][1] not in ("rig", "map")]:
        raise InputError(
            f"The intrinsics of {cli.some(unknown)} are not known: give --queries, a list with "
            f"intrinsics, or add camera_model_name and camera_params to {rigs}."
        )


class Photos:
    """The provenance of results: the map, the photos of the queries, and their masks.

    Results are stale if a photo or a mask that they were made from has changed, a mask is new or
    gone, or the map was rebuilt.
    """

    def __init__(
        self,
        path: Path,
        built: Map,
        query_images: Path,
        names: list[str],
        masks: Path | None = None,
    ):
        self._path = path
        before = provenance.read(path)
        known = before.get("queries", {})
        files = {name: query_images / name for name in names}
        found = {name: file for name, file in files.items() if is_readable(file)}
        self._map, self._photos = built.id, provenance.fingerprints(found, known)
        self._masks = masks_of.digests(masks_of.find(masks, query_images, names))
        masks_before = before.get("masks", {})
        self.changed = provenance.changed(known, self._photos)
        self.changed += [
            f"the mask of {name}"
            for name in self._photos
            if name in known and masks_before.get(name) != self._masks.get(name)
        ]
        if before and before.get("map") != built.id:
            self.changed.append(f"the map {built.folder}")
        if self.changed:
            logger.info("Results are stale, as these changed: %s.", ", ".join(self.changed))
        else:  # photos that are not in this list may be in the next
            self._photos = {**known, **self._photos}
            self._masks = {**masks_before, **self._masks}

    def write(self) -> None:
        """Write the provenance."""
        content = {"map": self._map, "queries": self._photos}
        provenance.write(self._path, content | ({"masks": self._masks} if self._masks else {}))

    def forget(self, unreadable: Iterable[str]) -> None:
        """Leave out unreadable photos: once readable, they do not make the other results stale."""
        for name in unreadable:
            self._photos.pop(name, None)
            self._masks.pop(name, None)
        self.write()


def results_folder(outputs: Path, query_images: Path, queries: Path | None) -> Path:
    """Return the folder for the results of queries, named after their list or folder.

    If that folder holds results of other queries, a digest of the path is appended to the name.

    Args:
        outputs: the parent folder.
        query_images: folder of the photos.
        queries: their list, if there is one.
    """
    name = re.sub(NOT_IN_NAMES, "_", (queries or query_images.resolve()).stem).strip("._-")
    folder = outputs / f"queries-{name or 'all'}"
    before = provenance.read(folder / CONF)
    own = identity(folder, query_images, queries)
    if any(before.get(key, value) != value for key, value in own.items()):
        where = f"{own['query_images']}\n{queries and own['queries']}"
        folder = folder.with_name(f"{folder.name}-{hashlib.sha256(where.encode()).hexdigest()[:8]}")
    return folder


def identity(folder: Path, query_images: Path, queries: Path | None) -> dict[str, str]:
    """Return the part of the configuration of a folder for results that tells their queries."""
    listed = queries or folder / LISTED
    return {"query_images": str(query_images.resolve()), "queries": str(listed.resolve())}
