"""Frozen projections: two or three matrix products (Sec. III-D)."""

import json
from collections.abc import Mapping, Sequence

import numpy as np

from ..utils.arrays import unit

BATCH_NORM_EPSILON = 1e-5
Layer = tuple[np.ndarray, np.ndarray]  # weight (out, in) and bias (out,)


def read(content: bytes, prefix: str = "") -> list[Layer]:
    """Read the layers of a projection from the content of its safetensors file.

    Args:
        content: of the file.
        prefix: number of numbers to keep of a nested projection's output, "" for all.

    Returns:
        See `fold`.

    Raises:
        ValueError: when it is broken, or not nested although a prefix is given.
    """
    from safetensors import SafetensorError
    from safetensors.numpy import load

    try:
        state = load(content)
        layers = fold(state)
    except (SafetensorError, KeyError) as error:
        raise ValueError(f"not a projection ({error})") from None
    sizes = [layers[0][0].shape[1]] if layers else []
    for weight, bias in layers:
        if weight.shape != (len(bias), sizes[-1]):
            raise ValueError(f"layers of shapes {[w.shape for w, _ in layers]}")
        sizes.append(len(bias))
    if not layers or not all(np.isfinite(part).all() for layer in layers for part in layer):
        raise ValueError("no layers, or weights that are not finite")
    if not prefix:
        return layers
    header = json.loads(content[8 : 8 + int.from_bytes(content[:8], "little")])
    scheme = json.loads(header.get("__metadata__", {}).get("scheme", "null"))
    if scheme != "nested" or not (prefix.isdigit() and 0 < int(prefix) <= sizes[-1]):
        raise ValueError(f"its first {prefix} numbers are of no use")
    weight, bias = layers[-1]
    return [*layers[:-1], (weight[: int(prefix)], bias[: int(prefix)])]


def fold(state: Mapping[str, np.ndarray]) -> list[Layer]:
    """Fold each batch normalization of a trained network into the linear layer behind it.

    Args:
        state: `linears.<i>.weight` and `bias`, and `norms.<i>.weight`, `bias`, `running_mean` and
            `running_var` of the layers but the last.

    Returns:
        The layers, float32; ReLU follows each but the last.

    Raises:
        KeyError: when a tensor is missing.
    """
    number = sum(key.startswith("linears.") for key in state) // 2
    layers = []
    scale: np.ndarray | float = 1.0
    shift: np.ndarray | float = 0.0
    for i in range(number):
        # in float64, so that the rounding does not depend on the number of threads
        weight, bias = (
            state[f"linears.{i}.{key}"].astype(np.float64) for key in ("weight", "bias")
        )
        folded = weight * scale, bias + (weight * shift).sum(axis=1)
        layers.append((folded[0].astype(np.float32), folded[1].astype(np.float32)))
        if i < number - 1:
            mean, variance, gain, offset = (
                state[f"norms.{i}.{key}"].astype(np.float32)
                for key in ("running_mean", "running_var", "weight", "bias")
            )
            scale = gain / np.sqrt(variance + np.float32(BATCH_NORM_EPSILON))
            shift = offset - mean * scale
    return layers


def project(descriptors: np.ndarray, layers: Sequence[Layer]) -> np.ndarray:
    """Map descriptors (N, D) of unit norm to (N, d) float32 of unit norm.

    It is computed in float64, so that the float16 of a feature file is the same in every program
    and on every machine.
    """
    values = descriptors.astype(np.float64)
    for weight, bias in layers[:-1]:
        values = np.maximum(values @ weight.T.astype(np.float64) + bias, 0)
    weight, bias = layers[-1]
    return unit(values @ weight.T.astype(np.float64) + bias).astype(np.float32)
