"""Base descriptors: 32x32 patches to 128 numbers."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from pickle import UnpicklingError
from urllib.request import urlopen

import torch
from kornia import feature
from torch import nn

from ..cli import InputError, choose
from .sift import SIFT

PATCH_SIZE = 32
DIM = 128
COLMAP = "colmap_sift"  # COLMAP's own SIFT, a base descriptor that takes no patches
TIMEOUT = 5  # seconds to wait for a server


@dataclass(frozen=True)
class Base:
    """A base descriptor.

    Args:
        make: returns the module that maps (N, 1, 32, 32) in [0, 1] to (N, 128).
        urls: of the weights that kornia downloads to torch's cache, the first that answers; none
            for a descriptor without.
        hidden: the sizes of the hidden layers of its projections: two for hand-crafted descriptors,
            one for learned ones (Sec. III-D).
    """

    make: Callable[[], nn.Module]
    urls: tuple[str, ...] = ()
    hidden: tuple[int, ...] = (512, 512)


DESCRIPTORS = {
    "sift": Base(lambda: SIFT(PATCH_SIZE)),
    "mkd": Base(
        feature.MKDDescriptor,
        ("https://github.com/manyids2/mkd_pytorch/raw/master/mkd_pytorch/mkd-concat-64.pth",),
    ),
    "tfeat": Base(
        lambda: feature.TFeat(pretrained=True),
        (
            "https://huggingface.co/kornia/tfeat/resolve/main/tfeat-liberty.params",
            "https://github.com/vbalnt/tfeat/raw/master/pretrained-models/tfeat-liberty.params",
        ),
        hidden=(512,),
    ),
    "hardnet": Base(
        lambda: feature.HardNet(pretrained=True),
        (
            "https://huggingface.co/kornia/hardnet/resolve/main/checkpoint_liberty_with_aug.pth",
            "https://github.com/DagnyT/hardnet/raw/master/pretrained/train_liberty_with_aug/"
            "checkpoint_liberty_with_aug.pth",
        ),
        hidden=(96,),
    ),
}


class Descriptor(nn.Module):
    """A base descriptor by name; computes in small batches, which stay in the cache.

    Args:
        name: a key of `DESCRIPTORS`.

    Raises:
        InputError: for an unknown name, or when its weights are neither cached nor to be had.
    """

    batch_size = 128  # whose intermediate results stay in the cache of a CPU

    def __init__(self, name: str):
        super().__init__()
        base = DESCRIPTORS[choose("descriptor", name, DESCRIPTORS)]
        check_weights(name)
        try:
            self.describe = base.make().eval()
        except (RuntimeError, EOFError, UnpicklingError) as error:
            reason = str(error).strip().splitlines()[0]
            raise InputError(f"The weights {weights(name)} are broken ({reason}).") from None

    @torch.no_grad()
    def forward(self, patches: torch.Tensor) -> torch.Tensor:
        """Map patches (N, 1, 32, 32) in [0, 1] to descriptors (N, 128) float32 of unit norm."""
        if len(patches) == 0:
            return patches.new_zeros((0, DIM))
        batches = [self.describe(batch) for batch in patches.split(self.batch_size)]
        return nn.functional.normalize(torch.cat(batches), dim=1)


def check_weights(name: str) -> None:
    """Make sure that kornia, which retries for minutes, finds or can download weights.

    Raises:
        InputError: when they are not in torch's cache and their address does not answer.
    """
    path, urls = weights(name), DESCRIPTORS[name].urls
    if path is None or path.is_file():
        return
    for url in urls:
        try:
            urlopen(url, timeout=TIMEOUT).close()
            return
        except OSError as error:
            reason = getattr(error, "reason", error)
    raise InputError(
        f"The weights of {name} are not there, and cannot be downloaded ({reason}): "
        f"put {urls[0]} to {path}, or set TORCH_HOME to the folder whose hub/checkpoints has it."
    )


def weights(name: str) -> Path | None:
    """Return where torch's cache has the weights of a descriptor; None for one without."""
    urls = DESCRIPTORS[name].urls
    folder = Path(torch.hub.get_dir()) / "checkpoints"
    return folder / urls[0].rpartition("/")[2] if urls else None
