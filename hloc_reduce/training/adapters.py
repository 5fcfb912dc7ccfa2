"""Fit LightGlue to projected descriptors: adapters, first layers.

LightGlue's first layer takes the descriptors that it was trained for. An adapter is that layer
after the linear map from projected descriptors, floats and codes alike, back to these, which has
the least squared error on the keypoints of some photos. It costs no more time than the layer that
it replaces. Descriptors of a mini are mapped to XFeat's at their keypoints.
"""

import json
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from safetensors.torch import save_file
from torch.nn.functional import grid_sample, interpolate, normalize

from .. import extract_features, extractors, logger, projections
from ..confs import features as features_confs
from ..confs import matchers as matchers_confs
from ..matchers import lightglue
from ..networks import lightglue as weights_of
from ..networks.lightglue import LIGHTGLUE, SUFFIX, identity
from ..runtime.versions import versions
from ..utils import cli, options
from ..utils.cli import InputError
from ..utils.codes import restore, store
from ..utils.files import replacing
from ..utils.images import list_images, turned
from ..utils.options import Option
from ..utils.paths import strings_as_paths
from ..utils.progress import progress

STORAGES = ("float16", "uint4", "uint2")  # which a descriptor is learned in
TEACHER = "xfeat"  # of features that LightGlue has no weights for
STRIDE = 32  # the sides of photos that it takes are multiples of this
RIDGE = 1e-4  # of the mean square of a number

Described = tuple[np.ndarray, np.ndarray]  # descriptors (N, D), and those that LightGlue takes


@strings_as_paths
def main(
    feature: Sequence[str],
    images: Iterable[Path],
    output: Path | None = None,
    photos: Annotated[int, Option(least=1)] = 60,
) -> list[Path]:
    """Fit adapters.

    Args:
        feature: features with a projection, or of a mini; or their YAML files.
        images: folders of photos.
        output: folder for `<feature>.safetensors`; default: among the downloaded weights, where the
            matcher lightglue finds the adapters for projections of your own.
        photos: how many photos of the folders are used, evenly.

    Returns:
        The files.

    Raises:
        InputError: when there are no photos or keypoints, or LightGlue has no weights for the base
            of a feature.
    """
    paths = [folder / name for folder in images for name in list_images(folder)]
    if not paths:
        raise InputError("Give photos, --images.")
    paths = [paths[i] for i in np.unique(np.linspace(0, len(paths) - 1, photos).astype(int))]
    groups: dict[str, list[dict]] = {}
    for given in feature:
        conf = features_confs.get(given)[1]
        _check(conf, output)
        base = features_confs.base_of(conf["model"]), conf["preprocessing"]
        groups.setdefault(json.dumps(base), []).append(conf)
    files = []
    for confs in groups.values():
        described = list(_describe(confs[0], paths))
        if not sum(len(own) for own, _ in described):
            raise InputError("The photos have no keypoints.")
        files += [_fit(conf, described, len(paths), output or weights_of.own()) for conf in confs]
    return files


def _describe(conf: dict, paths: list[Path]) -> Iterator[Described]:
    """Yield the descriptors of each photo by the base of a feature, and those that LightGlue takes.

    Both are the same unless the base has no LightGlue of its own.
    """
    base = features_confs.base_of(conf["model"])
    extractor = extractors.load(base).eval()
    teacher, name = None, matchers_confs.features_of(base)
    if _network(conf) != name:
        teacher = extractors.load(features_confs.confs[TEACHER]["model"]).eval()
    for path in progress(paths, f"Describing by {name}", "photo", len(paths)):
        found = extractors.extract(extractor, path, conf["preprocessing"])
        own = np.asarray(found["descriptors"], np.float32).T
        taken = own if teacher is None else at_keypoints(teacher, path, conf, found)
        yield own, taken


