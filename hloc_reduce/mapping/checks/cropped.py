"""Photos that were cropped, by their EXIF data or shape."""

from collections.abc import Iterable

from ...localization.exif import exif_camera
from ..findings import Finding
from .inputs import Inputs


def find(inputs: Inputs) -> list[Finding]:
    """Find the photos that were cropped, or stretched."""
    if inputs.image_dir is None:
        return []
    found = {name: exif_camera(inputs.image_dir / name) for name in inputs.names}
    names = [name for name, exif in found.items() if exif is not None and exif.cropped]
    return [finding(names)] if names else []


def finding(names: Iterable[str]) -> Finding:
    """Return the finding for photos that were cropped or stretched."""
    text = (
        "The map may be wrong. Photos that are square, or whose width and height have another "
        "ratio than their EXIF data say: {names}. They were cropped or stretched, perhaps by the "
        "camera, so their principal points are not known: use the original photos."
    )
    doubt = "photos that may be cropped or enlarged"
    return Finding("cropped", text, tuple(names), doubt=doubt)
