"""Photos of the demo town that are rendered and localized faster than those that ship."""

import copy
import dataclasses

from hloc_reduce.demo.cameras import Photo


def scaled(photo: Photo, width: int, height: int) -> Photo:
    """Return a photo of the demo town in another size."""
    camera = copy.deepcopy(photo.camera)
    camera.rescale(width, height)
    return dataclasses.replace(photo, camera=camera)
