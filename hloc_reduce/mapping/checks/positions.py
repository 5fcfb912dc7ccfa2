"""Photos whose positions the points of a map hardly determine."""

import copy
from collections import Counter

import numpy as np
import pycolmap

from ...localization import intrinsics
from ...localization.exif import WELL_KNOWN
from ...localization.measures import INDEPENDENT_IF_BENT, uncertainty
from ...localization.projection import FOCAL, POSE
from ...utils import cli, colmap
from ..adjustment import ESTIMATED_MODELS, MAX_ADJUSTED_IMAGES, focal_length_deviations
from ..findings import PHOTOS_NAMED, Finding
from .inputs import Inputs

# Photos whose focal lengths a map determines to 2 to 7 % were 5 to 37 % off: the points of a bent
# map err together, so that its photos are off by a multiple of what independent errors explain.
BENT_TOGETHER = 2.5
MAX_DEVIATION = 0.05  # of a position, as a share of the distance
# The adjustment is repeated without up to so many photos; if it stays singular, all are uncertain.
# A bound on work: of ten public maps one is singular, by one photo.
MOST_SINGULAR = 5
VAGUE_FOCAL_SHARE = 0.1  # photos whose points tell it less are not tried with others
# Share of the photos: a map with at least as many uncertain ones is refused. Of 28 photos localized
# in maps of tourists' photos with a fifth of them 8 were wrong, of 24 in those with a tenth 1, and
# of 30 in maps with a typical lens none.
MANY_UNCERTAIN_SHARE = 0.1
HELP = (
    "More photos between them and the others help, or intrinsics: a COLMAP model, EXIF data, or "
    "--camera_mode single --overwrite if one camera with a fixed zoom took all."
)


def find(inputs: Inputs) -> list[Finding]:
    """Find the photos whose positions are uncertain, see `measure`.

    A map with many is refused. Photos with cameras of their own and a typical lens do not count:
    their focal lengths, estimated one by one, agree.
    """
    uncertain = measure(inputs.model)
    cameras = {image.name: inputs.model.cameras[image.camera_id] for image in inputs.images}
    typical = inputs.typical
    if typical is None:
        typical = intrinsics.of_cameras(cameras.values()).typical
    taken = Counter(camera.camera_id for camera in cameras.values())
    counted = {}
    for name, share in uncertain.items():
        camera = cameras[name]
        is_known = taken[camera.camera_id] >= WELL_KNOWN
        if is_known or (camera.width, camera.height) not in typical:
            counted[name] = share
    if counted and len(counted) >= MANY_UNCERTAIN_SHARE * len(cameras):
        return [_many(uncertain, counted, len(cameras))]
    return [finding(uncertain)] if uncertain else []


def finding(uncertain: dict[str, float]) -> Finding:
    """Return the finding for photos, and the shares by which their positions are uncertain."""
    text = (
        f"The positions of these photos are uncertain by more than {100 * MAX_DEVIATION:.0f} % of "
        f"their distance: {_named(uncertain)}. Queries near them may be localized as far off. "
        f"{HELP}"
    )
    return Finding("positions", text, tuple(uncertain), uncertain, "warn", _DOUBT)


_DOUBT = "photos whose positions are uncertain"


def _many(uncertain: dict[str, float], counted: dict[str, float], number: int) -> Finding:
    text = (
        f"The map may be wrong: the positions of {len(counted)} of its {number} photos are "
        f"uncertain by more than {100 * MAX_DEVIATION:.0f} % of their distance: "
        f"{_named(counted)}. {HELP}"
    )
    return Finding("positions", text, tuple(uncertain), uncertain, "refuse", _DOUBT)


def _named(uncertain: dict[str, float]) -> str:
    named = [
        f"{name} ({'at least ' * (share == 1)}{100 * share:.0f} %)"
        for name, share in uncertain.items()
    ]
    return cli.some(named, PHOTOS_NAMED)


