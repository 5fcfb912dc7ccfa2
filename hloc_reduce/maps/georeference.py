"""Put a map into metres: by GPS positions, or by a distance and the cameras that were upright."""

import json
import shutil
import uuid
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pycolmap

from .. import logger
from ..localization import gps as gps_positions
from ..localization import panoramas
from ..localization.frame import METRES, Frame
from ..localization.gps import Positions
from ..mapping import alignment, gravity
from ..mapping.alignment import Alignment, NotAligned
from ..mapping.gravity import Gravity
from ..mapping.registration import REGISTRATION
from ..runtime import provenance
from ..utils import cli, colmap
from ..utils.cli import InputError
from ..utils.files import file_sha256, is_readable
from ..utils.h5 import list_h5_names
from ..utils.images import orientation
from ..utils.paths import strings_as_paths
from .map import FINGERPRINTS, FINISHED, Map, models, opened, write_model

HELP = "The map keeps its own frame and scale. Give better positions, --gps, or a distance, --scale"


class Scale(NamedTuple):
    """The distance of two cameras of a map, in metres, by the names of their photos."""

    first: str
    second: str
    metres: float


def parse_scale(values: Sequence[str | float]) -> Scale:
    """Return the scale in the arguments of --scale: two names and a distance.

    Raises:
        InputError: if they are something else, the names are equal, or the distance is not above 0.
    """
    given = f"--scale {' '.join(map(str, values))}"
    if len(values) != 3:
        raise InputError(f"{given}: give two photos and the distance of their cameras in metres.")
    first, second, distance = values
    try:
        metres = float(distance)
    except ValueError:
        metres = np.nan
    if not 0 < metres < np.inf:
        raise InputError(f"{given}: the distance, {distance}, must be a number of metres above 0.")
    if first == second:
        raise InputError(f"{given}: the two photos must be different.")
    return Scale(str(first), str(second), metres)


def by_exif(model: pycolmap.Reconstruction, image_dir: Path) -> dict[str, Any]:
    """Align a model, in place, with GPS positions in the EXIF data of its photos.

    Returns:
        What map.json says of it; nothing if the model stays as it is, for a reason that is logged.
    """
    names = sorted(model.images[i].name for i in model.reg_image_ids())
    positions = gps_positions.of_photos(image_dir, names)
    if not positions:
        return {}
    try:
        alignment.check_number([*positions])
    except NotAligned as few:
        logger.info("The map keeps its own frame and scale. %s", few)
        return {}
    try:
        return _by_gps(model, positions, image_dir) | {"aligned_to": {"gps": "EXIF"}}
    except NotAligned as error:
        logger.warning("The map is not aligned with the GPS of its photos. %s %s.", error, HELP)
        return {}


@strings_as_paths
def align(built: Map, gps: Path | None = None, scale: Sequence[str | float] | None = None) -> Map:
    """Put a finished map into metres, unless it was aligned to the same before.

    Photos, features and points stay; the frame and the scale of poses and points change, so that
    results in the map become stale.

    Args:
        built: the map.
        gps: CSV file with the columns name, latitude and longitude, degrees (WGS84), and altitude,
            metres above the ellipsoid or empty, of at least three photos.
        scale: names of two photos of the map, and the distance of their cameras in metres.

    Returns:
        The map: in metres, with `gps` in a frame x east, y north, z up, with `scale` with z up as
        most cameras were held, if they agree on that.

    Raises:
        NotAligned: if the positions do not determine the frame, or are not credible.
        InputError: if none or both are given, something is wrong with them, or the map is an
            unpacked compact one. The map is then as it was.
    """
    if (gps is None) == (scale is None):
        raise InputError("Give --gps or --scale, not both.")
    if not (built.folder / FINGERPRINTS).is_file():
        raise InputError(
            f"The map {built.folder} is an unpacked compact one, whose frame cannot be changed: "
            "align the map that it was made from, and compact that again."
        )
    if gps is not None:
        positions = gps_positions.read_csv(gps)
        wanted: dict[str, Any] = {"gps": file_sha256(gps)}
    else:
        distance = parse_scale(scale or ())
        wanted = {"scale": [*distance]}
    if built.aligned_to == wanted:
        return built
    if built.has_rigs and _has_baseline(colmap.read_model(built.sfm)):
        raise InputError(
            f"The map {built.folder} is in the units of its rigs, as queries of rigs are: leave "
            "out --gps and --scale."
        )
    with opened(built) as folder, folder.stage("align"):
        built = Map(built.folder)
        model = colmap.read_model(built.sfm)
        views = panoramas.of_views([image.name for image in model.images.values()])
        if gps is not None:
            positions = {views.get(name, name): place for name, place in positions.items()}
            found = _by_gps(model, _known(positions, built, gps), built.images)
        else:
            first, second, metres = distance
            of_photos = Scale(views.get(first, first), views.get(second, second), metres)
            found = _by_scale(model, of_photos, built.images)
        content = json.loads((built.folder / FINISHED).read_text()) | found
        written = write_moved(built.folder, built.sfm.name, model)
        content |= {"id": uuid.uuid4().hex, "sfm": written.name, "aligned_to": wanted}
        provenance.write(built.folder / FINISHED, content)
        folder.delete(models(folder.written) - {written.name})
    return Map(built.folder)


