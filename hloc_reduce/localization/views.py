"""How photos are shown to a feature that knows objects of one size, the right way up.

Networks find hardly any right matches if objects are 2.5 times as large in one photo as in the
other, or turned by 90 degrees. So all photos of a place are shown at about one size, as EXIF data
turn them upright. A query that is not localized is shown in other ways: one that was enlarged, as
it is, as it may be a part of a photo; and one whose EXIF data do not tell which side is up, turned.
"""

from collections.abc import Collection, Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..utils.images import orientation, stored_size
from .intrinsics import MapCameras

MOST_APART = 1.6  # ratio of sizes that networks match well


class View(NamedTuple):
    """A way to show a photo.

    Args:
        turns: quarter turns, counterclockwise, beyond those by EXIF data.
        own_size: whether it is not enlarged.
    """

    turns: int = 0
    own_size: bool = False

    @property
    def name(self) -> str:
        """What names of files say."""
        return "own-size" if self.own_size else f"turned{90 * self.turns}"

    @property
    def how(self) -> dict[str, int]:
        """Changes of the preprocessing of a feature, see `utils.images.resized`."""
        return {"turns": self.turns} | ({"resize_min": 0} if self.own_size else {})


USUAL, OWN_SIZE = View(), View(own_size=True)
TURNED = View(1), View(3), View(2)  # the likely ones first


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


def for_retrieval(conf: dict, turns: int, preprocessing: dict) -> dict:
    """Return the configuration of a retrieval that sees turned photos as the local feature does.

    Args:
        conf: the configuration.
        turns: of the photos, see `View`.
        preprocessing: of the local feature.
    """
    upright = preprocessing.get("upright", False)
    return shown(conf, turns=turns, upright=upright) if turns else conf


def others(image: Path | np.ndarray, of_map: MapCameras, preprocessing: dict) -> list[View]:
    """Return the other ways to show a query that is not localized.

    Args:
        image: its file; or its pixels (H, W) or (H, W, 3), which are taken to be upright.
        of_map: what the map tells about its photos.
        preprocessing: of the map's photos.
    """
    size = stored_size(image) if isinstance(image, Path) else image.shape[1::-1]
    is_enlarged = size is not None and max(size) < preprocessing.get("resize_min", 0)
    found = [OWN_SIZE] if is_enlarged else []
    if isinstance(image, Path):
        is_known = orientation(image) is not None and of_map.orientations
        found += [] if is_known and preprocessing.get("upright") else TURNED
    return found


def of_folder(
    image_dir: Path, names: Iterable[str], of_map: MapCameras, preprocessing: dict
) -> dict[View, list[str]]:
    """Return which photos of a folder each other view is for, see `others`."""
    found = {name: others(image_dir / name, of_map, preprocessing) for name in names}
    views = {view: [name for name in found if view in found[name]] for view in (OWN_SIZE, *TURNED)}
    return {view: names for view, names in views.items() if names}
