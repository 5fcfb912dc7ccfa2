"""Maps to localize in: built from photos, opened, and kept in memory."""

from .build import main
from .map import Map, is_map

__all__ = ["Map", "is_map", "main"]
