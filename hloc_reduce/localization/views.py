"""How photos are shown to a feature that knows objects of one size, the right way up.

Networks find hardly a right match if objects are 2.5 times as large in one photo as in the other,
or turned by 90 degrees. So all photos of a place are shown at about one size, as EXIF data turn
them upright; where these do not tell, queries are tried in each of the four ways.
"""

from collections.abc import Collection, Iterable
from pathlib import Path

from ..utils.images import orientation
from .intrinsics import MapCameras

MOST_APART = 1.6  # ratio of sizes that networks match well
TURNS = (1, 3, 2)  # quarter turns, counterclockwise, that are tried: the likely ones first


def at_one_size(preprocessing: dict, sizes: Collection[tuple[int, int]]) -> dict:
    """Return the preprocessing of the photos of a map, and of all that are matched with these.

    Smaller photos are enlarged to the smallest of the map, and larger ones reduced to the largest.
    If sizes of the map's photos differ too much, all are shown at the size of their median.

    Args:
        preprocessing: of the feature's configuration.
        sizes: (width, height) of each photo of the map.
    """
    most = preprocessing.get("resize_max")
    is_given = "resize_min" in preprocessing or preprocessing.get("resize_force")
    if most is None or is_given or not sizes:
        return preprocessing
    seen = sorted(min(max(size), most) for size in sizes)
    if seen[-1] > MOST_APART * seen[0]:
        seen = [seen[len(seen) // 2]]
    return {**preprocessing, "resize_min": seen[0], "resize_max": seen[-1]}


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
