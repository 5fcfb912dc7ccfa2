"""Maps to localize in: built from photos, changed, opened, and kept in memory."""

from ..hlm.reader import is_compact
from . import from_database
from .build import main
from .georeference import align
from .grow import add, remove
from .map import Map, is_map
from .unpack import main as unpack

__all__ = [
    "Map",
    "add",
    "align",
    "from_database",
    "is_compact",
    "is_map",
    "main",
    "remove",
    "unpack",
]
