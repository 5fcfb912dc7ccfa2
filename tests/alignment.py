"""How far reconstructed points are from the true ones, up to a similarity."""

import numpy as np


def similarity(points, truth):
    """Fit truth = scale * rotation @ point + translation; return the residuals."""
    centre, true_centre = points.mean(0), truth.mean(0)
    u, s, vt = np.linalg.svd((truth - true_centre).T @ (points - centre))
    flip = np.diag([1, 1, np.linalg.det(u @ vt)])
    scale = (s * np.diag(flip)).sum() / ((points - centre) ** 2).sum()
    return truth - true_centre - scale * (points - centre) @ (u @ flip @ vt).T
