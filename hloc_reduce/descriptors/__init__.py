"""Base descriptors: 32x32 patches to 128-D descriptors."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from ..utils import downloads

if TYPE_CHECKING:
    from torch import nn

PATCH_SIZE = 32
DIM = 128
COLMAP_SIFT = "colmap_sift"  # COLMAP's SIFT, a base descriptor that takes no patches


@dataclass(frozen=True)
class Base:
    """A base descriptor.

    Args:
        make: returns the module that maps (N, 1, 32, 32) in [0, 1] to (N, 128).
        urls: of the weights, if any, which kornia looks for in torch's cache.
        sha256: of the weights.
        hidden: sizes of the hidden layers of its projections: two for hand-crafted descriptors, one
            for learned ones (Sec. III-D).
    """

    make: "Callable[[], nn.Module]"
    urls: tuple[str, ...] = ()
    sha256: str = ""
    hidden: tuple[int, ...] = (512, 512)


def _sift() -> "nn.Module":
    from .sift import SIFT

    return SIFT(PATCH_SIZE)


def _kornia(name: str, **options: object) -> "nn.Module":
    from kornia import feature

    return getattr(feature, name)(**options)


DESCRIPTORS = {
    "sift": Base(_sift),
    "mkd": Base(
        lambda: _kornia("MKDDescriptor"),
        ("https://github.com/manyids2/mkd_pytorch/raw/master/mkd_pytorch/mkd-concat-64.pth",),
        "e31112000009e0d6e159dd7726aeea9f6a7d746cfe7d59b59bfb86c570667641",
    ),
    "tfeat": Base(
        lambda: _kornia("TFeat", pretrained=True),
        (
            "https://huggingface.co/kornia/tfeat/resolve/main/tfeat-liberty.params",
            "https://github.com/vbalnt/tfeat/raw/master/pretrained-models/tfeat-liberty.params",
        ),
        "1f2e9516b03c45876161da006ce8047e0a66ef08cc91d3fbf96a75f1a80f445a",
        hidden=(512,),
    ),
    "hardnet": Base(
        lambda: _kornia("HardNet", pretrained=True),
        (
            "https://huggingface.co/kornia/hardnet/resolve/main/checkpoint_liberty_with_aug.pth",
            "https://github.com/DagnyT/hardnet/raw/master/pretrained/train_liberty_with_aug/"
            "checkpoint_liberty_with_aug.pth",
        ),
        "1e9a41b19f1dc93c986e91df9aaf5696d1a777ac1d67498492856a65d6f49c16",
        hidden=(96,),
    ),
}
BASE_DESCRIPTORS = (*DESCRIPTORS, COLMAP_SIFT)  # base descriptors of photos


def check_weights(name: str) -> None:
    """Download the weights of a descriptor to torch's cache unless it has them.

    Raises:
        InputError: when they are broken or cannot be downloaded.
    """
    path, base = weights(name), DESCRIPTORS[name]
    if path is not None:
        otherwise = "or set TORCH_HOME to the folder whose hub/checkpoints has them"
        downloads.fetch(path, base.urls, base.sha256, f"The weights of {name}", otherwise)


def weights(name: str) -> Path | None:
    """Return the path of a descriptor's weights in torch's cache; None if it has none."""
    urls = DESCRIPTORS[name].urls
    return downloads.cache() / urls[0].rpartition("/")[2] if urls else None
