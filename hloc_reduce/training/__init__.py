"""Training of projections on the tracks of COLMAP maps."""
