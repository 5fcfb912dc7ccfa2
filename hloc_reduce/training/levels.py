"""Add the levels that --storage uint4, uint2 and uint1 need to projections, from tracks of maps.

A code of 4, 2 or 1 bits is the index of one of 16, 4 or 2 levels of a number. The levels of each
number are those with the least mean squared error on the tracks (Lloyd-Max), for all storages. The
file of the projection is replaced, so that what was made with it becomes stale; copy a shipped
projection first.
"""

from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from torch import nn

from .. import logger, projections
from ..projections import network
from ..projections.files import level_key
from ..utils import cli, options
from ..utils.cli import InputError
from ..utils.codes import CODED
from ..utils.files import file_sha256
from ..utils.paths import strings_as_paths
from . import nested, tracks
from .tracks import Tracks

SAMPLED_DESCRIPTORS = 100_000  # descriptors that levels are fitted to
LLOYD_ROUNDS = 100


def fit(numbers: torch.Tensor, bits: int) -> torch.Tensor:
    """Find the levels with the least mean squared error by Lloyd's algorithm.

    Args:
        numbers: (N, D) float32.
        bits: of a code.

    Returns:
        The ascending levels of each dimension (D, 2**bits).
    """
    ordered = numbers.T.contiguous().sort(dim=1).values  # (D, N)
    number, count = ordered.shape[1], 2**bits
    # with sums up to each place, the mean of an interval is a difference
    sums = nn.functional.pad(ordered.double().cumsum(1), (1, 0))
    place = ((torch.arange(count) + 0.5) * number / count).long()
    levels = ordered[:, place].contiguous()
    for _ in range(LLOYD_ROUNDS):
        middle = ((levels[:, 1:] + levels[:, :-1]) / 2).contiguous()
        inner = torch.searchsorted(ordered, middle)
        ends = nn.functional.pad(nn.functional.pad(inner, (1, 0)), (0, 1), value=number)
        size = ends.diff(dim=1)
        means = sums.gather(1, ends).diff(dim=1) / size.clamp(min=1)
        renewed = torch.where(size > 0, means.float(), levels)
        if torch.equal(renewed, levels):
            break
        levels = renewed
    return levels


def sample(maps: list[Tracks]) -> torch.Tensor:
    """Choose base descriptors (N, D) float32 to fit levels to, evenly from all observations."""
    # all variants, so that codes are good in the dark, too
    size = maps[0].descriptors.shape[-1]
    everything = np.concatenate([part.descriptors[:, 0].reshape(-1, size) for part in maps])
    return torch.from_numpy(everything[:: -(-len(everything) // SAMPLED_DESCRIPTORS)]).float()


def of_projection(mlp: network.MLP, metadata: dict, maps: list[Tracks]) -> dict[str, torch.Tensor]:
    """Fit the levels of a trained projection, of all its prefixes if it is nested.

    Args:
        mlp: the projection.
        metadata: of it.
        maps: the tracks of maps.

    Returns:
        Levels (D, 2**bits) by `projections.files.level_key`.
    """
    observed = sample(maps)
    prefixes = nested.PREFIXES if metadata.get("scheme") == "nested" else [mlp.sizes[-1]]
    found = {}
    for dim in prefixes:
        cut = network.Projection(mlp).cut(dim)
        numbers = torch.cat([cut(part) for part in observed.split(4096)])
        for storage, bits in CODED.items():
            prefix = "" if dim == mlp.sizes[-1] else dim
            found[level_key(storage, prefix)] = fit(numbers, bits)
    return found


@strings_as_paths
def main(projection: Path, maps: dict[str, tuple[Path, Path]], cache: Path) -> Path:
    """Add levels to the file of a projection, or replace them.

    Args:
        projection: the file, with metadata of its training.
        maps: from the name of each map to the folders of its images and its COLMAP model.
        cache: folder for the tracks, which trainings share.

    Returns:
        `projection`.

    Raises:
        InputError: when the file is not a projection of this project, or a map cannot be used.
    """
    if projection.suffix != ".safetensors":
        raise InputError(f"{projection}: levels are kept in .safetensors files only.")
    mlp, metadata = network.read(projection)
    descriptor, base = metadata["descriptor"], metadata.get("base")
    files = [
        tracks.main(images, model, cache / name, descriptor, conf=base)
        for name, (images, model) in maps.items()
    ]
    data = [tracks.load(file) for file in files]
    size = data[0].descriptors.shape[-1]
    if size != mlp.sizes[0]:
        raise InputError(f"{projection} is for {mlp.sizes[0]}-D descriptors, not for {size}-D.")
    metadata["levels"] = {name: file_sha256(file) for name, file in zip(maps, files, strict=True)}
    network.save(mlp, metadata, projection, of_projection(mlp, metadata, data))
    logger.info("Added levels for %s to %s.", ", ".join(CODED), projection)
    return projection


def of_maps(
    projection: list[str],
    map: Annotated[list[str], tracks.MAP_OPTION],
    cache: Path = Path("outputs/training/maps"),
) -> None:
    """Add levels to projections, or replace them.

    Args:
        projection: projections to change, by name or file.
        map: maps to learn from.
        cache: folder for the tracks.
    """
    maps = tracks.parse_maps(map)
    for name in projection:
        main(projections.find(name), maps, cache)


def _main() -> None:
    example = "--projection weights/sift_sv32.safetensors --map town/images:town/sparse"
    options.call(of_maps, __doc__, example)


if __name__ == "__main__":
    cli.run(_main)
