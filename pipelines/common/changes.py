"""Options of pipelines.localize that change a map: photos to add and to remove."""

from pathlib import Path
from typing import Annotated

from hloc_reduce import maps
from hloc_reduce.localization import panoramas
from hloc_reduce.maps.map import Map
from hloc_reduce.utils import cli
from hloc_reduce.utils import masks as masks_of
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.images import list_images
from hloc_reduce.utils.options import HIDDEN
from hloc_reduce.utils.parsers import image_names


def check(
    folder: Path | None,
    made_from: Path | None,
    add_images: Path | None,
    add_model: Path | None,
    refine_map: bool,
    **_: object,
) -> None:
    """Raise an InputError for options that do not go together.

    Args:
        folder: of the map.
        made_from: photos or database to build a map from.
        add_images: folder of photos to add.
        add_model: COLMAP model of their poses.
        refine_map: also adjust the poses of the photos that are in the map.
    """
    if add_images is None and (add_model is not None or refine_map):
        raise InputError(
            "--add_model and --refine_map are for photos that are added: --add_images."
        )
    if folder is not None and maps.is_compact(folder):
        raise InputError(
            f"--map {folder} is a compact map, which cannot be changed: add photos to the map "
            "that it was made from, or remove them there, and pack that again: --map FOLDER "
            f"--compact {folder}"
        )
    if folder is None or made_from:
        raise InputError(
            "--add_images and --remove_images change a map that was built before: give its folder, "
            "--map, without --map_images and --database."
        )
    if add_images is not None and add_images.is_dir():
        found = panoramas.find(add_images, list_images(add_images), given=False)
        if found:
            raise InputError(
                f"Panoramas cannot be added to a map: leave {cli.some(found)} out of {add_images}."
            )


def main(
    folder: Annotated[Path, HIDDEN],
    add_images: Path | None = None,
    add_model: Path | None = None,
    refine_map: bool = False,
    remove_images: Path | None = None,
    masks: Path | None = None,
) -> None:
    """Remove photos from a map, and add others.

    Args:
        folder: of the map.
        add_images: folder of photos to add to `map`, a map that was built before.
        add_model: COLMAP model with the poses of `add_images` in the frame of the map, which are
            kept; default: the photos are localized in the map.
        refine_map: also adjust the poses of the photos that are already in the map.
        remove_images: text file of the names of photos to remove from `map`.
        masks: of `add_images`.

    Raises:
        InputError: see `maps.add` and `maps.remove`.
    """
    built = Map(folder)
    if remove_images is not None:
        names = image_names(remove_images)
        # if a run that adds others is repeated, they are gone
        if add_images is None or not {*names}.isdisjoint(built.names()):
            built = maps.remove(built, names)
            print(f"Photos left in the map {folder}: {built.num_images}.")
    if add_images is not None:
        before = built.num_images
        masks = masks_of.those_of(masks, add_images)
        built = maps.add(built, add_images, add_model, refine_map=refine_map, masks=masks)
        added = built.num_images - before
        print(f"Photos added to the map {folder}: {added}. It has {built.num_images} now.")
