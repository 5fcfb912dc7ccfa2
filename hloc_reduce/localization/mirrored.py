"""Tell mirrored photos, which may have a wrong pose on a symmetric facade, from others.

The mirror image of a symmetric facade looks much like the facade itself, so that many matches agree
with a wrong pose. Far more agree with that of the photo as it was taken, unless the map lacks the
wing that it shows. So a query is mirrored and localized again, and trusted only if its mirror image
has a much lower confidence. Right poses of high confidence, with which most matches agree, need no
such test.
"""

import copy
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap

from .intrinsics import from_list, to_list

SIDED = ("p2", "sx1", "p0", "s0", "s1")  # parameters of OpenCV's models and of Aria's

# from names of queries to files of the features and of the matches of their mirror images
MirrorImages = Callable[[list[str]], tuple[Path, Path]]


def mirror(camera: pycolmap.Camera) -> pycolmap.Camera:
    """Return the intrinsics of a mirrored photo."""
    mirrored = copy.deepcopy(camera)
    mirrored.principal_point_x = camera.width - camera.principal_point_x
    # these distortions move both sides of the image to the same one
    sided = [name.strip() in SIDED for name in camera.params_info.split(",")]
    mirrored.params = (np.where(sided, -1, 1) * mirrored.params).tolist()
    return mirrored


def mirror_options(options: dict) -> dict:
    """Return the options of a photo, see `lens_choice.estimate`, with mirrored lenses to try."""
    photo = options.get("photo", {})
    if "lenses" not in photo:
        return options
    lenses = [to_list(mirror(from_list(lens))) for lens in photo["lenses"]]
    return {**options, "photo": {**photo, "lenses": lenses}}