def write_moved(folder: Path, before: str, model: pycolmap.Reconstruction) -> Path:
    """Write an aligned model as `write_model` does, with the list of its photos, which stay."""
    written = write_model(folder, before, model)
    listed = folder / before / REGISTRATION
    if listed.is_file():
        shutil.copyfile(listed, written / REGISTRATION)
    return written


def _has_baseline(model: pycolmap.Reconstruction) -> bool:
    """Tell whether cameras of a rig are apart, so that the rigs tell the scale of a model."""
    poses = [pose for rig in model.rigs.values() for pose in rig.non_ref_sensors.values()]
    return any(pose is not None and pose.translation.any() for pose in poses)


def _known(positions: Positions, built: Map, path: Path) -> Positions:
    """Return the positions of photos of a map, and name the others."""
    photos = {*list_h5_names(built.features)}
    others = sorted(positions.keys() - photos)
    if others and len(others) == len(positions):
        raise InputError(
            f"{path} has no photo of the map, such as {min(photos)}, but {cli.some(others)}: names "
            "are relative to the folder of the photos."
        )
    if others:
        logger.warning("These names in %s are of no map photo: %s.", path, cli.some(others))
    return {name: place for name, place in positions.items() if name in photos}


def _by_gps(
    model: pycolmap.Reconstruction, positions: Positions, image_dir: Path
) -> dict[str, Any]:
    """Align a model, in place, and return what map.json says of it."""
    found = alignment.align(model, positions, _gravity(model, image_dir))
    model.transform(found.metric_from_map)
    fitting = [error for name, error in found.residuals.items() if name not in found.wrong]
    median, largest = float(np.median(fitting)), max(fitting)
    _log(found, len(fitting), median, largest)
    measured = {
        "photos": len(fitting),
        "ignored": {name: found.residuals[name] for name in found.wrong},
        "median_m": median,
        "largest_m": largest,
        "scale_error": found.scale_error,
    }
    return {"frame": found.frame.to_json(), "alignment": measured}


def _log(found: Alignment, number: int, median: float, largest: float) -> None:
    """Say how well positions fit."""
    latitude, longitude, altitude = found.frame.origin or (np.nan,) * 3
    level = "gravity" in found.frame.told_by
    logger.info(
        "The map is in metres, x east, y north, z up%s, with its origin at latitude %.6f, "
        "longitude %.6f%s. %d of %d photos with GPS fit: they are a median of %.2f m and at most "
        "%.2f m off%s. Distances are right to %.1f %%.",
        " as the cameras were held" * level,
        latitude,
        longitude,
        "" if np.isnan(altitude) else f", altitude {altitude:.1f} m",
        number,
        len(found.residuals),
        median,
        largest,
        " horizontally" * level,
        100 * found.scale_error,
    )
    if found.wrong:
        named = [f"{name} ({found.residuals[name]:.0f} m)" for name in found.wrong]
        logger.warning("GPS that contradicts the other photos is ignored: %s.", cli.some(named, 10))


def _by_scale(model: pycolmap.Reconstruction, scale: Scale, image_dir: Path) -> dict[str, Any]:
    """Scale and level a model, in place, and return what map.json says of it."""
    centres = {
        model.images[i].name: model.images[i].projection_center() for i in model.reg_image_ids()
    }
    if unknown := [name for name in scale[:2] if name not in centres]:
        raise InputError(
            f"--scale: the map has no photo {' and no photo '.join(unknown)}, but "
            f"{cli.some(sorted(centres))}. Photos that could not be reconstructed have no place."
        )
    distance = float(np.linalg.norm(centres[scale.first] - centres[scale.second]))
    if not distance > 0:
        raise InputError(f"--scale: {scale.first} and {scale.second} are at the same place.")
    up = _gravity(model, image_dir)
    turn = up.level() if up else pycolmap.Rotation3d()
    model.transform(pycolmap.Sim3d(scale.metres / distance, turn, np.zeros(3)))
    logger.info(
        "The map is in metres, as %s and %s are %g m apart. %s",
        *scale,
        f"As a last resort, z is up as {up.number} of {len(centres)} cameras were held."
        if up
        else "The cameras do not agree on which way is up, or their photos are no longer in "
        f"{image_dir}, so the axes stay as they were.",
    )
    frame = Frame(METRES, ("scale", "gravity") if up else ("scale",))
    measured = {"cameras_upright": up.number} if up else {}
    return {"frame": frame.to_json(), "alignment": measured}


def _gravity(model: pycolmap.Reconstruction, image_dir: Path) -> Gravity | None:
    """Return which way is up, as the EXIF data of the photos turn them, if these are there."""
    names = [model.images[i].name for i in model.reg_image_ids()]
    gone = {name for name in names if not is_readable(image_dir / name)}
    turned = {name: orientation(image_dir / name) for name in names if name not in gone}
    return gravity.find(model, turned, gone)
