"""Compact local descriptors for hierarchical localization."""

import logging
from typing import TYPE_CHECKING

from .utils import interrupts

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    import torch

    from .maps.localizer import Localizer

__version__ = "0.1.0"

logger = logging.getLogger("hloc_reduce")
if not logger.handlers:
    _handler = logging.StreamHandler()
    _handler.setFormatter(
        logging.Formatter("[%(asctime)s %(name)s %(levelname)s] %(message)s", "%Y/%m/%d %H:%M:%S")
    )
    logger.addHandler(_handler)
    logger.setLevel(logging.INFO)
    logger.propagate = False

interrupts.while_importing()


def __getattr__(name: str) -> "type[Localizer]":
    """Import `Localizer` on first use: it takes seconds."""
    if name == "Localizer":
        from .maps.localizer import Localizer

        return Localizer
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def describe_patches(
    patches: "torch.Tensor", feature: str = "sift_sv64", storage: str = "float32"
) -> "torch.Tensor":
    """Describe image patches.

    Args:
        patches: (N, 1, 32, 32) float in [0, 1], on any device.
        feature: a base descriptor such as "sift", or one with a shipped projection.
        storage: how a feature file would store them: "float32", "float16", "uint8", "uint4",
            "uint2" or "uint1".

    Returns:
        (N, D) float32 of unit norm, on the same device; rounded as matching would read them.

    Raises:
        InputError: for an unknown feature or storage, or one without levels for it.
        ValueError: for patches of another shape or type.

    Example:
        >>> import torch
        >>> describe_patches(torch.rand(10, 1, 32, 32), "sift_sv64").shape
        torch.Size([10, 64])
    """
    import torch

    from . import projections
    from .confs.features import get, levels, of_patches
    from .descriptors.model import Descriptor
    from .utils.codes import restore, store

    if not isinstance(patches, torch.Tensor):
        raise ValueError(f"Patches are a torch.Tensor, not {type(patches).__name__}.")
    if patches.shape[1:] != (1, 32, 32) or not patches.is_floating_point():
        raise ValueError(
            f"Patches are (N, 1, 32, 32) float in [0, 1], not {tuple(patches.shape)} "
            f"{patches.dtype}."
        )
    base, projection = of_patches(feature)
    found = levels(get(feature, storage=storage)[1])
    descriptors = Descriptor(base).to(patches.device)(patches.float())
    if projection is not None:
        descriptors = projections.load(projection).to(patches.device)(descriptors)
    if storage == "float32":
        return descriptors
    rounded = restore(*store({"descriptors": descriptors.cpu().numpy().T}, storage, found))
    return torch.from_numpy(rounded).to(patches.device)


def register(features: "Iterable[Path] | Path" = ()) -> list[str]:
    """Add this project's extractors, features and matchers to the installed hloc.

    Afterwards hloc's `dynamic_load` finds the extractors `reduced` and `vlad`, and the confs of
    `hloc.extract_features` and `hloc.match_features` have the entries of `confs`. hloc's own
    entries, such as `sift`, do not change. A second call changes nothing.

    Args:
        features: YAML files of more features, named after their files.

    Returns:
        The names of the added confs.

    Raises:
        InputError: when hloc is missing, too old or cannot be imported, or a file is not the
            configuration of a feature.
    """
    from . import hloc

    return hloc.register(features)
