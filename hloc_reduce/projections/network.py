"""The networks of projections: trained, frozen, and their files."""

import json
from collections.abc import Iterable, Mapping
from pathlib import Path

import torch
from safetensors import safe_open
from safetensors.torch import save as serialize
from torch import nn

from ..descriptors import DESCRIPTORS
from ..projections.layers import fold
from ..utils.cli import InputError
from ..utils.files import replacing
from . import released
from .files import find, split_prefix


class MLP(nn.Module):
    """Linear layers; ReLU and batch normalization follow each but the last (Sec. III-D).

    Args:
        sizes: of the input, the hidden layers and the output, for example (128, 512, 512, 64).
    """

    def __init__(self, sizes: Iterable[int]):
        super().__init__()
        self.sizes = tuple(sizes)
        self.linears = nn.ModuleList(map(nn.Linear, self.sizes[:-1], self.sizes[1:]))
        self.norms = nn.ModuleList(map(nn.BatchNorm1d, self.sizes[1:-1]))

    def forward(self, descriptors: torch.Tensor) -> torch.Tensor:
        """Map descriptors (N, sizes[0]) to (N, sizes[-1]) of unit norm."""
        for linear, norm in zip(self.linears, self.norms, strict=False):
            descriptors = norm(linear(descriptors).relu())
        return nn.functional.normalize(self.linears[-1](descriptors), dim=1)


class Projection(nn.Module):
    """A frozen MLP: two or three matrix products, with the batch normalizations folded in.

    Args:
        mlp: the trained network; its running statistics are used.
        metadata: of its training: descriptor, scheme, dim, ...

    Attributes:
        exact: whether to compute in float64 on a CPU; False in exported graphs.
    """

    exact = True

    def __init__(self, mlp: MLP, metadata: dict | None = None):
        super().__init__()
        self.sizes = mlp.sizes
        self.metadata = metadata or {}
        self.linears = nn.ModuleList(map(nn.Linear, mlp.sizes[:-1], mlp.sizes[1:]))
        state = {key: value.cpu().numpy() for key, value in mlp.state_dict().items()}
        for linear, (weight, bias) in zip(self.linears, fold(state), strict=True):
            linear.weight.data, linear.bias.data = torch.from_numpy(weight), torch.from_numpy(bias)
        self.requires_grad_(False).eval()

    def cut(self, dim: int) -> "Projection":
        """Keep only the first numbers of a nested projection's output.

        Raises:
            InputError: when there are fewer.
        """
        if not 0 < dim <= self.dim:
            raise InputError(f"A projection to {self.dim} numbers has no first {dim}.")
        for parameter in self.linears[-1].parameters():
            parameter.data = parameter.data[:dim]
        self.sizes = (*self.sizes[:-1], dim)
        return self

    @property
    def dim(self) -> int:
        """The number of output dimensions."""
        return self.sizes[-1]

    @torch.no_grad()
    def forward(self, descriptors: torch.Tensor) -> torch.Tensor:
        """Map descriptors (N, D) of unit norm to (N, dim) float32 of unit norm.

        On a CPU it is computed in float64, as by `layers.project`, with which it agrees when both
        are rounded to float16, unless `exact` is False.
        """
        values = descriptors.double() if self.exact and descriptors.is_cpu else descriptors
        for i, linear in enumerate(self.linears):
            values = values.relu_() if i else values
            layer = (part.to(values) for part in linear.parameters())
            values = nn.functional.linear(values, *layer)
        return nn.functional.normalize(values, dim=1).float()


def save(
    mlp: MLP, metadata: dict, path: Path, levels: Mapping[str, torch.Tensor] | None = None
) -> None:
    """Write a trained network as safetensors; weights as float16, statistics as float32.

    Args:
        mlp: the network.
        metadata: strings, numbers, lists and dicts of these.
        path: the file.
        levels: by `files.level_key`, stored as float16.
    """
    tensors = {
        key: (value.half() if key.startswith("linears.") else value.float()).contiguous()
        for key, value in mlp.state_dict().items()
        if not key.endswith("num_batches_tracked")
    }
    tensors |= {key: value.half().contiguous() for key, value in (levels or {}).items()}
    metadata = {**metadata, "layers": list(mlp.sizes)}
    header = {key: json.dumps(value) for key, value in metadata.items()}
    with replacing(path) as temporary:
        temporary.write_bytes(serialize(tensors, header))


def load(projection: str | Path) -> Projection:
    """Load a projection, see `projections.load`."""
    loaded, (name, prefix) = Projection(*read(projection)), split_prefix(projection)
    if not prefix:
        return loaded
    if loaded.metadata.get("scheme") != "nested" or not prefix.isdigit():
        stem = Path(name).stem
        raise InputError(f"{stem} is not nested: its first {prefix} numbers are of no use.")
    return loaded.cut(int(prefix))


def read(projection: str | Path) -> tuple[MLP, dict]:
    """Read the network of a projection as it was trained, and its metadata.

    Raises:
        InputError: when the file is missing or is not a projection.
    """
    path = find(projection)
    try:
        mlp, metadata = (read_released if path.suffix == ".pth" else read_safetensors)(path)
        if not all(part.isfinite().all() for part in Projection(mlp).parameters()):
            raise ValueError("its weights are not finite")
    except Exception as error:  # torch may raise anything for a broken file
        reason = next(iter(str(error).split("\n")))
        raise InputError(f"{path} is not a projection ({reason}).") from None
    return mlp, metadata


def read_safetensors(path: Path) -> tuple[MLP, dict]:
    """Read a network and its metadata; a broken file raises any error."""
    with safe_open(path, "pt") as file:
        metadata = {key: json.loads(value) for key, value in (file.metadata() or {}).items()}
        state = {
            key: file.get_tensor(key).float()
            for key in file.keys()  # noqa: SIM118
            if not key.startswith("levels.")
        }
    layers = metadata["layers"]
    sizes = [len(state[f"linears.{i}.bias"]) for i in range(len(layers) - 1)]
    if (
        layers[1:] != sizes or layers[0] != state["linears.0.weight"].shape[1]
    ):  # before MLP allocates them
        raise ValueError(f"its layers are not {layers}")
    mlp = MLP(layers)
    missing, unexpected = mlp.load_state_dict(state, strict=False)
    missing = [key for key in missing if not key.endswith("num_batches_tracked")]
    if missing or unexpected:
        raise ValueError(f"tensors {missing + unexpected} missing or unknown")
    return mlp, metadata


def read_released(path: Path) -> tuple[MLP, dict]:
    """Read a network in the format of the paper's authors."""
    state = torch.load(path, weights_only=True, map_location="cpu")
    state = {key.replace("module.", ""): value for key, value in state.items()}
    linears = [key.removesuffix("weight") for key, value in state.items() if value.ndim == 2]
    norms = [key.removesuffix("running_var") for key in state if key.endswith("running_var")]
    mlp = MLP([state[f"{linears[0]}weight"].shape[1], *(len(state[f"{k}bias"]) for k in linears)])
    for layers, prefixes in ((mlp.linears, linears), (mlp.norms, norms)):
        for layer, prefix in zip(layers, prefixes, strict=True):
            layer.load_state_dict({key: state[prefix + key] for key in layer.state_dict()})
    metadata = {"training_data": f"{path.name}, in the form of {released.REPOSITORY}"}
    descriptor = path.name.lower().partition("_")[0]  # SIFT_sv_dim64.pth
    return mlp, metadata | ({"descriptor": descriptor} if descriptor in DESCRIPTORS else {})