@torch.no_grad()
def at_keypoints(
    teacher: extractors.Extractor, image: Path | np.ndarray, conf: dict, found: dict
) -> np.ndarray:
    """Return XFeat's descriptors (N, 64) at the keypoints of other features of a photo."""
    pixels, frame = extractors.load_image(image, conf["preprocessing"])
    sides = [side // STRIDE * STRIDE for side in pixels.shape[2:]]
    network: Any = teacher.model
    dense = normalize(network.net(interpolate(pixels, sides, mode="bilinear"))[0], dim=1)
    keypoints = turned(found["keypoints"], frame.size, frame.turns)
    shown = torch.tensor(frame.shown.copy())
    grid = ((torch.from_numpy(keypoints) + 0.5) / shown * 2 - 1)[None, None]
    sampled = grid_sample(dense, grid.float(), mode="bicubic", align_corners=False)[0, :, 0]
    return normalize(sampled, dim=0).T.numpy()


def _check(conf: dict, output: Path | None) -> None:
    """Raise an InputError for a feature without an adapter, or whose adapter would not be found."""
    name = matchers_confs.features_of(conf["model"])
    _network(conf)
    if name in LIGHTGLUE or (output is None and (weights_of.WEIGHTS / f"{name}{SUFFIX}").exists()):
        raise InputError(
            f"LightGlue has weights for {name} already: rename your projection, or give --output "
            "to fit anew what ships."
        )
    extractors.load(conf["model"])
    for storage in STORAGES:
        features_confs.levels({**conf, "storage": storage})


def _network(conf: dict) -> str:
    """Return the key of `LIGHTGLUE` that an adapter of a feature is for."""
    model = conf["model"]
    name = matchers_confs.features_of(model)
    base = matchers_confs.features_of(features_confs.base_of(model))
    if base in LIGHTGLUE and model.get("projection") is None:
        raise InputError(f"{name} needs no adapter: LightGlue has weights for it.")
    if base in LIGHTGLUE:
        return base
    if base in features_confs.MODELS:
        return TEACHER
    raise InputError(f"LightGlue has no weights for the base of {name}, {base}.")


def _fit(conf: dict, described: list[Described], photos: int, output: Path) -> Path:
    """Fit the adapter of a feature and write it."""
    network, name = _network(conf), matchers_confs.features_of(conf["model"])
    projection = conf["model"].get("projection")
    project = projections.load(projection) if projection else torch.nn.Identity()
    taken = np.concatenate([taken for _, taken in described]).astype(np.float64)
    own = project(torch.from_numpy(np.concatenate([own for own, _ in described]))).numpy()
    kinds = [rounded(own, conf, storage).astype(np.float64) for storage in STORAGES]
    decoder, offset = least_squares(kinds, taken)
    unlike = [1 - _cosine(kind @ decoder.T + offset, taken) for kind in kinds]
    layers = lightglue.published(network)
    weight, bias = np.eye(len(decoder)), np.zeros(len(decoder))
    if "input_proj.weight" in layers:  # LightGlue takes SuperPoint's descriptors as they are
        weight = layers["input_proj.weight"].double().numpy()
        bias = layers["input_proj.bias"].double().numpy()
    adapter = {"weight": weight @ decoder, "bias": weight @ offset + bias}
    metadata = {
        "network": network,
        "made_from": json.dumps(identity(extract_features.provenance(conf))),
        "photos": str(photos),
        "cosine": json.dumps(
            {kind: round(1 - part, 4) for kind, part in zip(STORAGES, unlike, strict=True)}
        ),
        "versions": json.dumps(versions()),
    }
    path = output / f"{name}{SUFFIX}"
    tensors = {
        f"input_proj.{key}": torch.from_numpy(np.ascontiguousarray(value)).half()
        for key, value in adapter.items()
    }
    with replacing(path) as temporary:
        save_file(tensors, temporary, metadata)
    logger.info("%s: cosine %s. It is in %s.", name, metadata["cosine"], path)
    return path


def rounded(own: np.ndarray, conf: dict, storage: str) -> np.ndarray:
    """Return descriptors (N, D) of a feature as a file of a storage has them."""
    levels = features_confs.levels({**conf, "storage": storage})
    return restore(*store({"descriptors": own.T}, storage, levels))


def least_squares(kinds: Sequence[np.ndarray], taken: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fit a linear map and an offset.

    Args:
        kinds: descriptors (N, D) of the same keypoints, in different storages.
        taken: (N, E) the target of each.

    Returns:
        The map (E, D) and the offset (E,).
    """
    size = kinds[0].shape[1]
    squares, products = np.zeros((size + 1, size + 1)), np.zeros((size + 1, taken.shape[1]))
    for kind in kinds:
        with_one = np.concatenate([kind, np.ones((len(kind), 1))], axis=1)
        squares += with_one.T @ with_one
        products += with_one.T @ taken
    squares[:size, :size] += RIDGE * np.eye(size) * np.trace(squares[:size, :size]) / size
    solution = np.linalg.solve(squares, products)
    return solution[:size].T, solution[size]


def _cosine(found: np.ndarray, taken: np.ndarray) -> float:
    norms = np.linalg.norm(found, axis=1) * np.linalg.norm(taken, axis=1)
    return float(((found * taken).sum(axis=1) / norms).mean())


def _main() -> None:
    example = "--feature disk_sv32.yaml --images photos"
    options.call(main, __doc__, example)


if __name__ == "__main__":
    cli.run(_main)
