"""Matchers: the descriptors of two images to matches."""

import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .base import Matcher

HELPERS = ("base", "integers")  # modules that are no matchers


def load(conf: dict, made_from: dict | None = None) -> "Matcher":
    """Make the matcher of a model configuration, whose `name` is a module of this package.

    Args:
        conf: the configuration.
        made_from: the features that it will match, see `Matcher.for_features`; default: unknown.

    Raises:
        InputError: when there is no such matcher, its configuration is wrong, or it cannot match
            these features.
    """
    kind = find(conf)
    conf = {key: value for key, value in conf.items() if key != "match_kind"}  # of the gate
    return kind(kind.for_features(conf, made_from or {}))


def find(conf: dict) -> "type[Matcher]":
    """Return the class of the matcher of a model configuration.

    Raises:
        InputError: when there is no such matcher.
    """
    from ..utils.configured import dynamic_load
    from .base import Matcher

    return dynamic_load(sys.modules[__name__], str(conf.get("name")), Matcher)
