"""Load a network's weights, check them, and make it fast."""

import pickle
from collections.abc import Callable
from pathlib import Path

import safetensors.torch
import torch
from safetensors import SafetensorError
from torch import nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from ..utils.cli import InputError
from . import NETWORKS, fetch_weights

CONSTANT = "hw_grid"  # a buffer of kornia's ALIKED that its weights lack
OUTPUT_TOLERANCE = 1e-3  # of what the weights compute

Compute = Callable[[torch.Tensor], tuple[torch.Tensor, ...]]


def load_weights(module: nn.Module, name: str, compute: Compute | None = None) -> nn.Module:
    """Load the weights of a network of `NETWORKS`, fold its normalizations, and freeze it.

    Args:
        module: the network.
        name: of the network.
        compute: computes its maps from an image (1, 3, H, W); default: the module itself.

    Returns:
        The module.

    Raises:
        InputError: when the weights cannot be downloaded, are broken, or are another network's.
    """
    path, what = fetch_weights(name), f"The weights of {name}"
    load_file(module, path, what)
    expected = NETWORKS[name].computes
    found = fingerprint(compute or module)
    if expected and any(
        abs(a - b) > OUTPUT_TOLERANCE * (1 + abs(b)) for a, b in zip(found, expected, strict=True)
    ):
        raise InputError(
            f"{what}, {path}, are not the published ones: they compute {_rounded(found)} instead "
            f"of {_rounded(expected)}. Delete the file."
        )
    return module


def output_size(path: Path, layer: str, what: str) -> int:
    """Return the number of outputs of a convolution in a .safetensors file.

    Args:
        path: the file.
        layer: name of the convolution.
        what: name of the file in messages.

    Raises:
        InputError: when the file is broken, or another network's.
    """
    try:
        with safetensors.safe_open(path, "pt") as file:
            return int(file.get_slice(f"{layer}.weight").get_shape()[0])
    except (OSError, SafetensorError, IndexError):
        raise InputError(f"{what}, {path}, are broken, or those of another network.") from None


def load_file(module: nn.Module, path: Path, what: str) -> nn.Module:
    """Load weights as `read_into` does, fold the network's normalizations, and freeze it."""
    return fold(read_into(module, path, what).eval()).requires_grad_(False)


def read_into(module: nn.Module, path: Path, what: str) -> nn.Module:
    """Load weights from a file.

    Args:
        module: the network.
        path: a .safetensors file, or one of torch's, of which only tensors are read.
        what: names the weights in messages, as in "The weights of xfeat".

    Returns:
        The module.

    Raises:
        InputError: when the weights are missing, broken, or another network's.
    """
    weights = read_weights(path, what)
    try:
        missing, unexpected = module.load_state_dict(weights, strict=False)
    except (RuntimeError, TypeError, AttributeError):
        missing, unexpected = [path.name], []
    if unexpected or any(not key.endswith(CONSTANT) for key in missing):
        raise InputError(f"{what}, {path}, are those of another network.")
    return module


def read_weights(path: Path, what: str) -> dict[str, torch.Tensor]:
    """Read the tensors of a file, see `read_into`.

    Raises:
        InputError: when it is missing or broken.
    """
    try:
        if path.suffix == ".safetensors":
            return safetensors.torch.load_file(path)
        return torch.load(path, map_location="cpu", weights_only=True)
    except (pickle.UnpicklingError, RuntimeError, EOFError, OSError, ValueError, SafetensorError):
        raise InputError(f"{what}, {path}, are broken.") from None


def fingerprint(compute: Compute) -> tuple[float, ...]:
    """Return the mean and the standard deviation of each map of a test image."""
    x, y = torch.arange(96)[None] / 7, torch.arange(64)[:, None] / 5
    image = 0.5 + 0.25 * (torch.sin(x + y) + torch.sin(2.3 * x - y * y / 4))
    with torch.no_grad():
        maps = compute(image.expand(1, 3, 64, 96))
    return tuple(float(value) for part in maps for value in (part.mean(), part.std()))


def _rounded(numbers: tuple[float, ...]) -> str:
    return ", ".join(f"{number:.3f}" for number in numbers)


def fold(module: nn.Module) -> nn.Module:
    """Fold batch normalizations into the convolutions that they follow in an `nn.Sequential`.

    Returns:
        The module, which computes the same in fewer steps.
    """
    for child in module.children():
        fold(child)
    if isinstance(module, nn.Sequential):
        for i in range(1, len(module)):
            before, this = module[i - 1], module[i]
            if isinstance(before, nn.Conv2d) and isinstance(this, nn.BatchNorm2d):
                module[i - 1] = fuse_conv_bn_eval(before, this)
                module[i] = nn.Identity()
    return module