def measure(sfm: pycolmap.Reconstruction) -> dict[str, float]:
    """Find photos whose positions are less certain than `MAX_DEVIATION`.

    A distant photo of a nearly flat scene hardly tells a longer focal length from a larger
    distance; and neither do all photos of such a scene together, if each has its own camera. So a
    photo is tested with its points taken for known, and with nothing taken for known. If its camera
    took several photos, only the first test is made, with known intrinsics. A single photo can make
    the adjustment singular; the second test is then repeated without the least certain photos.

    Args:
        sfm: the map, whose intrinsics were estimated with its poses.

    Returns:
        From name to the standard deviation of the position, at most 1, as a share of the median
        depth of the points that the photo sees; the least certain first.
    """
    images = [sfm.images[i] for i in sfm.reg_image_ids()]
    taken = Counter(image.camera_id for image in images)
    several = {camera_id for camera_id, number in taken.items() if number >= WELL_KNOWN}
    found, focal_lengths = {}, {}
    for image in images:
        points2D, points3D = colmap.observed(sfm, image)
        camera = sfm.cameras[image.camera_id]
        freedom = POSE if image.camera_id in several else FOCAL
        own = uncertainty(
            points2D, points3D, image.cam_from_world(), camera, freedom, INDEPENDENT_IF_BENT
        )
        found[image.name] = own.position
        focal_lengths[image.name] = own.focal_length if own.position < 1 else np.inf
    if len(images) <= MAX_ADJUSTED_IMAGES:
        deviations = _deviations(sfm, focal_lengths)
        for image in images:
            if image.name in deviations and image.camera_id not in several:
                together = BENT_TOGETHER * deviations[image.name]
                found[image.name] = max(found[image.name], together)
    frames = {image.name: image.frame_id for image in images}
    least: dict[int, float] = {}  # photos that a rig took at one moment are placed by the best one
    for name, share in found.items():
        least[frames[name]] = min(share, least.get(frames[name], np.inf))
    found = {name: least[frames[name]] for name in found}
    uncertain = {name: min(share, 1.0) for name, share in found.items() if share > MAX_DEVIATION}
    return dict(sorted(uncertain.items(), key=lambda item: -item[1]))


def _deviations(sfm: pycolmap.Reconstruction, alone: dict[str, float]) -> dict[str, float]:
    """Return how precisely an adjustment determines focal lengths, see `focal_length_deviations`.

    Args:
        sfm: the map.
        alone: the deviation of the focal length of each photo, with its points known.

    Returns:
        From name to the deviation, infinite for photos that make the adjustment singular; without
        those that are vague alone, and those whose cameras are known.
    """
    cameras = {
        image.name: image.camera_id
        for image in sfm.images.values()
        if sfm.cameras[image.camera_id].model in ESTIMATED_MODELS
    }
    vague = [name for name in alone if not alone[name] < VAGUE_FOCAL_SHARE]
    others = sorted(alone.keys() - {*vague}, key=lambda name: (-alone[name], name))
    uncertain = [name for name in others if name in cameras]
    for number in range(min(MOST_SINGULAR + 1, len(uncertain) + 1, len(others) - 1)):
        deviations = focal_length_deviations(_without(sfm, vague + uncertain[:number]))
        if not (deviations and np.isinf([*deviations.values()]).all()):
            found = {name: deviations[cameras[name]] for name in uncertain[number:]}
            return dict.fromkeys(uncertain[:number], np.inf) | found
    return dict.fromkeys(uncertain, np.inf) if len(others) > 1 else {}


def _without(sfm: pycolmap.Reconstruction, names: list[str]) -> pycolmap.Reconstruction:
    """Return a model without some of its photos, whose parameters would make others uncertain."""
    if not names:
        return sfm
    rest = colmap.remove_images(copy.deepcopy(sfm), names)
    # COLMAP computes no covariance of a model with frames that have no pose
    return colmap.with_cameras(
        rest, lambda image_id: copy.deepcopy(sfm.cameras[sfm.images[image_id].camera_id])
    )
