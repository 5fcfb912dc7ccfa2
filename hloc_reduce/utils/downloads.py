"""Files that are downloaded once and checked by their sha256."""

import hashlib
import os
from collections.abc import Iterable
from http.client import HTTPException
from pathlib import Path
from urllib.request import urlopen

from .cli import InputError
from .files import file_sha256, replacing

SERVER_TIMEOUT_SECONDS = 5
TORCH_FILE = b"PK"  # torch.save writes zip files


def cache() -> Path:
    """Return torch's folder for downloaded files, as `torch.hub` does by the environment."""
    caches = os.environ.get("XDG_CACHE_HOME", "~/.cache")
    home = os.environ.get("TORCH_HOME", f"{caches}/torch")
    return Path(os.path.expanduser(home)) / "hub/checkpoints"


def fetch(path: Path, urls: Iterable[str], sha256: str | None, what: str, otherwise: str) -> Path:
    """Return a file; download it if it is missing.

    Args:
        path: where the file is kept.
        urls: tried one after the other.
        sha256: checked in any case; None accepts every file of torch's.
        what: names the file in messages, as in "The weights of tfeat".
        otherwise: what else the user can do, for messages.

    Raises:
        InputError: when it cannot be downloaded, or its sha256 is another.
    """
    if path.is_file():
        if sha256 and file_sha256(path) != sha256:
            raise InputError(
                f"{what}, {path}, are broken: their sha256 is not {sha256}. Delete it."
            )
        return path
    reasons = {}
    for url in urls:
        try:
            with urlopen(url, timeout=SERVER_TIMEOUT_SECONDS) as response:
                content = response.read()
        except (OSError, HTTPException) as error:
            reasons[url] = getattr(error, "reason", error)
            continue
        if hashlib.sha256(content).hexdigest() == sha256 or (
            sha256 is None and content.startswith(TORCH_FILE)
        ):
            with replacing(path) as temporary:
                temporary.write_bytes(content)
            return path
        expected = f"does not have the sha256 {sha256}" if sha256 else "is not one of torch's"
        reasons[url] = f"the downloaded file {expected}"
    tried = "; ".join(f"{url}: {reason}" for url, reason in reasons.items())
    raise InputError(
        f"{what} are missing and cannot be downloaded ({tried}): put them to {path}, {otherwise}."
    )
