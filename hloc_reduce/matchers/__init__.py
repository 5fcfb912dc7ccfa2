"""Matchers: the descriptors of two images to matches."""

import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .base import Matcher

HELPERS = ("base", "integers")  # modules that are no matchers


def load(conf: dict) -> "Matcher":
    """Make the matcher of a model configuration, whose `name` is a module of this package.

    Raises:
        InputError: when there is no such matcher, or its configuration is wrong.
    """
    kept = {key: value for key, value in conf.items() if key != "match_kind"}  # of the gate
    return find(conf)(kept)


def find(conf: dict) -> "type[Matcher]":
    """Return the class of the matcher of a model configuration.

    Raises:
        InputError: when there is no such matcher.
    """
    from ..utils.configured import dynamic_load
    from .base import Matcher

    return dynamic_load(sys.modules[__name__], str(conf.get("name")), Matcher)
