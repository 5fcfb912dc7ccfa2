"""Tell what is doubtful in a COLMAP model: misplaced, mirrored or cropped photos, wrong lenses, ...

The more is given, the more is checked: by the model alone how photos share points and fit them; by
its database how matches fit the poses; by the photos their sizes and EXIF data.
"""

from collections.abc import Collection, Iterable
from contextlib import suppress
from functools import cache
from json import dumps
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import pycolmap

from . import aggregate_features, from_colmap
from .confs import features as features_confs
from .confs import retrieval as retrieval_confs
from .mapping.checks import CHECKS, Inputs, Localize, run
from .mapping.checks.focal_lengths import are_alike
from .mapping.findings import Finding
from .mapping.plausibility import focal_length_spread
from .mapping.registration import Registration
from .maps.by_others import ByOthers
from .reduce import Reduction
from .utils import cli, colmap, options
from .utils.cli import InputError
from .utils.colmap import StoredDatabase
from .utils.files import replacing
from .utils.options import Option
from .utils.paths import strings_as_paths

FEATURE = "colmap_sift"  # whose descriptors are in databases
DATABASE_OPTION, IMAGES_OPTION = "--database", "--images"
SIFT_NEEDED = "SIFT descriptors in the database"
# attributes of `Inputs`, and what tells them
TOLD_BY = {
    "verified": {DATABASE_OPTION},
    "cameras": {DATABASE_OPTION},
    "registration": {DATABASE_OPTION},
    "image_dir": {IMAGES_OPTION},
    "localize": {DATABASE_OPTION, IMAGES_OPTION},
}


@strings_as_paths
def main(
    model: Annotated[Path, Option(flags=("model",))],
    database: Path | None = None,
    images: Path | None = None,
    json: Annotated[Path, Option(metavar="FILE")] | None = None,
) -> tuple[list[Finding], dict[str, set[str]]]:
    """Check a COLMAP model.

    Args:
        model: folder of a COLMAP model, with points.
        database: COLMAP database that it was made from.
        images: folder of its photos.
        json: file to write the findings to.

    Returns:
        What was found; and from the kinds of checks that were not possible to what these lack.

    Raises:
        InputError: if something is missing or broken, or the database is of another model.
    """
    if json is not None:
        cli.check_file(json, "a file for the findings")
    found, lacking = _check(model, database, images)
    if json is not None:
        write(found, json)
    return found, lacking


def write(findings: Iterable[Finding], path: Path) -> None:
    """Write findings into a JSON file."""
    content = [one.to_json() | {"text": one.message} for one in findings]
    with replacing(path) as temporary:
        temporary.write_text(dumps(content, indent=2, allow_nan=False))


def _check(
    model: Path, database: Path | None, images: Path | None
) -> tuple[list[Finding], dict[str, set[str]]]:
    reference = colmap.read_model(model)
    if not reference.num_points3D():
        raise InputError(f"The model {model} has no points: give one that COLMAP reconstructed.")
    inputs = Inputs(reference, image_dir=images)
    if images is not None:
        _check_images(images, inputs.names)
    if database is None:
        return _run(inputs)
    with colmap.open_stored(database) as opened, TemporaryDirectory() as folder:
        from_colmap.check_model(opened, reference)
        verified, cameras = opened.verified(), opened.cameras()
        known = _registration(opened, reference, verified, cameras)
        localize = None if images is None else _by_others(opened, reference, images, Path(folder))
        given = reference, verified, None, images, cameras, known, None, localize
        return _run(Inputs(*given, matched=opened.matched() or None))


def _run(inputs: Inputs) -> tuple[list[Finding], dict[str, set[str]]]:
    """Run the checks that are possible; return also what the others lack."""
    told = {DATABASE_OPTION: inputs.verified, IMAGES_OPTION: inputs.image_dir}
    given = {option for option, value in told.items() if value is not None}
    lacking: dict[str, set[str]] = {}
    for kind, check in CHECKS.items():
        absent = [need for need in check.needs if getattr(inputs, need) is None]
        if absent:
            told_by = set().union(*(TOLD_BY[need] for need in absent))
            lacking[kind] = told_by - given or {SIFT_NEEDED}
    found = run(inputs, [kind for kind in CHECKS if kind not in lacking])
    return found, lacking


def _check_images(images: Path, names: list[str]) -> None:
    """Raise an InputError for a folder that has none of the photos of a model."""
    if not images.is_dir():
        raise cli.no_folder(images)
    if not any((images / name).is_file() for name in names):
        raise InputError(
            f"{images} has none of the {len(names)} images of the model, such as {names[0]}: "
            "choose another --images, or leave it out."
        )


def _registration(
    database: StoredDatabase,
    model: pycolmap.Reconstruction,
    verified: Iterable[tuple[str, str]],
    cameras: dict[int, pycolmap.Camera],
) -> Registration:
    """Return which images of a database are in a model."""
    inside = {model.images[i].name for i in model.reg_image_ids()}
    matched = {name for pair in verified for name in pair}
    return Registration(
        images=len(database.images),
        parts=[sorted(inside)],
        missing=sorted({*database.images} - inside),
        unmatched=sorted({*database.images} - matched),
        dropped=[],
        alike=are_alike(cameras.values()),
        spread=focal_length_spread([model]),
    )


def _by_others(
    database: StoredDatabase, model: pycolmap.Reconstruction, images: Path, folder: Path
) -> Localize | None:
    """Return what localizes photos by others, None if the database has no descriptors of SIFT."""
    reduction, (_, conf) = Reduction(FEATURE), features_confs.get(FEATURE)
    names: list[str] = []
    with suppress(InputError):
        names = from_colmap.check(database, reduction, None)
    if not names:
        return None

    @cache  # few models have photos to be localized
    def prepared() -> ByOthers:
        features = folder / f"{conf['output']}.h5"
        from_colmap.write(database, features, reduction, names, {})
        vlad = retrieval_confs.get(retrieval_confs.VLAD)
        descriptors = aggregate_features.main(vlad, features, names)
        matcher = features_confs.matcher_of(conf)
        mirrored = folder / "mirrored"
        return ByOthers(model, conf, matcher, images, features, descriptors, mirrored, vlad)

    def localize(names: Collection[str], by: Collection[str], mirrored: bool) -> dict[str, dict]:
        return prepared()(names, by, mirrored)

    return localize


def report(findings: list[Finding], lacking: dict[str, set[str]]) -> str:
    """Return what to print: a paragraph for each finding, and how much was not possible."""
    paragraphs = [f"{one.kind}: {one.message}" for one in findings]
    nothing = "Nothing else" if findings else "Nothing"
    summary = f"{nothing} doubtful was found by {len(CHECKS) - len(lacking)} checks"
    if lacking:
        were = "1 was" if len(lacking) == 1 else f"{len(lacking)} were"
        absent = sorted(set().union(*lacking.values()))
        summary += f"; {were} not possible without {' / '.join(absent)}"
    return "\n\n".join([*paragraphs, f"{summary}."])


def _main() -> None:
    example = "sparse/0 --database database.db --images photos"
    print(report(*options.call(main, __doc__, example)))


if __name__ == "__main__":
    cli.run(_main)
