"""Options of pipelines.localize that put a map into metres."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from hloc_reduce import logger, maps
from hloc_reduce.localization import gps as gps_positions
from hloc_reduce.mapping.alignment import NotAligned
from hloc_reduce.maps import georeference
from hloc_reduce.maps.map import Map
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.options import HIDDEN, Option
from hloc_reduce.utils.videos import is_video


def check(
    gps: Path | None,
    scale: Sequence[str] | None,
    map_images: Path | None,
    folder: Path | None,
) -> None:
    """Raise an InputError for wrong options, before a map is built.

    Args:
        gps: as in `main`.
        scale: as in `main`.
        map_images: photos to build a map of.
        folder: model or map, as in `localize.open_map`.
    """
    if gps is not None and scale is not None:
        raise InputError("Give --gps or --scale, not both.")
    if (gps or scale) and folder is not None and maps.is_compact(folder):
        raise InputError(
            f"--map {folder} is a compact map, whose frame cannot be changed: put the map that it "
            "was made from into metres, and pack that again."
        )
    if gps is not None:
        gps_positions.read_csv(gps)
    if scale is not None:
        first, second, _ = georeference.parse_scale(scale)
        photos = None if map_images is None or is_video(map_images) else map_images
        for name in (first, second) if photos else ():
            if photos and not (photos / name).is_file():
                raise InputError(f"--scale: there is no photo {name} in {photos}.")


def main(
    built: Annotated[Map, HIDDEN],
    gps: Path | None = None,
    scale: Annotated[Sequence[str], Option(number=3, metavar="A.jpg B.jpg METRES")] | None = None,
    strict: Annotated[bool, HIDDEN] = True,
) -> Map:
    """Put a map into metres, if an option says how, and return it.

    Args:
        built: the map.
        gps: CSV file with the columns name, latitude, longitude (degrees, WGS84) and altitude
            (metres, may be empty) of map photos, to put the map into metres east, north and up;
            default: a new map of photos alone has the GPS of their EXIF data.
        scale: two map photos and the distance between their cameras in metres, to put the map into
            metres.
        strict: raise an error, rather than warn, if the positions do not tell the frame.

    Raises:
        InputError: see `maps.align`.
    """
    if gps is None and scale is None:
        return built
    try:
        return maps.align(built, gps, scale)
    except NotAligned as error:
        said = f"The map {built.folder} is not aligned with {gps}. {error}"
        if strict:
            raise InputError(said) from None
        logger.warning("%s %s.", said, georeference.HELP)
        return built
