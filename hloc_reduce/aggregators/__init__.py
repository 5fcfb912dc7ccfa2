"""Aggregators: local features to a global descriptor."""
