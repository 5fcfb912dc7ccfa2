"""Train projections on COLMAP maps or on PhotoTour patches.

Extracts, matches and triangulates the images of each map with the poses of its model, and learns
from the tracks. A map built by pipelines.localize works, too.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import torch

from .. import extractors, logger, projections
from ..confs import features as features_confs
from ..datasets import phototour as layout
from ..descriptors import COLMAP_SIFT, DESCRIPTORS, DIM, check_weights
from ..evaluation import patch_verification as verification
from ..projections import network
from ..runtime.versions import versions
from ..utils import cli
from ..utils.cli import InputError
from ..utils.files import file_sha256
from ..utils.options import Option, Parser
from ..utils.paths import strings_as_paths
from . import levels, nested, patch_tracks, pca, raw, ss, sv, tracks, us

SCHEMES = {"pca": pca, "us": us, "ss": ss, "sv": sv, "nested": nested, "raw": raw}
RECIPE_NAMES = ("best", "paper", "tune")
# hidden layers for descriptors that are not of patches; COLMAP's are computed so fast that larger
# layers would take 5 % of the time
HIDDEN_LAYERS = {COLMAP_SIFT: (256, 256)}
DEFAULT_HIDDEN_LAYERS = (512, 512)


@dataclass(frozen=True, kw_only=True)
class Command:
    """The options of the command line.

    Args:
        descriptor: base descriptors, for PhotoTour of patches only.
        base: YAML file of a feature of any extractor, hloc's included, to project instead.
        scheme: schemes.
        dim: output dimensions; not for nested, raw.
        map: maps to train on.
        phototour: folder of a PhotoTour sequence to train on; may be repeated.
        validate: folder of another PhotoTour sequence: print the FPR95 of its pairs.
        recipe: recipe.
        output: folder for the projections.
        cache: folder for the tracks.
        seed: seed of everything random.
    """

    descriptor: Annotated[Sequence[str], Option(note=", ".join(features_confs.BASES))] = ("sift",)
    base: Annotated[Path, Option(metavar="FILE")] | None = None
    scheme: Annotated[
        Sequence[str],
        Option("scheme", SCHEMES, "raw changes nothing and only fits levels for codes"),
    ] = ("sv",)
    dim: Sequence[int] = (64,)
    map: Annotated[Sequence[str], tracks.MAP_OPTION] = ()
    phototour: Annotated[Sequence[Path], Option(repeated=True, metavar="DIR")] = ()
    validate: Annotated[Path, Option(metavar="DIR")] | None = None
    recipe: Annotated[
        str, Option("recipe", RECIPE_NAMES, "tune adapts the shipped projection to one's own map")
    ] = "best"
    output: Path = Path("outputs/training")
    cache: Path = Path("outputs/training/maps")
    seed: Annotated[int, Option(least=0)] = 0


@strings_as_paths
def main(
    maps: dict[str, tuple[Path, Path]],
    sequences: Sequence[Path],
    descriptor: str,
    scheme: str,
    dims: Sequence[int],
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
        descriptor: base descriptor; with `conf`, a name for its descriptors.
        scheme: a key of `SCHEMES`.
        dims: numbers of output dimensions; ignored by "nested", which has its own, and "raw".
        output: folder for `<descriptor>_<scheme><dim>.safetensors`.
        cache: folder for the tracks, which later trainings use again.
        recipe: "best", "paper" for the paper's losses, layers and hyper-parameters, or "tune" to
            adapt the shipped projection to a single place.
        seed: of everything random.
        conf: configuration of a feature, to train projections of its descriptors on maps.

    Returns:
        The files.

    Raises:
        InputError: when a map or a sequence cannot be used, or a dimension is too large.
    """
    trainer, name = SCHEMES[scheme], f"{descriptor}_{scheme}"
    names = {dim: f"{name}{dim}" for dim in dims}
    if trainer is nested:
        names = {nested.PREFIXES[0]: name}
    trained = extractors.load(conf["model"]).descriptor if conf else descriptor
    files = {}
    for folder in map(Path, sequences):
        place = folder.resolve().name
        files[place] = patch_tracks.main(folder, cache / place, descriptor, seed)
    for place, (images, model) in maps.items():
        files[place] = tracks.main(images, model, cache / place, descriptor, seed, conf)
    data = [tracks.load(file) for file in files.values()]
    training_data = _summaries(files, data)
    size = data[0].descriptors.shape[-1]
    if trainer is raw:
        names = {size: descriptor}
    settings = {dim: complete_recipe(scheme, recipe, trained, name) for dim, name in names.items()}
    if max(names) > size:
        raise InputError(f"{descriptor} descriptors are {size}-D: --dim {max(names)} is too large.")
    paths = [output / f"{name}.safetensors" for name in names.values()]
    for dim, path in zip(names, paths, strict=True):
        metadata = {
            "descriptor": trained,
            **({"base": conf} if conf else {}),
            "input": "descriptors of unit L2 norm",
            "scheme": scheme,
            "dim": dim,
            "training_data": training_data,
            "recipe": {"name": recipe, **settings[dim]},
            "seed": seed,
            "versions": versions(),
        }
        if not _exists(path, metadata):
            checkpoint = path.with_suffix(".ckpt")
            made_from = json.dumps(metadata, sort_keys=True)
            mlp = trainer.train(data, dim, settings[dim], seed, checkpoint, made_from)
            network.save(mlp, metadata, path, levels.of_projection(mlp, metadata, data))
            for file in (checkpoint, ss.clusters_of(checkpoint)):
                file.unlink(missing_ok=True)
            logger.info("Saved %s.", path)
    return paths


