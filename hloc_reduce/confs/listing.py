"""The features in a table."""

from .. import projections
from ..descriptors import DESCRIPTORS
from ..networks import NETWORKS
from ..projections.released import WEIGHT_FILES as RELEASED
from ..utils.tables import aligned
from . import features
from .matchers import all_of

DOWNLOADED = "downloaded on first use"


def table() -> str:
    """Format the features with the size of their descriptors, as float16, and their weights."""
    lines = [("feature", "dim", "bytes", "matchers", "weights")]
    for name, conf in features.confs.items():
        dim = features.dimension(name)
        numbers = (str(dim), str(2 * dim)) if dim else ("", "")
        lines.append((name, *numbers, ", ".join(all_of(conf)), _weights(conf["model"])))
    return aligned(lines, left=5)


def _weights(model: dict) -> str:
    """Say where the weights of a model come from."""
    projection = model.get("projection")
    if projection is None:
        if network := features.network_of(model):
            is_downloaded = network not in NETWORKS or NETWORKS[network].urls
            return DOWNLOADED if is_downloaded else "shipped"
        descriptor = DESCRIPTORS.get(features.descriptor_of(model) or "")
        if descriptor is None and model["name"] != "dog":
            return f"see extractors/{model['name']}.py"
        return DOWNLOADED if descriptor and descriptor.urls else "none needed"
    if projections.split_prefix(projection)[0] in projections.names():
        base_weights = _weights(features.base_of(model))
        return f"shipped; base: {DOWNLOADED}" if base_weights == DOWNLOADED else "shipped"
    if projection in RELEASED:
        return f"{DOWNLOADED}, released by the paper's authors"
    return "to be trained: docs/training.md"
