"""Global descriptors by which images are retrieved, by name."""

from ..utils.cli import choose

VLAD = "vlad"  # the default: it needs no weights


def _of_hloc(name: str) -> dict:
    """Return the configuration of one of hloc's, with hloc's preprocessing and file name."""
    return {
        "output": f"global-feats-{name}",
        "model": {"name": "hloc", "conf": {"name": name}},
        "preprocessing": {"grayscale": False, "resize_max": 1024},
    }


# `preprocessing` is of the image, for those that need one
confs: dict[str, dict] = {
    VLAD: {
        "output": "global-feats-vlad",
        "model": {"name": "vlad", "num_words": 64, "max_samples": 200_000},
    },
    "vlad256": {"output": "global-feats-vlad256", "model": {"name": "vlad", "num_words": 256}},
    **{name: _of_hloc(name) for name in ("netvlad", "openibl", "megaloc", "eigenplaces", "dir")},
}


def get(name: str) -> dict:
    """Return the configuration of a name; raise an InputError if there is none."""
    return confs[choose("retrieval", name, confs)]


def provenance(name: str) -> dict:
    """Return what the provenance of a map says of its retrieval: nothing for the default."""
    return {} if name == VLAD else {"retrieval": confs[name]}