def _summaries(files: dict[str, Path], data: list[tracks.Tracks]) -> dict[str, dict]:
    """Return what the metadata of a projection say of the tracks of each place."""
    return {
        place: {
            "points": part.num_tracks,
            "observations": len(part.track),
            "sha256": file_sha256(file),
        }
        for (place, file), part in zip(files.items(), data, strict=True)
    }


def _exists(path: Path, metadata: dict) -> bool:
    """Return whether a projection exists; raise an InputError if its metadata differ."""
    if not path.exists():
        return False
    before = projections.load(path).metadata
    changed = [key for key in metadata if before.get(key) != metadata[key]]
    if changed:
        raise InputError(
            f"{path} exists, trained with another {' and '.join(changed)}. "
            "Choose another --output, or move it away."
        )
    logger.info("%s exists, trained from the same.", path)
    return True


def complete_recipe(scheme: str, recipe: str, descriptor: str, name: str) -> dict:
    """Return the hyper-parameters of a scheme's recipe for a descriptor.

    Args:
        scheme: a key of `SCHEMES`.
        recipe: one of `RECIPE_NAMES`.
        descriptor: base descriptor, or another.
        name: of the shipped projection that "tune" begins with.

    Raises:
        InputError: when the scheme has no such recipe, or no such projection ships.
    """
    trainer = SCHEMES[scheme]
    if trainer in (pca, raw):
        return {}
    base = DESCRIPTORS.get(descriptor)
    settings = {
        "hidden": list(
            base.hidden if base else HIDDEN_LAYERS.get(descriptor, DEFAULT_HIDDEN_LAYERS)
        ),
        "distance_weight": trainer.DISTANCE_WEIGHTS.get(descriptor, 0.0),
        **trainer.RECIPES[cli.choose(f"recipe of {scheme}", recipe, trainer.RECIPES)],
    }
    if recipe in ("best", "tune") and descriptor in features_confs.MODELS:
        settings |= trainer.OF_NETWORKS
        if recipe == "best":
            settings |= trainer.OF_BASES.get(descriptor, {})
    if recipe == "tune":
        settings |= {"begin_with": name, "begin_with_sha256": projections.checksum(name)}
    return settings


def validate(folder: Path, outputs: Path, descriptor: str, paths: list[Path]) -> None:
    """Print the FPR95 of a base descriptor and its projections on a PhotoTour sequence."""
    projects: dict[str, torch.nn.Module] = {descriptor: torch.nn.Identity()}
    projects |= {path.stem: projections.load(path) for path in paths}
    found = verification.main(folder, outputs, descriptor, projects)
    for name, value in found.items():
        print(f"FPR95 of {name} on {folder.resolve().name}: {100 * value:.2f} %")


def _check(args: Command, conf: dict | None) -> None:
    """Raise an InputError for wrong options, before any work is done."""
    of_patches = args.phototour or args.validate
    if conf:
        if of_patches:
            raise InputError("--base describes photos, not the patches of PhotoTour.")
        extractors.load(conf["model"])
    for descriptor in [] if conf else args.descriptor:
        if of_patches and descriptor in features_confs.BASES and descriptor not in DESCRIPTORS:
            raise InputError(f"{descriptor} describes photos, not the patches of PhotoTour.")
        cli.choose("descriptor", descriptor, DESCRIPTORS if of_patches else features_confs.BASES)
        if descriptor in DESCRIPTORS:
            check_weights(descriptor)
        elif descriptor != COLMAP_SIFT:
            extractors.load(features_confs.confs[descriptor]["model"])
    if "ss" in args.scheme:
        ss.check()
    for folder in (args.output, args.cache):
        cli.check_folder(folder)
    if not args.map and not args.phototour:
        raise InputError("There is nothing to train on. Give --map or --phototour.")
    if args.validate:
        layout.read_pairs(args.validate)
        layout.read_points(args.validate)
    most = min(features_confs.dimension(name) or DIM for name in args.descriptor) if not conf else 0
    for dim in args.dim if set(args.scheme) - {"nested", "raw"} else []:
        if dim < 1 or (conf is None and dim > most):
            raise InputError(f"--dim {dim}: choose 1 to {most or 'the dimension of the base'}.")


def _main() -> None:
    example = (
        "--descriptor sift --scheme sv --dim 64 --map town/images:town/sparse --output weights"
    )
    parser = Parser(__doc__, example)
    parser.add(Command, exclusive=[("descriptor", "base")])
    args, conf = Command(**parser.read()), None
    if args.base:
        conf = features_confs.read(args.base)
        conf["model"] = features_confs.base_of(conf["model"])
        args = replace(args, descriptor=[args.base.stem])
    _check(args, conf)
    maps = tracks.parse_maps(args.map)
    names = [*maps, *(folder.resolve().name for folder in args.phototour)]
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"Two of the maps and sequences are called {name}. Rename a folder.")
    for descriptor in args.descriptor:
        paths = []
        for scheme in args.scheme:
            paths += main(
                maps,
                args.phototour,
                descriptor,
                scheme,
                args.dim,
                output=args.output,
                cache=args.cache,
                recipe=args.recipe,
                seed=args.seed,
                conf=conf,
            )
        if args.validate:
            folder = args.cache / args.validate.resolve().name
            validate(args.validate, folder, descriptor, paths)


if __name__ == "__main__":
    cli.run(_main)
