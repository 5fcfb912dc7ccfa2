"""The photos of maps of photos alone: taken by rigs, by lenses that options tell, or panoramas."""

from pathlib import Path
from typing import NamedTuple

from hloc_reduce.localization import panoramas
from hloc_reduce.localization.rigs import are_of, cameras_of
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.images import check_readable, list_images

VIEWS = "map-views"  # folder of the views of panoramas, in the outputs folder

# what options mean that only maps of photos alone have
REFUSALS = {
    "camera_mode": "--camera_mode is for maps of photos alone: leave it or --map out.",
    "camera_model": "--camera_model is for maps of photos alone: leave it or --map out.",
    "camera_params": "--camera_params are for maps of photos alone: leave them or --map out.",
    "pairs": "--pairs is for maps of photos alone: leave it or --map out.",
    "rigs": "--rigs is for queries and maps of photos alone: a COLMAP model has its own rigs. Give "
    "--query_images, or --map_images without --map.",
    "panoramas": "--panoramas is for queries and maps of photos alone: give --query_images, or "
    "--map_images without --map.",
}


class Special(NamedTuple):
    """Whether photos are panoramas, and the file of the rigs that took them, None without any."""

    panoramas: bool
    rigs: Path | None


def check(map_images: Path | None, model_or_map: Path | None, **options: object) -> None:
    """Raise an InputError for an option that only maps of photos alone have.

    Args:
        map_images: photos of the map.
        model_or_map: their model, or a map.
        options: those of `REFUSALS`, None or False if not given.
    """
    if map_images is not None and model_or_map is None:
        return
    for option, refusal in REFUSALS.items():
        if options.get(option):
            raise InputError(refusal)


def of_map(
    map_images: Path | None,
    model_or_map: Path | None,
    query_images: Path | None,
    rigs: Path | None,
    are_panoramas: bool,
) -> Special:
    """Return what options say of the photos of a map, as they may be for its queries only.

    Raises:
        InputError: as `rigs.read` and `panoramas.find`; or if no query is of a camera of `rigs`.
    """
    is_given = map_images is not None and model_or_map is None
    if query_images is None:
        return Special(are_panoramas, rigs)
    if rigs is not None and not are_of(rigs, list_images(query_images)):
        raise InputError(
            f"{rigs}: no photo is of a camera of a rig in {query_images}. If it is for the map "
            "only, build that first, without --query_images."
        )
    if map_images is None or not is_given:
        return Special(False, None)
    names = list_images(map_images)
    are_panoramas = bool(panoramas.find(map_images, names, are_panoramas))
    return Special(are_panoramas, rigs if rigs and are_of(rigs, names) else None)


def of_queries(
    query_images: Path, rigs: Path | None, are_panoramas: bool, of_map: Special
) -> Special:
    """Return what options say of the photos of queries; --panoramas may be for the map only."""
    names = list_images(query_images)
    if of_map.panoramas and not panoramas.find(query_images, names, given=True):
        are_panoramas = False
    return Special(are_panoramas, rigs)


def check_camera_mode(map_images: Path, rigs: Path, camera_mode: str | None) -> None:
    """Raise an InputError if a mode is given for photos that the cameras of rigs took, all of them.

    Args:
        map_images: folder of the photos.
        rigs: COLMAP's `rig_config.json`.
        camera_mode: which photos share a camera, None if not given.
    """
    names = list_images(map_images)
    if camera_mode and len(cameras_of(rigs, names)) == len(names):
        raise InputError(
            "--camera_mode is for photos that no camera of --rigs took: those of each such camera "
            "share its intrinsics. Leave out --camera_mode."
        )


def views(map_images: Path, outputs: Path, are_panoramas: bool) -> tuple[Path, Path] | None:
    """Write the views of the panoramas of a map, if its photos are panoramas.

    Args:
        map_images: folder of the photos.
        outputs: the views go to a folder in it.
        are_panoramas: photos that are twice as wide as high are panoramas.

    Returns:
        The folder of the views and the file of their rigs, None if the photos are no panoramas.

    Raises:
        InputError: as `panoramas.find`; or if none is a panorama, but `are_panoramas`; or one
            cannot be read.
    """
    names = list_images(map_images)
    sizes = panoramas.find(map_images, names, are_panoramas)
    if not sizes:
        if are_panoramas:
            raise InputError(panoramas.NONE.format(map_images))
        return None
    check_readable(map_images, [name for name in names if name not in sizes])
    return panoramas.write_rigs(map_images, sizes, outputs / VIEWS)
