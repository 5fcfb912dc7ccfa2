"""Matchers: descriptors of two images to matches."""
