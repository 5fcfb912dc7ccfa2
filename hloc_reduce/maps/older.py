"""Findings in map.json files of earlier versions, which had a field for each kind."""

from ..mapping.checks import (
    another_size,
    contradictions,
    cropped,
    focal_lengths,
    intrinsics,
    mirrored,
    misfits,
    partial,
    positions,
)
from ..mapping.findings import Finding

PHOTOS_OF = {  # the fields that list photos
    "images_fitting_badly": misfits,
    "images_cropped": cropped,
    "images_contradicting_others": contradictions,
    "images_unlike_others": another_size,
    "images_mirrored": mirrored,
}
FIELDS = (
    *PHOTOS_OF,
    "doubtful_focal_lengths",
    "images_of_uncertain_position",
    "gain_of_free_principal_points",
    "images_altered",
)


def findings_of(content: dict) -> list[Finding]:
    """Return what the fields of a map.json say.

    Raises:
        AttributeError, TypeError or ValueError: if they are wrong.
    """
    registered = int(content["images_with_pose"])
    found = partial.of_numbers(registered, int(content.get("images", registered)))
    if (factor := float(content.get("doubtful_focal_lengths", 1))) > 1:
        found.append(focal_lengths.finding(factor))
    shares = content.get("images_of_uncertain_position", {}).items()
    if uncertain := {str(name): min(float(share), 1.0) for name, share in shares}:
        found.append(positions.finding(uncertain))
    gain = float(content.get("gain_of_free_principal_points", 0))
    altered = list(content.get("images_altered", []))
    if altered or gain > intrinsics.GAIN_OF_FREE:
        found.append(intrinsics.finding(intrinsics.Fit(gain, altered)))
    for field, check in PHOTOS_OF.items():
        if names := list(content.get(field, [])):
            found.append(check.finding(names))
    return found
