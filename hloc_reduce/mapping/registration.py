"""Which images are in a model of photos alone, and why others are not."""

from collections.abc import Collection, Iterable
from dataclasses import dataclass
from pathlib import Path

from ..runtime import provenance
from ..utils.cli import InputError
from .findings import Finding

REGISTRATION = "registration.json"  # in the folder of a model
MIN_VIEWPOINTS = 3  # of a model: two do not determine the focal lengths


@dataclass(frozen=True)
class Registration:
    """Which images are in a model, and why others are not.

    Args:
        images: number of images that it was to have.
        parts: the images of each part that COLMAP reconstructed, the model first.
        missing: the images that are not in the model.
        unmatched: the images without verified matches.
        dropped: why images were dropped from the model.
        alike: each image has its own camera, but one camera may have taken all.
        spread: ratio of the largest and the smallest focal length of its images.
        attempts_left_out: number of attempts that were not made for lack of time.
        left_out: further images that it was not to have, for reasons that are reported elsewhere.
        file: the file that lists all names, if there is one.
    """

    images: int
    parts: list[list[str]]
    missing: list[str]
    unmatched: list[str]
    dropped: list[Finding]
    alike: bool
    spread: float = 1.0
    attempts_left_out: int = 0
    left_out: Collection[str] = ()
    file: Path | None = None

    @property
    def registered(self) -> int:
        """The number of images in the model."""
        return self.images - len(self.missing)

    def write(self, folder: Path) -> None:
        """Write it into the folder of the model."""
        content = {**vars(self), "dropped": [one.to_json() for one in self.dropped]}
        del content["left_out"], content["file"]
        provenance.write(folder / REGISTRATION, content)


def read(folder: Path, left_out: Collection[str] = ()) -> Registration:
    """Read what is in the folder of a model; `left_out` images it was not to have."""
    content = provenance.read(folder / REGISTRATION)
    content["dropped"] = [Finding.from_json(one) for one in content["dropped"]]
    return Registration(**content, left_out=left_out, file=folder / REGISTRATION)


class NoModelError(InputError):
    """No two images could be reconstructed."""


def check_number(image_dir: Path, number: int) -> None:
    """Raise a NoModelError for fewer images than a model has viewpoints."""
    if number < MIN_VIEWPOINTS:
        raise NoModelError(
            f"A map of photos alone needs {MIN_VIEWPOINTS} or more, from different places: "
            f"{number} {'image is' if number == 1 else 'images are'} given of {image_dir}. Fewer "
            "do not determine focal lengths. Take more photos, each overlapping the one before by "
            "two thirds, or give a COLMAP model of their poses."
        )


def nothing(image_dir: Path, dropped: Iterable[Finding] = (), attempts_left_out: int = 0) -> str:
    """Say that no image could be reconstructed, why images were dropped, and what to try."""
    why = " ".join(one.message for one in dropped) or "Do enough of them overlap?"
    tries = ["take photos from several places, each overlapping the one before by two thirds"]
    tries += more_time(attempts_left_out)
    return (
        f"COLMAP could not reconstruct the images of {image_dir} from {MIN_VIEWPOINTS} viewpoints "
        f"or more. {why} What to try: {'; '.join(tries)}."
    )


def more_time(attempts_left_out: int) -> list[str]:
    """Return what to try if attempts were left out."""
    if not attempts_left_out:
        return []
    return [
        "run again with --overwrite on a faster machine, or one that is idle, as attempts were "
        f"left out for lack of time: {attempts_left_out}"
    ]
