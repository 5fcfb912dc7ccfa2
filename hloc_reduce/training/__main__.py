"""Train projections on COLMAP maps or on PhotoTour patches.

Extracts, matches and triangulates the images of each map with the poses of its model, and learns
from the tracks. A map of one's own that pipelines.localize built will do.
"""

import argparse
import json
from pathlib import Path

import torch

from .. import extractors, logger, projections
from ..confs import features as features_confs
from ..datasets import phototour as layout
from ..descriptors import BASES, COLMAP, DESCRIPTORS, DIM, check_weights
from ..evaluation import patch_verification as verification
from ..maps.map import Map, is_map
from ..projections import network
from ..runtime.versions import versions
from ..utils import cli
from ..utils.cli import InputError
from ..utils.files import file_sha256
from ..utils.paths import strings_as_paths
from . import nested, patch_tracks, pca, ss, sv, tracks, us

SCHEMES = {"pca": pca, "us": us, "ss": ss, "sv": sv, "nested": nested}
RECIPE_NAMES = ("best", "paper", "tune")
# hidden layers of projections of an extractor's own descriptors; COLMAP's are so soon computed that
# larger ones would take 5 % of the time
HIDDEN = {COLMAP: (256, 256)}
HIDDEN_BY_DEFAULT = (512, 512)


@strings_as_paths
def main(
    maps: dict[str, tuple[Path, Path]],
    sequences: list[Path],
    descriptor: str,
    scheme: str,
    dims: list[int],
    output: Path,
    cache: Path,
    recipe: str = "best",
    seed: int = 0,
    conf: dict | None = None,
) -> list[Path]:
    """Train the projections of a descriptor to some dimensions.

    Args:
        maps: from the name of each map to the folders of its images and its COLMAP model.
        sequences: folders of PhotoTour.
        descriptor: base descriptor, or what the projections of `conf` are called after.
        scheme: a key of `SCHEMES`.
        dims: numbers of output dimensions; not of "nested", which has its own.
        output: folder for `<descriptor>_<scheme><dim>.safetensors`.
        cache: folder for what is computed of maps and sequences, used again by later trainings.
        recipe: "best", "paper" for its losses, layers and hyper-parameters, or "tune" to begin
            with the projection that ships and learn what is particular to a place of one's own.
        seed: of everything random.
        conf: of a feature, to train projections of its descriptors on maps.

    Returns:
        The files.

    Raises:
        InputError: when a map or a sequence cannot be used, or has descriptors of fewer dimensions.
    """
    trainer, sequences = SCHEMES[scheme], [Path(folder) for folder in sequences]
    if trainer is nested:
        paths = {nested.PREFIXES[0]: output / f"{descriptor}_nested.safetensors"}
    else:
        paths = {dim: output / f"{descriptor}_{scheme}{dim}.safetensors" for dim in dims}
    base = {"descriptor": descriptor}
    if conf:
        base = {"descriptor": extractors.load(conf["model"]).descriptor, "base": conf}
    settings = {
        path: complete_recipe(scheme, recipe, base["descriptor"], path.stem)
        for path in paths.values()
    }
    files = {
        folder.resolve().name: patch_tracks.main(
            folder, cache / folder.resolve().name, descriptor, seed
        )
        for folder in sequences
    } | {
        name: tracks.main(images, model, cache / name, descriptor, seed, conf)
        for name, (images, model) in maps.items()
    }
    checksums = {name: file_sha256(file) for name, file in files.items()}
    data = [tracks.load(file) for file in files.values()]
    size = data[0].descriptors.shape[-1]
    if max(paths) > size:
        raise InputError(f"{descriptor} has {size} dimensions, which {max(paths)} do not reduce.")
    for dim, path in paths.items():
        metadata = {
            **base,
            "input": "descriptors of unit L2 norm",
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
            "recipe": {"name": recipe, **settings[path]},
            "seed": seed,
            "versions": versions(),
        }
        if path.exists():
            before = projections.load(path).metadata
            changed = [key for key in metadata if before.get(key) != metadata[key]]
            if not changed:
                logger.info("%s is there already.", path)
                continue
            raise InputError(
                f"{path} is there already, of another {' and '.join(changed)}. "
                "Choose another --output, or move it away."
            )
        checkpoint = path.with_suffix(".ckpt")
        mlp = trainer.train(
            data,
            dim,
            settings[path],
            seed,
            checkpoint=checkpoint,
            made_from=json.dumps(metadata, sort_keys=True),
        )
        network.save(mlp, metadata, path)
        for file in (checkpoint, ss.clusters_of(checkpoint)):
            file.unlink(missing_ok=True)
        logger.info("Saved %s.", path)
    return list(paths.values())


def complete_recipe(scheme: str, recipe: str, descriptor: str, name: str) -> dict:
    """Return the hyper-parameters of a scheme's recipe for a descriptor.

    Args:
        scheme: a key of `SCHEMES`.
        recipe: of `RECIPE_NAMES`.
        descriptor: base descriptor, or another.
        name: of the projection; "tune" begins with the one of this name that ships.

    Raises:
        InputError: when the scheme has no such recipe, or there is nothing to begin with.
    """
    trainer = SCHEMES[scheme]
    if trainer is pca:
        return {}
    settings = {
        "hidden": list(
            DESCRIPTORS[descriptor].hidden
            if descriptor in DESCRIPTORS
            else HIDDEN.get(descriptor, HIDDEN_BY_DEFAULT)
        ),
        "distance_weight": trainer.DISTANCE_WEIGHTS.get(descriptor, 0.0),
        **trainer.RECIPES[cli.choose(f"recipe of {scheme}", recipe, trainer.RECIPES)],
    }
    if recipe == "tune":
        settings |= {"begin_with": name, "begin_with_sha256": projections.checksum(name)}
    return settings


