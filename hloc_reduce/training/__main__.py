"""Train a projection on COLMAP maps.

Extracts, matches and triangulates the images of each map with the poses of its model, and learns
from the tracks.
"""

import argparse
import hashlib
import json
from pathlib import Path

from .. import cli, logger, projections
from ..cli import InputError
from ..descriptors import DESCRIPTORS, DIM
from ..versions import versions
from . import pca, sv, tracks

SCHEMES = {"pca": pca, "sv": sv}


def main(
    maps: dict[str, tuple[Path, Path]],
    descriptor: str,
    scheme: str,
    dims: list[int],
    output: Path,
    cache: Path,
    recipe: str = "best",
    seed: int = 0,
) -> list[Path]:
    """Train the projections of a descriptor to some dimensions.

    Args:
        maps: from the name of each map to the folders of its images and its COLMAP model.
        descriptor: base descriptor.
        scheme: a key of `SCHEMES`.
        dims: numbers of output dimensions.
        output: folder for `<descriptor>_<scheme><dim>.safetensors`.
        cache: folder for what is computed of the maps, used again by later trainings.
        recipe: "best", or "paper" for its losses, layers and hyper-parameters.
        seed: of everything random.

    Returns:
        The files.

    Raises:
        InputError: when a map cannot be used.
    """
    paths = [output / f"{descriptor}_{scheme}{dim}.safetensors" for dim in dims]
    files = {
        name: tracks.main(images, model, cache / name, descriptor, seed)
        for name, (images, model) in maps.items()
    }
    checksums = {name: checksum(file) for name, file in files.items()}
    data = [tracks.load(file) for file in files.values()]
    trainer = SCHEMES[scheme]
    for dim, path in zip(dims, paths, strict=True):
        metadata = {
            "descriptor": descriptor,
            "scheme": scheme,
            "dim": dim,
            "training_data": {
                name: {
                    "points": part.num_tracks,
                    "observations": len(part.track),
                    "sha256": checksums[name],
                }
                for name, part in zip(files, data, strict=True)
            },
            "recipe": {"name": recipe, **trainer.RECIPES[recipe]},
            "seed": seed,
            "versions": versions(),
        }
        if path.exists():
            before = projections.load(path).metadata
            if {key: before.get(key) for key in metadata} == metadata:
                logger.info("%s is there already.", path)
                continue
        checkpoint = path.with_suffix(".ckpt")
        mlp = trainer.train(
            data,
            dim,
            trainer.RECIPES[recipe],
            seed,
            checkpoint=checkpoint,
            made_from=json.dumps(metadata, sort_keys=True),
        )
        projections.save(mlp, metadata, path)
        checkpoint.unlink(missing_ok=True)
        logger.info("Saved %s.", path)
    return paths


def checksum(path: Path) -> str:
    """Return the sha256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def parse_maps(values: list[str]) -> dict[str, tuple[Path, Path]]:
    """Parse `images:model` pairs into name -> (images, model).

    A map is named after the folder that its images folder lies in.
    """
    maps = {}
    for value in values:
        images, separator, model = value.rpartition(":")
        if not separator:
            raise InputError(f"--map {value}: not of the form images:model.")
        images, model = Path(images), Path(model)
        for folder in (images, model):
            if not folder.is_dir():
                raise InputError(f"--map {value}: there is no folder {folder}.")
        name = images.resolve().parent.name
        if name in maps:
            raise InputError(f"--map {value}: another map is called {name} too.")
        maps[name] = images, model
    return maps


def _main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m hloc_reduce.training",
        description=__doc__,
        epilog="example: python -m hloc_reduce.training --descriptor sift --scheme sv --dim 64 "
        "--map town/images:town/sparse --output weights",
        formatter_class=cli.HelpFormatter,
    )
    parser.add_argument("--descriptor", default="sift", help="base descriptor")
    parser.add_argument("--scheme", default="sv", help=f"one of {', '.join(SCHEMES)}")
    parser.add_argument("--dim", type=int, nargs="+", default=[64], help="output dimensions")
    parser.add_argument(
        "--map",
        action="append",
        required=True,
        metavar="IMAGES:MODEL",
        help="folder of images and folder of their COLMAP model; may be repeated",
    )
    parser.add_argument("--recipe", default="best", help="best or paper")
    parser.add_argument(
        "--output", type=Path, default=Path("outputs/training"), help="folder for the projections"
    )
    parser.add_argument(
        "--cache", type=Path, default=Path("outputs/training/maps"), help="folder for the tracks"
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of everything random")
    args = parser.parse_args()
    cli.choose("descriptor", args.descriptor, DESCRIPTORS)
    trainer = SCHEMES[cli.choose("scheme", args.scheme, SCHEMES)]
    cli.choose("recipe", args.recipe, trainer.RECIPES)
    for dim in args.dim:
        if not 0 < dim <= DIM:
            raise InputError(f"--dim {dim}: choose 1 to {DIM}.")
    main(
        parse_maps(args.map),
        args.descriptor,
        args.scheme,
        args.dim,
        args.output,
        args.cache,
        args.recipe,
        args.seed,
    )


if __name__ == "__main__":
    cli.run(_main)
