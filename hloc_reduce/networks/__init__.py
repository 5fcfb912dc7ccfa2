"""Networks that find and describe keypoints, and where their weights are."""

from dataclasses import dataclass
from pathlib import Path

from ..utils import downloads
from ..utils.cli import InputError


@dataclass(frozen=True)
class Network:
    """A network.

    Args:
        dim: dimension of its descriptors.
        file: name of its weights in torch's cache.
        urls: of the weights; none if they ship with this package.
        sha256: of the weights; None where files that differ hold the same weights.
        computes: in that case, what they compute from a test image, see `loading.fingerprint`.
        version: of what is made of the network's output, part of the provenance of features.
    """

    dim: int
    file: str
    urls: tuple[str, ...] = ()
    sha256: str | None = None
    computes: tuple[float, ...] = ()
    version: int = 0


NOISE_REDUCTION = 4  # the version of `noise.reduce_noise`, part of the provenance of features

EDGEPOINT2 = {
    "T32": "c88b76d2b05cb19de7314a108042d05688424d9a9a3abed97c778078e676cfdc",
    "T48": "6871142455b685674704046b8a0a4aa26248eacd86d4b7cc30b790b9eeda7779",
    "S32": "92b9099f8e0c066b988be95fb537d7904b9cf4a2e4f860f073ea3c407905dcde",
    "S48": "44ac8bee2a0a94335af3b043187a995c6d5b3ef2acad6a0de69e1a1aa2db75aa",
    "S64": "a2c7737a85844921a0fded7225cf48c5f596b7eff130abc8711ee5ae5017f097",
    "M32": "e2f4f870b19145502d2dabc7ea14063d77c5ee529f97e858935386f6ca3c0821",
    "M48": "3a92fc9a745b92368fc391983fb566d5c9239f25e77b95c7c4df872e411ff8d7",
    "M64": "eaa1939ef34f26229182cc99a9ce91fbc1d787cd9eddf5d26263626ba1ad8dc6",
    "L32": "8bd270c75694d2c1fa85bb2c98d29528e048ff373a96cc1c194315e100fd66b0",
    "L48": "a31f82b11c3c8354cb20e018ec03a68ed482c4b980b8f173f604e3279d8254d7",
    "L64": "df0bef95b51d02f2e29e01ccf2a1e45630a50af20593dba362d7d88e104e223f",
    "E32": "e93ff3a5bd9f331384dfc776bc47ff78887c8569454726c27078db825df72c1f",
    "E48": "9c411c2f5ee20a46a9d32b04e40411e625c1f3438f97a9df3de06ce5c0ec38a9",
    "E64": "968d0bfae2c3f89a11092750160c90862b2b9c5b022e9aef12f97376b61cbdfe",
}
# dimension, and what the weights compute
ALIKED = {
    "aliked-n16": (128, (0.0108, 0.0877, 0.0145, 0.0564)),
    "aliked-n16rot": (128, (0.0087, 0.0880, 0.0160, 0.0758)),
    "aliked-t16": (64, (0.0260, 0.1223, 0.0226, 0.0870)),
}

MINI = ("mini32", "mini64")  # this project's own
MINI_SIZE = "L"  # of EdgePoint2's architecture
BETWEEN_PIXELS = 1  # the version with keypoints between pixels
WEIGHTS = Path(__file__).parent / "weights"

NETWORKS = (
    {
        model: Network(
            int(model.removeprefix("mini")), f"{model}.safetensors", version=BETWEEN_PIXELS
        )
        for model in MINI
    }
    | {
        model: Network(
            int(model[1:]),
            f"edgepoint2_{model}.pth",
            (f"https://github.com/HITCSC/EdgePoint2/raw/c589a57/weights/{model}.pth",),
            sha256,
        )
        for model, sha256 in EDGEPOINT2.items()
    }
    | {
        model: Network(
            dim,
            f"{model}.pth",
            (
                f"https://huggingface.co/kornia/aliked/resolve/main/{model}.pth",
                f"https://github.com/Shiaoming/ALIKED/raw/main/models/{model}.pth",
            ),
            computes=computes,
        )
        for model, (dim, computes) in ALIKED.items()
    }
    | {
        "xfeat": Network(
            64,
            "xfeat.pt",
            ("https://github.com/verlab/accelerated_features/raw/main/weights/xfeat.pt",),
            computes=(0.1010, 1.8716, -3.7967, 4.9643, 0.0824, 0.0246),
            version=BETWEEN_PIXELS,
        )
    }
)


def fetch_weights(name: str, given: Path | str | None = None) -> Path:
    """Return the file of a network's weights: it ships, or is downloaded into torch's cache once.

    Args:
        name: of the network.
        given: a file of other weights, which is returned.

    Raises:
        InputError: when it is missing or broken, or cannot be downloaded.
    """
    if given is not None:
        if not Path(given).is_file():
            raise InputError(f"There is no file {given} of weights.")
        return Path(given)
    network = NETWORKS[name]
    return download(network, f"The weights of {name}") if network.urls else WEIGHTS / network.file


def download(network: Network, what: str) -> Path:
    """Return the file of weights in torch's cache, which is downloaded once.

    Args:
        network: whose weights they are.
        what: names them in messages.

    Raises:
        InputError: when it is missing or broken, or cannot be downloaded.
    """
    otherwise = "or set TORCH_HOME to the folder whose hub/checkpoints has them"
    path = downloads.cache() / network.file
    return downloads.fetch(path, network.urls, network.sha256, what, otherwise)
