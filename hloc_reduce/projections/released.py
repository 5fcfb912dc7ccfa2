"""The projections that the paper's authors released, downloaded from them when they are needed."""

from pathlib import Path

from ..utils import downloads

SOURCE = "https://github.com/PRBonn/descriptor-dr"
URL = f"{SOURCE}/raw/main/models"
# feature -> file and its sha256
FILES = {
    "hardnet_sv64": (
        "HardNet_sv_dim64.pth",
        "3f26e4818a6c3670362b72a0323ffc8f3acd3b95bab35fc4d8c8a9446af6691e",
    ),
    "hardnet_sv32": (
        "HardNet_sv_dim32.pth",
        "287c4966083b77c88ac0ff999ac998570f4e05181d8884b026e8a85528e55fff",
    ),
    "hardnet_sv24": (
        "HardNet_sv_dim24.pth",
        "9359455ba8c0498cc5f184a6706887ea57a6b51b62e6ad6b6996c4a99dfd8928",
    ),
    "hardnet_sv16": (
        "HardNet_sv_dim16.pth",
        "f398386750312befb5ac66fc163d206251ae22dda7705341606bb193c1fd0c75",
    ),
}


def fetch(name: str) -> Path:
    """Return the file of a released projection, downloaded to torch's cache if it is not there.

    Args:
        name: a key of `FILES`.

    Raises:
        InputError: when it cannot be downloaded or is not the one that was released.
    """
    file, sha256 = FILES[name]
    what, otherwise = f"The weights of {name}", "or name a copy with --projection"
    return downloads.fetch(downloads.cache() / file, [f"{URL}/{file}"], sha256, what, otherwise)
