"""LightGlue's weights: published ones, and adapters and networks that ship or a user fitted."""

import json
from pathlib import Path

from ..utils.cli import InputError
from ..utils.downloads import cache
from . import MINI, Network
from . import WEIGHTS as OF_NETWORKS

# LightGlue's weights, by the features that they match, as hloc and kornia call them
LIGHTGLUE = {
    name: Network(
        dim,
        f"{name}_lightglue_v0-1_arxiv-pth",
        (
            f"https://huggingface.co/kornia/lightglue/resolve/main/{name}_lightglue.pth",
            f"https://github.com/cvg/LightGlue/releases/download/v0.1_arxiv/{name}_lightglue.pth",
        ),
        sha256,
    )
    for name, dim, sha256 in (
        ("aliked", 128, "d975e965b105311a6143194852297dff4f02aea5cc2e10cecfed966ca0e22503"),
        ("disk", 128, "b5b21d47ea24f2c5e501aec9c91b9716e4c8c3429a4dc1e615c133c4c9378335"),
        ("superpoint", 256, None),
    )
} | {
    "xfeat": Network(
        64,
        "xfeat-lighterglue.pt",
        (
            "https://huggingface.co/kornia/lightglue/resolve/main/xfeat-lighterglue.pt",
            "https://github.com/verlab/accelerated_features/raw/main/weights/xfeat-lighterglue.pt",
        ),
        "766102df37f11189efe5b0811d1f47c72b22629b79bfabfcfff9d2a2f84654b8",
    )
}

WEIGHTS = OF_NETWORKS / "lightglue"  # that ship, by the features that they are for
SUFFIX = ".safetensors"
CHECKSUMS = ("projection_sha256", "weights_sha256")  # in the provenance of features


def own() -> Path:
    """Return the folder of the adapters that a user fitted."""
    return cache() / "lightglue"


def fitted() -> list[str]:
    """List the features that have a file, which ships or is in `own`."""
    return sorted({file.stem for folder in (WEIGHTS, own()) for file in folder.glob(f"*{SUFFIX}")})


def known() -> list[str]:
    """List the features that there are weights for."""
    return sorted({*LIGHTGLUE, *fitted()})


def file_of(features: str) -> Path:
    """Return the file of some features in `WEIGHTS` or `own`, or the given file."""
    path = Path(features)
    if path.suffix == SUFFIX:
        return path
    name = f"{path.name}{SUFFIX}"
    return WEIGHTS / name if (WEIGHTS / name).exists() else own() / name


def what(features: str) -> str:
    """Name the weights for some features in messages."""
    return f"The weights of lightglue for {features}"


def unknown(features: str) -> InputError:
    """Return the error for features without weights."""
    bases = ", ".join(sorted({*LIGHTGLUE, *MINI}))
    return InputError(
        f"lightglue has no weights for {features}, only for {bases} and projections of them, see "
        "--list_features: choose another matcher or feature, or, for a projection of your own, fit "
        "an adapter with python -m hloc_reduce.training.adapters."
    )


def identity(made_from: dict) -> dict:
    """Return what of a provenance tells features of one name apart: checksums of weights."""
    return {key: value for key, value in made_from.items() if key in CHECKSUMS}


def metadata_of(features: str) -> dict:
    """Return the metadata of a file of `file_of`.

    Returns:
        `network`, a key of `LIGHTGLUE`, and `made_from`, the `identity` of its features.

    Raises:
        InputError: when there is no such file, or it is broken.
    """
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(file_of(features), "np") as file:
            metadata = file.metadata() or {}
        return {"network": metadata["network"], "made_from": json.loads(metadata["made_from"])}
    except FileNotFoundError:
        raise unknown(features) from None
    except (OSError, SafetensorError, KeyError, ValueError):
        raise InputError(f"{what(features)} are broken.") from None
