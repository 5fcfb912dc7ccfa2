"""How queries are shown to a feature that knows objects of one size, the right way up.

Networks find hardly a right match if objects are 2.5 times as large as in the photos of the map, or
turned by 90 degrees. So queries are shown at the size of the map's photos, as EXIF data turn them
upright or, where these do not tell, in each of the four ways until one is localized.
"""

from collections.abc import Iterable
from pathlib import Path

from ..utils.images import orientation
from .intrinsics import MapCameras

TURNS = (1, 3, 2)  # quarter turns, counterclockwise, that are tried: the likely ones first


def at_map_size(preprocessing: dict, of_map: MapCameras) -> dict:
    """Return the preprocessing of queries, which shows them at the size of a map's photos.

    Queries that are smaller than all of these are enlarged to the smallest one, and queries that
    are larger are reduced to the largest.

    Args:
        preprocessing: of the feature's configuration.
        of_map: what the map tells about its photos.
    """
    longer = [max(size) for size in (*of_map.sizes, *of_map.lenses)]
    if not longer or preprocessing.get("resize_force"):
        return preprocessing
    most = preprocessing.get("resize_max") or max(longer)
    limits = {"resize_min": min(*longer, most), "resize_max": min(max(longer), most)}
    return {**preprocessing, **limits}


def shown(conf: dict, **how: object) -> dict:
    """Return a configuration, of local or global features, that shows photos in another way.

    Args:
        conf: the configuration, with `preprocessing`.
        how: changes of that, see `utils.images.resized`.
    """
    return {**conf, "preprocessing": {**conf.get("preprocessing", {}), **how}}


def other_turns(image: Path, of_map: MapCameras, preprocessing: dict) -> tuple[int, ...]:
    """Return the other ways to show a photo to a network, as quarter turns, counterclockwise.

    There are none if EXIF data tell how the photo and those of the map are turned.
    """
    is_known = orientation(image) is not None and of_map.orientations
    return () if is_known and preprocessing.get("upright") else TURNS


def of_folder(
    image_dir: Path, names: Iterable[str], of_map: MapCameras, preprocessing: dict
) -> dict[int, list[str]]:
    """Return the photos of a folder that each of the `TURNS` is another way to show."""
    found = {name: other_turns(image_dir / name, of_map, preprocessing) for name in names}
    turns = {turn: [name for name in found if turn in found[name]] for turn in TURNS}
    return {turn: of_turn for turn, of_turn in turns.items() if of_turn}
