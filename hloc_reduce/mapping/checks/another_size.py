"""Photos of another size than most by the same lens."""

from collections.abc import Iterable
from pathlib import Path

from ...localization.exif import WELL_KNOWN, exif_camera
from ..findings import Finding
from .inputs import Inputs


def find(inputs: Inputs) -> list[Finding]:
    """Find the photos whose size tells that their intrinsics are unlike those of most of a lens."""
    if inputs.image_dir is None:
        return []
    return of_photos(inputs.image_dir, inputs.names)


def of_photos(image_dir: Path, names: Iterable[str]) -> list[Finding]:
    """Find the photos of a folder whose size tells that they are unlike most of a lens.

    Most are those with one longer side, if they are more than half of the photos of the lens. One
    or two photos with another longer side are smaller copies or were cropped; `WELL_KNOWN` are
    another setting of the camera. Photos that were cropped by their EXIF data differ however many
    there are. Digital zooms, which EXIF data tell, do not count.
    """
    whole: dict[str, dict[int, list[str]]] = {}
    cut: dict[str, list[str]] = {}
    for name in names:
        exif = exif_camera(image_dir / name)
        if exif is not None and exif.cropped:
            cut.setdefault(exif.lens, []).append(name)
        elif exif is not None and not exif.zoomed:
            whole.setdefault(exif.lens, {}).setdefault(max(exif.size), []).append(name)
    found: list[str] = []
    for lens, sides in whole.items():
        most, cropped = max(map(len, sides.values())), cut.get(lens, [])
        if most >= WELL_KNOWN and 2 * most > sum(map(len, sides.values())) + len(cropped):
            few = [named for named in sides.values() if len(named) < WELL_KNOWN]
            found += sum(few, cropped)
    return [finding(sorted(found))] if found else []


def finding(names: Iterable[str]) -> Finding:
    """Return the finding for photos with another size, focal length or principal point."""
    text = (
        "These photos do not belong in the map, because their size, focal length or principal "
        "point is not that of the others: {names}. Either these or the others were cropped or "
        "resized: use photos as the camera took them."
    )
    doubt = "photos that may be cropped or enlarged"
    return Finding("another_size", text, tuple(names), {}, "drop", doubt)
