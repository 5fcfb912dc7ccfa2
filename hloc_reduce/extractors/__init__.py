"""Extractors: image to features."""

import pkgutil
import sys

from torch import nn

from ..utils.base_model import dynamic_load
from ..utils.cli import InputError


def load(conf: dict) -> nn.Module:
    """Make the extractor of a model configuration.

    Its `name` is that of a module of this package, else of one of an installed hloc's
    extractors. `hloc.dog` is hloc's where both have a `dog`.

    Raises:
        InputError: when there is no such extractor, or its configuration is wrong.
    """
    name = str(conf.get("name"))
    ours = [module.name for module in pkgutil.iter_modules(__path__)]
    if name not in ours:
        from ..utils.hloc import is_installed

        if is_installed() or name.startswith("hloc."):
            from .hloc import HlocExtractor

            return HlocExtractor({"conf": conf})
    return dynamic_load(sys.modules[__name__], name)(conf)


def load_local(conf: dict) -> nn.Module:
    """Make an extractor of local features, whose `descriptor` names what projections are for.

    Raises:
        InputError: as `load`, or when it gives no local features.
    """
    model = load(conf)
    if not hasattr(model, "descriptor"):
        raise InputError(f"{conf['name']} gives no local features to project.")
    return model
