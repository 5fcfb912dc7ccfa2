"""The pose of a query from 2D-3D matches, and whether to trust it."""
