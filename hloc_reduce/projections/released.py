"""The projections released by the paper's authors, downloaded on first use."""

from pathlib import Path

from ..utils import downloads

REPOSITORY = "https://github.com/PRBonn/descriptor-dr"
URL = f"{REPOSITORY}/raw/main/models"
SHA256 = {
    64: "3f26e4818a6c3670362b72a0323ffc8f3acd3b95bab35fc4d8c8a9446af6691e",
    32: "287c4966083b77c88ac0ff999ac998570f4e05181d8884b026e8a85528e55fff",
    24: "9359455ba8c0498cc5f184a6706887ea57a6b51b62e6ad6b6996c4a99dfd8928",
    16: "f398386750312befb5ac66fc163d206251ae22dda7705341606bb193c1fd0c75",
}
# from projection to its file and the sha256 of the file
WEIGHT_FILES = {
    f"hardnet_sv{dim}": (f"HardNet_sv_dim{dim}.pth", sha) for dim, sha in SHA256.items()
}


def fetch(name: str) -> Path:
    """Return the file of a released projection in torch's cache, downloaded if it is missing.

    Args:
        name: a key of `WEIGHT_FILES`.

    Raises:
        InputError: when it cannot be downloaded or differs from the released one.
    """
    file, sha256 = WEIGHT_FILES[name]
    what, otherwise = f"The weights of {name}", "or name a copy with --projection"
    return downloads.fetch(downloads.cache() / file, [f"{URL}/{file}"], sha256, what, otherwise)
