"""What may be wrong with a map: one file for each check, and the table of all."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Literal

from ..findings import Finding
from . import (
    another_size,
    contradictions,
    copies,
    cropped,
    duplicates,
    few_points,
    focal_lengths,
    intrinsics,
    lenses,
    mirrored,
    misfits,
    misplaced,
    overlays,
    partial,
    positions,
    sizes,
)
from .inputs import Inputs, Localize

__all__ = ["CHECKS", "Check", "Inputs", "Localize", "judging", "run"]


@dataclass(frozen=True)
class Check:
    """A check of a map.

    Args:
        find: returns what it found; nothing if what it needs is absent.
        needs: the attributes of `Inputs` that it needs beside the model.
        judges: which finished maps it judges: all; those whose poses were "estimated" from photos
            alone; or none, because its findings are known before the map is finished.
    """

    find: Callable[[Inputs], list[Finding]]
    needs: tuple[str, ...] = ()
    judges: Literal["all", "estimated", "none"] = "all"


# by the kind of their findings
CHECKS = {
    "partial": Check(partial.find, ("registration",), "estimated"),
    "focal_lengths": Check(focal_lengths.find, ("registration",), "estimated"),
    "misfits": Check(misfits.find, ("verified",), "estimated"),
    "positions": Check(positions.find, (), "estimated"),
    "intrinsics": Check(intrinsics.find, (), "none"),
    "cropped": Check(cropped.find, ("image_dir",), "estimated"),
    "contradictions": Check(contradictions.find, ("verified",)),
    "copies": Check(copies.find),
    "duplicates": Check(duplicates.find, ("image_dir",)),
    "another_size": Check(another_size.find, ("image_dir",), "none"),
    "sizes": Check(sizes.find, ("image_dir",), "none"),
    "mirrored": Check(mirrored.find, ("localize",), "none"),
    "lenses": Check(lenses.find, (), "none"),
    "misplaced": Check(misplaced.find, ("verified",), "none"),
    "few_points": Check(few_points.find, (), "none"),
    "overlays": Check(overlays.find, ("verified",), "none"),
}


def run(inputs: Inputs, kinds: Iterable[str] | None = None) -> list[Finding]:
    """Return what the checks of some kinds find, by default all."""
    return [one for kind in kinds or CHECKS for one in CHECKS[kind].find(inputs)]


def judging(are_poses_estimated: bool) -> list[str]:
    """Return the kinds of checks that judge a finished map."""
    judges = {"all", "estimated"} if are_poses_estimated else {"all"}
    return [kind for kind, check in CHECKS.items() if check.judges in judges]