def base_of(conf: dict) -> dict:
    """Return the configuration of the feature that a reduced one is made from."""
    return {**conf, "model": features_confs.base_of(conf["model"])}


def parse_maps(values: list[str]) -> dict[str, tuple[Path, Path]]:
    """Parse `images:model`, or folders of maps of `pipelines.localize`.

    A map is named after the folder that its images folder, or the folder of the map, lies in.

    Returns:
        From name to the folders of images and of the COLMAP model.

    Raises:
        InputError: when a folder is not there, or two maps have one name.
    """
    folders = {}
    for value in values:
        if is_map(Path(value)):
            built = Map(Path(value))
            images, model = built.images, built.sfm
            name = built.folder.resolve().parent.name
        else:
            images, separator, model = value.rpartition(":")
            if not separator:
                raise InputError(f"--map {value}: neither a map nor of the form images:model.")
            images, model = Path(images), Path(model)
            name = images.resolve().parent.name
        for folder in (images, model):
            if not folder.is_dir():
                raise InputError(f"--map {value}: there is no folder {folder}.")
        if name in folders:
            raise InputError(f"--map {value}: another map is called {name} too.")
        folders[name] = images, model
    return folders


def _main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__,
        epilog="example: python -m hloc_reduce.training --descriptor sift --scheme sv --dim 64 "
        "--map town/images:town/sparse --output weights",
        formatter_class=cli.HelpFormatter,
    )
    base = parser.add_mutually_exclusive_group()
    base.add_argument(
        "--descriptor",
        nargs="+",
        default=["sift"],
        help=f"base descriptors, of {', '.join(BASES)}",
    )
    base.add_argument(
        "--base",
        type=Path,
        metavar="FILE",
        help="YAML file of a feature of any extractor, also of hloc's, to project instead",
    )
    parser.add_argument(
        "--scheme", nargs="+", default=["sv"], help=f"schemes, of {', '.join(SCHEMES)}"
    )
    parser.add_argument(
        "--dim",
        type=int,
        nargs="+",
        default=[64],
        help="output dimensions, of all schemes but nested",
    )
    parser.add_argument(
        "--map",
        action="append",
        default=[],
        metavar="IMAGES:MODEL|MAP",
        help="folder of images and folder of their COLMAP model, or a map of pipelines.localize; "
        "may be repeated",
    )
    parser.add_argument(
        "--phototour",
        type=Path,
        action="append",
        default=[],
        metavar="DIR",
        help="folder of a PhotoTour sequence to train on; may be repeated",
    )
    parser.add_argument(
        "--validate",
        type=Path,
        metavar="DIR",
        help="folder of another PhotoTour sequence, to print the FPR95 of its pairs",
    )
    parser.add_argument(
        "--recipe",
        default="best",
        help=f"one of {', '.join(RECIPE_NAMES)}; tune is for one's own map and begins with the "
        "projection that ships",
    )
    parser.add_argument(
        "--output", type=Path, default=Path("outputs/training"), help="folder for the projections"
    )
    parser.add_argument(
        "--cache", type=Path, default=Path("outputs/training/maps"), help="folder for the tracks"
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of everything random")
    args = parser.parse_args()
    conf = None
    if args.base:
        if args.phototour or args.validate:
            raise InputError("--base describes photos, not the patches of PhotoTour.")
        args.descriptor, conf = [args.base.stem], base_of(features_confs.read(args.base))
        extractors.load(conf["model"])  # is wrong before any work is done, if it is
    of_patches = args.phototour or args.validate
    for descriptor in [] if conf else args.descriptor:
        if of_patches and descriptor == COLMAP:
            raise InputError(f"{descriptor} describes photos, not the patches of PhotoTour.")
        cli.choose("descriptor", descriptor, DESCRIPTORS if of_patches else BASES)
        if descriptor in DESCRIPTORS:
            check_weights(descriptor)
    for scheme in args.scheme:
        cli.choose("scheme", scheme, SCHEMES)
    if "ss" in args.scheme:
        ss.check()
    cli.choose("recipe", args.recipe, RECIPE_NAMES)
    if not args.map and not args.phototour:
        raise InputError("There is nothing to train on. Give --map or --phototour.")
    if args.seed < 0:
        raise InputError(f"--seed {args.seed}: choose 0 or more.")
    if args.validate:
        layout.read_pairs(args.validate)
        layout.read_points(args.validate)
    for dim in args.dim:
        if dim < 1 or (dim > DIM and conf is None):
            raise InputError(f"--dim {dim}: choose 1 to {DIM}.")
    maps = parse_maps(args.map)
    names = [*maps, *(folder.resolve().name for folder in args.phototour)]
    for name in set(names):
        if names.count(name) > 1:
            raise InputError(f"Two of the maps and sequences are called {name}. Rename a folder.")
    for descriptor in args.descriptor:
        paths = [
            path
            for scheme in args.scheme
            for path in main(
                maps,
                args.phototour,
                descriptor,
                scheme,
                args.dim,
                args.output,
                args.cache,
                args.recipe,
                args.seed,
                conf,
            )
        ]
        if args.validate:
            folder = args.cache / args.validate.resolve().name
            validate(args.validate, folder, descriptor, paths)


def validate(folder: Path, outputs: Path, descriptor: str, paths: list[Path]) -> None:
    """Print the FPR95 of a base descriptor and projections of it on a PhotoTour sequence."""
    projects = {descriptor: torch.nn.Identity()}
    projects |= {path.stem: projections.load(path) for path in paths}
    found = verification.main(folder, outputs, descriptor, projects)
    for name, value in found.items():
        print(f"FPR95 of {name} on {folder.resolve().name}: {100 * value:.2f} %")


if __name__ == "__main__":
    cli.run(_main)
