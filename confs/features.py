"""Local features: `<descriptor>`, 128-D, and `<descriptor>_<scheme><dim>`, its projections."""

from hloc_reduce.descriptors import DESCRIPTORS

SCHEMES = ("pca", "sv")
DIMS = (64, 32, 24, 16)

PREPROCESSING = {"grayscale": True, "resize_max": 1600}


def base(descriptor: str) -> dict:
    """Return the model configuration of a base descriptor at DoG keypoints."""
    return {"name": "dog", "descriptor": descriptor}


def feature(name: str, model: dict) -> dict:
    """Return the configuration of a feature."""
    return {"output": f"feats-dog-{name}", "model": model, "preprocessing": PREPROCESSING}


confs = {name: feature(name, base(name)) for name in DESCRIPTORS} | {
    name: feature(name, {"name": "reduced", "base": base(descriptor), "projection": name})
    for descriptor in DESCRIPTORS
    for scheme in SCHEMES
    for dim in DIMS
    for name in [f"{descriptor}_{scheme}{dim}"]
}
