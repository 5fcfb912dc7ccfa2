"""Compact maps: one file with all that localization needs. docs/map-format.md describes it."""
