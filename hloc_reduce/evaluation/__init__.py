"""Measures of matching and localization."""
