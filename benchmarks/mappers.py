"""Compare COLMAP's incremental mapper with its global one on the same verified matches.

Builds a map of the photos of each place without their poses, whose database all mappers then read,
in one thread: the incremental one as few photos are mapped, and with the rare adjustments of many
photos of one camera; and the global one, which needs COLMAP 4. A similarity aligns the positions of
the largest model with the given ones. Adds rows to results/mappers.csv, leaving out what has rows
unless --again is given; position errors are in percent of the largest distance between two given
positions, and `seconds` and `cpu_s` those of the mapper.
"""

import os
import shutil
import time
from functools import partial
from pathlib import Path

import pycolmap

from benchmarks import rows
from benchmarks.photos_alone import link, measured
from hloc_reduce import maps
from hloc_reduce.confs import features as features_confs
from hloc_reduce.mapping.adjustment import adjust
from hloc_reduce.mapping.mapper import RARE_ADJUSTMENTS
from hloc_reduce.reconstruction import MAPPER_OPTIONS
from hloc_reduce.training.tracks import parse_maps
from hloc_reduce.utils import cli, colmap
from hloc_reduce.utils.cli import InputError

NAME = "mappers"

Models = dict[int, pycolmap.Reconstruction]


def incremental(changed: dict, database: Path, photos: Path, output: Path) -> Models:
    """Reconstruct photos as maps of photos alone are, in one attempt, with changed options."""
    options = colmap.mapper_options(MAPPER_OPTIONS | changed)
    models = pycolmap.incremental_mapping(database, photos, output, options=options)
    for model in models.values() if changed else ():
        adjust(model, options)
    return models


def global_(database: Path, photos: Path, output: Path) -> Models:
    """Reconstruct photos by GLOMAP, as COLMAP has it since version 4."""
    options = pycolmap.GlobalPipelineOptions()
    for part in (options, options.mapper):
        part.num_threads, part.random_seed = 1, 0
    return pycolmap.global_mapping(database, photos, output, options)


MAPPERS = {
    "incremental": partial(incremental, {}),
    "incremental, rare adjustments": partial(incremental, RARE_ADJUSTMENTS),
    "global": global_,
}


def _main() -> None:
    parser = cli.Parser(__doc__, "--map scenes/fox/images:scenes/fox/sparse")
    add = parser.add_argument
    add("--map", action="append", required=True, metavar="IMAGES:MODEL", help="may be repeated")
    add("--feature", default=features_confs.RECOMMENDED, help="name or YAML file")
    add("--database", type=Path, help="of a map of these photos; default: build one")
    add("--single", action="store_true", help="one camera took all photos of each place")
    add("--mapper", nargs="+", default=[*MAPPERS], choices=[*MAPPERS])
    add("--outputs", type=Path, default=Path("outputs/mappers"))
    rows.add_again_option(parser)
    args = parser.parse_args()
    if args.database and len(args.map) > 1:
        raise InputError("--database is of one --map.")
    if "global" in args.mapper and not hasattr(pycolmap, "global_mapping"):
        raise InputError("pycolmap has no global mapper: choose --mapper, or install version 4.2.")
    known = [] if args.again else rows.read(NAME)
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.FATAL)
    for place, (images, model) in parse_maps(args.map).items():
        listed = "one camera" if args.single else ""
        cells = {"place": place, "list": listed, "feature": args.feature}
        todo = [one for one in args.mapper if not rows.select(known, **cells, variant=one)]
        if not todo:
            continue
        reference = colmap.read_model(model)
        names = sorted(image.name for image in reference.images.values())
        folder = args.outputs / f"{place}-{Path(args.feature).stem}{'-single' * args.single}"
        photos = link(images, names, folder / "photos")
        verified = args.database
        if verified is None:
            mode = pycolmap.CameraMode.SINGLE if args.single else pycolmap.CameraMode.AUTO
            options = {"feature": args.feature, "accept_partial": True, "camera_mode": mode}
            built = maps.main(folder / "map", photos, **options)
            verified = built.sfm / "database.db"
        for mapper in todo:
            output = folder / mapper
            shutil.rmtree(output, ignore_errors=True)
            output.mkdir()
            database = Path(shutil.copy(verified, folder / f"{mapper}.db"))
            start, cpu = time.perf_counter(), time.process_time()
            models = MAPPERS[mapper](database, photos, output)
            seconds, cpu = time.perf_counter() - start, time.process_time() - cpu
            found = max(models.values(), key=lambda one: one.num_reg_images(), default=None)
            measures = {"registered": 0} if found is None else measured(found, reference)
            how = {"photos": len(names), "cpu_s": cpu} | rows.how(seconds, cores=1)
            rows.add(NAME, [cells | {"variant": mapper} | measures | how])


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    cli.run(_main)
