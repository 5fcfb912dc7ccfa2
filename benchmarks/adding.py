"""Compare adding photos to a map of photos alone with building maps of them, in one thread.

Of the first photos of a place by name, the last 20 are added to a map of the others; a map of all
is built at once, and one of the last 20 alone. A similarity aligns the positions of a map with the
given ones. Adds rows to results/adding.csv, leaving out places that have rows unless --again is
given; position errors are in percent of the largest distance between two given positions.
"""

import os
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pycolmap

from benchmarks import rows
from benchmarks.photos_alone import link, measured
from hloc_reduce import logger, maps
from hloc_reduce.confs import features as features_confs
from hloc_reduce.maps import Map
from hloc_reduce.training.tracks import parse_maps
from hloc_reduce.utils import cli, colmap
from hloc_reduce.utils.cli import InputError

NAME = "adding"
NEW = 20  # photos
AT_ONCE, OTHERS, ALONE, ADDED = "at once", "others", "alone", "added"  # variants


def compared(
    photos: Path, names: list[str], reference: pycolmap.Reconstruction, folder: Path, feature: str
) -> Iterator[dict[str, object]]:
    """Yield a row for each map.

    Args:
        photos: their folder.
        names: of the photos, the last ones of which are added.
        reference: a model with their poses.
        folder: of the maps.
        feature: of the maps.
    """
    shutil.rmtree(folder, ignore_errors=True)
    for variant, chosen in {AT_ONCE: names, OTHERS: names[:-NEW], ALONE: names[-NEW:]}.items():
        linked = link(photos, chosen, folder / f"photos-{variant}")
        measures = timed(
            lambda path=folder / variant, linked=linked: maps.main(
                path, linked, feature=feature, accept_partial=True
            ),
            reference,
        )
        yield {"variant": variant, "photos": len(chosen)} | measures
    measures = timed(lambda: maps.add(Map(folder / OTHERS), folder / f"photos-{ALONE}"), reference)
    yield {"variant": ADDED, "photos": len(names)} | measures


def timed(make: Callable[[], Map], reference: pycolmap.Reconstruction) -> dict[str, object]:
    """Make a map, and return its measures with the seconds that it took."""
    start, cpu = time.perf_counter(), time.process_time()
    try:
        built = make()
    except InputError as error:
        logger.error("%s", error)
        return {"registered": 0}
    seconds, cpu = time.perf_counter() - start, time.process_time() - cpu
    return measured(colmap.read_model(built.sfm), reference) | {"cpu_s": cpu} | rows.how(seconds, 1)


def _main() -> None:
    parser = cli.Parser(__doc__, "--map scenes/south-building/images:scenes/south-building/sparse")
    add = parser.add_argument
    add("--map", action="append", required=True, metavar="IMAGES:MODEL", help="may be repeated")
    add("--photos", type=int, default=0, help="of a place, the first by name; 0: all")
    add("--feature", default=features_confs.RECOMMENDED, help="name or YAML file")
    add("--outputs", type=Path, default=Path("outputs/adding"), help="folder of the maps")
    rows.add_again_option(parser)
    args = parser.parse_args()
    known = [] if args.again else rows.read(NAME)
    for place, (photos, model) in parse_maps(args.map).items():
        reference = colmap.read_model(model)
        names = sorted(image.name for image in reference.images.values())[: args.photos or None]
        if len(names) <= NEW:
            raise InputError(f"{place} has {len(names)} photos: more than {NEW} are needed.")
        cells = {"place": place, "list": f"{len(names)} photos", "feature": args.feature}
        if rows.select(known, **cells):
            continue
        folder = args.outputs / f"{place}-{len(names)}"
        found = [*compared(photos, names, reference, folder, args.feature)]
        rows.add(NAME, [cells | row for row in found])


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    cli.run(_main)
