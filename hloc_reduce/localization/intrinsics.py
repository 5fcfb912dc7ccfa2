"""Intrinsics of queries without a list: those of the map's cameras, of EXIF data, or guessed."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import pycolmap

from ..utils import cli, colmap
from ..utils.files import replacing
from ..utils.images import UnreadableImage, orientation
from ..utils.parsers import parse_camera, to_line
from .exif import WELL_KNOWN, ExifCamera, correct, exif_camera
from .gate import FOCAL_LENGTHS
from .lenses import PLAIN, Size, split
from .pose import OF_SIZE

# A lens is typical of photos whose cameras have a `PLAIN` model, if the logarithms of their focal
# lengths, their distortions and principal points differ by at most this.
LIKE_ONE_LENS = 0.05, 0.1, 0.02, 0.02
GUESSED_FOCAL = 1.2  # times the longer side, as in COLMAP
MOST_LENSES = 8  # that are tried
UNKNOWN_LENS = (
    "its lens is not known: photos of the map ({} pixels) are by a fisheye or another lens that "
    "cannot be guessed; give its intrinsics by --queries"
)
_REFINED = {"refinement": {"refine_focal_length": True}}
_GUESSED = {"estimation": {"estimate_focal_length": True}, **_REFINED}
# source of intrinsics -> options of `localize_sfm.main` that make up for their errors
REFINEMENTS = {
    "list": {},
    "rig": {},
    "panorama": {},
    "map": {"photo": {"of_map": True}},
    "lens": {"photo": OF_SIZE},
    "EXIF": _REFINED,
    "guess": _GUESSED,
    "unknown": {**_GUESSED, "photo": {"cropped": True}},
    "none": {},
}
EXACT = (
    "rig",
    "panorama",
    "map",
    "lens",
)  # sources of intrinsics that are not estimated with the pose


class Lens(NamedTuple):
    """What photos of one size by a camera have in common.

    Args:
        focal_length: in longer sides.
        distortion: that of SIMPLE_RADIAL.
        x, y: the principal point, as shares of width and height.
    """

    focal_length: float
    distortion: float
    x: float = 0.5
    y: float = 0.5


class MapCameras(NamedTuple):
    """What the photos of a map tell about the intrinsics of others, and how these are stored.

    Args:
        known: cameras that took several of its photos, by their `exif.ExifCamera.name`.
        sizes: (width, height) of its photos, except those by `lenses`.
        models: `exif.ExifCamera.model` of all cameras that took its photos.
        focal_lengths: the least and the largest of its cameras, in longer sides; None if the map
            does not know.
        typical: of each size of which it has several photos, (width, height), their lens, if that
            is much the same in all of them.
        orientations: EXIF orientations of its photos, empty if EXIF data of any do not tell.
        lenses: of each size of photos by bent lenses, such as fisheyes, these; see `lenses`.
    """

    known: dict[str, pycolmap.Camera]
    sizes: set[Size]
    models: Collection[str] = ()
    focal_lengths: tuple[float, float] | None = None
    typical: Mapping[Size, Lens] = MappingProxyType({})
    orientations: Collection[int] = ()
    lenses: Mapping[Size, Sequence[pycolmap.Camera]] = MappingProxyType({})


def infer(image: Path | np.ndarray, of_map: MapCameras) -> tuple[pycolmap.Camera, str]:
    """Infer the intrinsics of a photo.

    Args:
        image: its file, or its pixels (H, W) or (H, W, 3).
        of_map: cameras and photo sizes of the map.

    Returns:
        The camera and its source, a key of `REFINEMENTS`: "map" for a camera that the map knows,
        else a SIMPLE_RADIAL camera without distortion, from "EXIF" data or guessed. It is a "guess"
        if map photos have the size of the photo, which then is hardly cropped, else "unknown". So
        are digital zooms, photos of another shape than their EXIF data say, and photos by a camera
        of the map whose size no map photo has: their EXIF data do not say what was cut off. In a
        map with bent lenses, photos that may be by one of them are no guess: those of the size of
        its photos have one of these, "lens", and others have "none".

    Raises:
        UnreadableImage: if the image cannot be read.
    """
    exif, has_focal_length = None, False
    if isinstance(image, np.ndarray):
        height, width = image.shape[:2]
        params = [GUESSED_FOCAL * max(width, height), width / 2, height / 2, 0]
        camera = pycolmap.Camera(model="SIMPLE_RADIAL", width=width, height=height, params=params)
    else:
        camera, has_focal_length = colmap.infer_camera(image)
        exif, side = exif_camera(image), max(camera.width, camera.height)
        low, high = FOCAL_LENGTHS
        if has_focal_length and not low <= camera.mean_focal_length() / side <= high:
            has_focal_length = False  # no lens has it: some programs write 65535 for an unknown one
            camera.params = [GUESSED_FOCAL * side, *camera.params[1:]]
    size = camera.width, camera.height
    has_size = bool({size, size[::-1]} & of_map.sizes)
    bent = of_map.lenses.get(size, ())
    is_copy = exif is not None and exif.model in of_map.models and not (has_size or bent)
    is_cut = is_copy or (exif is not None and not exif.is_original)
    if exif is not None and not is_cut and exif.name in of_map.known:
        return of_map.known[exif.name], "map"
    if of_map.lenses and not (has_size or _is_by_another_camera(exif, of_map, bool(bent))):
        camera.has_prior_focal_length = False
        is_known = 0 < len(bent) <= MOST_LENSES and not is_cut
        return (bent[0], "lens") if is_known else (camera, "none")
    if has_focal_length and not is_cut:
        if exif is not None:
            correct(camera, exif)
        return camera, "EXIF"
    camera.has_prior_focal_length = False
    return camera, "guess" if has_size and not is_cut else "unknown"


def _is_by_another_camera(exif: ExifCamera | None, of_map: MapCameras, has_size: bool) -> bool:
    """Tell whether EXIF data show that no camera of a map took a photo.

    Args:
        exif: of the photo.
        of_map: what the map tells.
        has_size: whether photos of the map have the size of the photo. If these have no EXIF data,
            the same camera may still have taken it.
    """
    if exif is None or exif.model in of_map.models:
        return False
    return bool(of_map.models) or not has_size


def infer_all(
    image_dir: Path, names: Iterable[str], of_map: MapCameras, strict: bool = False
) -> dict[str, tuple[pycolmap.Camera, str]]:
    """Infer the intrinsics of the photos of a folder, see `infer`; skip unreadable ones.

    Raises:
        UnreadableImage: if `strict`.
    """
    inferred = {}
    for name in names:
        try:
            inferred[name] = infer(image_dir / name, of_map)
        except UnreadableImage:
            if strict:
                raise
    return inferred


def refinement(camera: pycolmap.Camera, source: str, of_map: MapCameras) -> dict:
    """Return the options of `localize_sfm.main` for a photo with inferred intrinsics.

    Args:
        camera: as `infer` returns it.
        source: a key of `REFINEMENTS`.
        of_map: what the map tells.

    Returns:
        Those of `REFINEMENTS`; for a "guess" also the `focal_lengths` in pixels of the map's
        cameras, as a photo that has another one may have been cropped and enlarged; and the
        `typical` lens of map photos of its size, upright or turned, if there is one. If map photos
        of its size are by bent lenses, these are the `lenses` to try.
    """
    options = REFINEMENTS[source]
    size = camera.width, camera.height
    photo: dict = dict(options.get("photo", {}))
    bent = [to_list(lens) for lens in of_map.lenses.get(size, ())]
    if source == "none":
        sizes = {f"{width}x{height}" for width, height in of_map.lenses}
        photo["refusal"] = UNKNOWN_LENS.format(cli.some(sorted(sizes)))
    elif source not in EXACT and bent:
        photo["lenses"] = bent[:MOST_LENSES]
    elif source == "lens" and bent[1:]:
        photo["lenses"] = bent[1:]
    if source != "guess" or of_map.focal_lengths is None:
        return options | {"photo": photo} if photo else options
    side = max(camera.width, camera.height)
    photo["focal_lengths"] = [side * f for f in of_map.focal_lengths]
    if lens := of_map.typical.get(size):
        photo["typical"] = [*lens]
    elif lens := of_map.typical.get(size[::-1]):  # the principal point depends on which way
        photo["typical"] = [*lens._replace(x=0.5, y=0.5)]
    return options | {"photo": photo}


def of_cameras(cameras: Iterable[pycolmap.Camera]) -> MapCameras:
    """Return what photos of a map tell about the intrinsics of others, from the camera of each."""
    cameras, bent = split(cameras)
    sizes = {(camera.width, camera.height) for camera in cameras}
    found = [camera.mean_focal_length() / max(camera.width, camera.height) for camera in cameras]
    lengths = (min(found), max(found)) if found else None
    alike: dict[Size, list[pycolmap.Camera]] = {}
    for camera in cameras:
        alike.setdefault((camera.width, camera.height), []).append(camera)
    lenses = {size: _typical(same) for size, same in alike.items()}
    typical = {size: lens for size, lens in lenses.items() if lens is not None}
    return MapCameras({}, sizes, focal_lengths=lengths, typical=typical, lenses=bent)


def with_lenses(told: MapCameras, cameras: Iterable[pycolmap.Camera]) -> MapCameras:
    """Return what a map tells with its bent lenses, from the camera of each of its photos."""
    found = of_cameras(cameras)
    sizes = told.sizes - (found.lenses.keys() - found.sizes)
    focal_lengths = found.focal_lengths if found.lenses else told.focal_lengths
    return told._replace(sizes=sizes, focal_lengths=focal_lengths, lenses=found.lenses)


def _typical(cameras: Sequence[pycolmap.Camera]) -> Lens | None:
    """Return the median lens of photos of one size; None if they are few or their lenses differ."""
    if len(cameras) < WELL_KNOWN or not {camera.model.name for camera in cameras} <= {*PLAIN}:
        return None
    width, height = cameras[0].width, cameras[0].height
    lenses = np.array(
        [
            (
                camera.mean_focal_length() / max(width, height),
                [*camera.params[camera.extra_params_idxs()], 0.0][0],
                camera.principal_point_x / width,
                camera.principal_point_y / height,
            )
            for camera in cameras
        ]
    )
    ratios = [np.ptp(np.log(camera.params[camera.focal_length_idxs()])) for camera in cameras]
    spread = np.ptp(lenses, axis=0)
    spread[0] = max(np.ptp(np.log(lenses[:, 0])), *ratios)
    lens = Lens(*np.median(lenses, axis=0).tolist())
    low, high = FOCAL_LENGTHS
    return lens if (spread <= LIKE_ONE_LENS).all() and low <= lens.focal_length <= high else None


def of_map(
    reconstruction: pycolmap.Reconstruction,
    image_dir: Path,
    names: Collection[str] | None = None,
) -> MapCameras:
    """Return what photos of a map tell about the intrinsics of other photos.

    Args:
        reconstruction: the map.
        image_dir: the folder of the photos.
        names: the photos; default: all of the map.
    """
    models: set[str] = set()
    found: dict[str, list[int]] = {}
    images = reconstruction.images.values()
    photos = [image for image in images if names is None or image.name in names]
    for image in photos:
        if (exif := exif_camera(image_dir / image.name)) is not None:
            models.add(exif.model)
            if exif.is_original:
                found.setdefault(exif.name, []).append(image.camera_id)
    known = {
        name: reconstruction.cameras[ids[0]]
        for name, ids in found.items()
        if len(ids) >= WELL_KNOWN and len(set(ids)) == 1
    }
    cameras = [reconstruction.cameras[image.camera_id] for image in photos]
    told = of_cameras(cameras)._replace(known=known, models=models)
    turns = {orientation(image_dir / image.name) for image in photos}
    return told._replace(orientations={one for one in turns if one and None not in turns})


def merged(first: MapCameras, second: MapCameras) -> MapCameras:
    """Return what two groups of photos of a map tell, without typical lenses.

    If both know a camera, or bent lenses of a size, the first one's count. Orientations are known
    if those of both groups are, or one has no photos.
    """
    turns = [one.orientations for one in (first, second) if one.sizes or one.lenses]
    models = {*first.models, *second.models}
    ranges = [cameras.focal_lengths for cameras in (first, second) if cameras.focal_lengths]
    lengths = (min(low for low, _ in ranges), max(high for _, high in ranges)) if ranges else None
    return MapCameras(
        *(second.known | first.known, first.sizes | second.sizes, models, lengths),
        orientations=set().union(*turns) if all(turns) else set(),
        lenses={**second.lenses, **first.lenses},
    )


def to_dict(cameras: MapCameras) -> dict:
    """Return what a map tells as JSON values, by their names in map.json."""
    return {
        "cameras": {name: to_list(one) for name, one in cameras.known.items()},
        "sizes": sorted(cameras.sizes),
        "camera_models": sorted(cameras.models),
        "focal_lengths": cameras.focal_lengths,
        "typical": to_rows(cameras.typical),
        "orientations": sorted(cameras.orientations),
        "lenses": [to_list(one) for lenses in cameras.lenses.values() for one in lenses],
    }


def from_dict(content: Mapping[str, Any]) -> MapCameras:
    """Return what a map tells, from what `to_dict` returned; what is missing, it does not know.

    Raises:
        KeyError, TypeError or ValueError: if it is wrong.
    """
    return MapCameras(
        {str(name): from_list(values) for name, values in content.get("cameras", {}).items()},
        {(int(width), int(height)) for width, height in content.get("sizes", [])},
        {str(model) for model in content.get("camera_models", [])},
        to_range(content.get("focal_lengths")),
        from_rows(content.get("typical", [])),
        {int(orientation) for orientation in content.get("orientations", [])},
        to_lenses(content.get("lenses", [])),
    )


def to_lenses(rows: Iterable[Sequence]) -> dict[Size, list[pycolmap.Camera]]:
    """Return the bent lenses in rows from `to_dict`; raise a ValueError if they are wrong."""
    lenses: dict[Size, list[pycolmap.Camera]] = {}
    for row in rows:
        camera = from_list(row)
        lenses.setdefault((camera.width, camera.height), []).append(camera)
    return lenses


def to_rows(typical: Mapping[Size, Lens]) -> list[list]:
    """Return typical lenses as JSON values: width, height, and the values of a `Lens`."""
    return [[*size, *lens] for size, lens in sorted(typical.items())]


def from_rows(rows: Iterable[Sequence]) -> dict[Size, Lens]:
    """Return the lenses in rows from `to_rows`; raise a ValueError or TypeError for wrong ones."""
    typical = {}
    for width, height, *values in rows:
        lens = Lens(*map(float, values))
        low, high = FOCAL_LENGTHS
        if not (width > 0 < height and low <= lens.focal_length <= high):
            raise ValueError(f"photos of {width}x{height} pixels by a {lens}")
        if not np.isfinite([width, height, *lens]).all():
            raise ValueError(f"numbers that are not finite: {[width, height, *lens]}")
        typical[int(width), int(height)] = lens
    return typical


def to_list(camera: pycolmap.Camera) -> list:
    """Return intrinsics as JSON values: model, width, height and parameters."""
    return [camera.model.name, camera.width, camera.height, *camera.params.tolist()]


def to_range(values: Sequence[float] | None) -> tuple[float, float] | None:
    """Return a range of focal lengths in JSON; raise a ValueError if it is wrong."""
    if values is None:
        return None
    low, high = map(float, values)
    if not 0 < low <= high < np.inf:
        raise ValueError(f"focal lengths from {low} to {high}")
    return low, high


def to_lists(queries: Sequence[tuple[str, pycolmap.Camera | None]]) -> dict[str, list | None]:
    """Return the intrinsics of queries as JSON values, None if they are not known."""
    return {name: None if camera is None else to_list(camera) for name, camera in queries}


def from_list(values: Sequence) -> pycolmap.Camera:
    """Return the intrinsics in a list from `to_list`; raise a ValueError if they are wrong."""
    return parse_camera([str(value) for value in values])


def write_queries(cameras: Mapping[str, tuple[pycolmap.Camera, str]], path: Path) -> None:
    """Write a query list with intrinsics, and their sources in comments."""
    lines = []
    for name, (camera, source) in cameras.items():
        params = map(repr, camera.params.tolist())
        lines.append(f"# {source}\n")
        lines.append(to_line(name, camera.model.name, camera.width, camera.height, *params))
    with replacing(path) as temporary:
        temporary.write_text("".join(lines), encoding="utf-8")
