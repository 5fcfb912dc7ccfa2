"""Aggregators: local features to a global descriptor."""

import sys

from ..utils.base_model import BaseModel, dynamic_load


def load(conf: dict) -> BaseModel:
    """Make the aggregator of a model configuration, whose `name` is a module of this package.

    Raises:
        InputError: when there is no such aggregator, or its configuration is wrong.
    """
    return dynamic_load(sys.modules[__name__], str(conf.get("name")))(conf)
