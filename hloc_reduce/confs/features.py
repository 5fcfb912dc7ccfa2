"""Local features: base descriptors, their projections, networks, and features of YAML files.

`<descriptor>_<scheme><dim>` are the paper's; `<descriptor>_nested` is 64-D, and
`<descriptor>_nested@<dim>` its first dimensions. `colmap_sift` is COLMAP's SIFT.
"""

import re
from pathlib import Path

import numpy as np

from .. import projections
from ..descriptors import BASE_DESCRIPTORS, COLMAP_SIFT, DESCRIPTORS, DIM
from ..detectors.dog import HLOC_OPTIONS, KEYPOINT_SETTINGS
from ..networks import ALIKED, EDGEPOINT2, MINI, NETWORKS
from ..utils.cli import InputError, choose
from ..utils.codes import CODED, STORAGES
from ..utils.parsers import read_yaml

RECOMMENDED = "colmap_sift_sv64"  # needs no download (docs/features.md)
DIMS = (64, 32, 24, 16)
# the schemes and dimensions of the projections of each base descriptor; and who has a nested one
PROJECTIONS: dict[str, tuple[tuple[str, ...], tuple[int, ...]]] = {
    **dict.fromkeys((*DESCRIPTORS, "aliked"), (("pca", "us", "ss", "sv"), DIMS)),
    COLMAP_SIFT: (("pca", "sv"), DIMS),
    **dict.fromkeys(("xfeat", "edgepoint2_m64"), (("pca", "sv"), DIMS[1:])),
}
NESTED = (*DESCRIPTORS, "xfeat", "aliked")

PREPROCESSING = {"grayscale": True, "resize_max": 1600}
IN_COLOUR = {**PREPROCESSING, "grayscale": False, "upright": True}  # of networks

# the extractors of networks by the names of their features, such as edgepoint2_m32
MODELS = (
    {name: {"name": "mini", "model_name": name} for name in MINI}
    | {
        f"edgepoint2_{name.lower()}": {"name": "edgepoint2", "model_name": name}
        for name in EDGEPOINT2
    }
    | {"xfeat": {"name": "xfeat"}}
    | {
        name.removesuffix("-n16").replace("-", "_"): {"name": "aliked", "model_name": name}
        for name in ALIKED
    }
)


# the extractors of networks, and the networks that they run by default
DEFAULT_NETWORKS = {"mini": "mini32", "edgepoint2": "M32", "xfeat": "xfeat", "aliked": "aliked-n16"}
BASES = (*BASE_DESCRIPTORS, *MODELS)  # features whose descriptors are projected


def base(descriptor: str) -> dict:
    """Return the model configuration of a base descriptor."""
    at_dog = {"name": "dog", "descriptor": descriptor, "keypoints": KEYPOINT_SETTINGS[0]}
    return MODELS.get(descriptor, at_dog)


def feature(name: str, model: dict) -> dict:
    """Return the configuration of a feature."""
    if network_of(model):
        return {"output": f"feats-{name}", "model": model, "preprocessing": IN_COLOUR}
    return {"output": f"feats-dog-{name}", "model": model, "preprocessing": PREPROCESSING}


def names(descriptor: str) -> list[str]:
    """List the projections of a base descriptor."""
    schemes, dims = PROJECTIONS[descriptor]
    listed = [f"{descriptor}_{scheme}{dim}" for scheme in schemes for dim in dims]
    if descriptor not in NESTED:
        return listed
    nested = f"{descriptor}_nested"
    return [*listed, nested, *(f"{nested}@{dim}" for dim in DIMS[1:])]


def matcher_of(conf: dict) -> str:
    """Return the matcher that suits a feature best, a key of `confs.matchers`."""
    return "NN-mutual" if network_of(conf["model"]) else "NN-ratio"  # docs/lab.md


def base_of(model: dict) -> dict:
    """Return the configuration of the extractor whose descriptors a model projects, or its own."""
    return model.get("base", model)


def network_of(model: dict) -> str | None:
    """Return the key of `networks.NETWORKS` whose features a model has or projects, if any."""
    found = base_of(model)
    if str(found["name"]) not in DEFAULT_NETWORKS:
        return None
    return str(found.get("model_name", DEFAULT_NETWORKS[found["name"]]))


confs = {name: feature(name, base(name)) for name in BASE_DESCRIPTORS} | {
    name: feature(name, {"name": "reduced", "base": base(descriptor), "projection": name})
    for descriptor in PROJECTIONS
    for name in names(descriptor)
}
confs |= {name: feature(name, model) for name, model in MODELS.items()}


def dimension(name: str) -> int | None:
    """Return the dimension of the descriptors of a key of `confs`; None if only its model knows."""
    projection = confs[name]["model"].get("projection")
    if projection is None:
        network = network_of(confs[name]["model"])
        if network in NETWORKS:
            return NETWORKS[network].dim
        return DIM if descriptor_of(confs[name]["model"]) else None
    digits = re.search(r"\d+$", projection)
    return int(digits[0]) if digits else DIMS[0]


def get(
    name: str,
    projection: Path | None = None,
    storage: str = STORAGES[0],
    keypoints: str = KEYPOINT_SETTINGS[0],
) -> tuple[str, dict]:
    """Return the name and the configuration of a feature.

    Args:
        name: a key of `confs`, or a YAML file with a `model` and perhaps `preprocessing`, which
            names the feature.
        projection: file of another projection of the same base, which names the feature.
        storage: of the descriptors, one of `codes.STORAGES`.
        keypoints: settings of DoG, one of `detectors.dog.KEYPOINT_SETTINGS`; "adaptive" keeps those
            of a YAML file.

    Raises:
        InputError: for an unknown name, a file that is not a feature's configuration, or settings
            of DoG for a feature without it.
    """
    choose("storage", storage, STORAGES)
    choose("keypoints", keypoints, KEYPOINT_SETTINGS)
    if Path(name).suffix in (".yaml", ".yml"):
        name, conf = Path(name).stem, read(Path(name))
    else:
        conf = confs[choose("feature", name, confs)]
    if storage != STORAGES[0]:
        conf = {**conf, "storage": storage}
    if keypoints != KEYPOINT_SETTINGS[0] and descriptor_of(conf["model"]) is None:
        raise InputError(
            f"--keypoints {keypoints} is for DoG keypoints, and {name} finds its own: leave out "
            "--keypoints."
        )
    conf = with_settings(conf, keypoints)
    if projection is None:
        return name, conf
    base = base_of(conf["model"])
    model = {"name": "reduced", "base": base, "projection": str(projection)}
    file, prefix = projections.split_prefix(projection)
    name = Path(file).stem + (prefix and f"@{prefix}")
    return name, {**conf, "output": feature(name, model)["output"], "model": model}


def with_settings(conf: dict, keypoints: str) -> dict:
    """Return the configuration of a feature with settings of DoG, if it uses DoG; see `get`."""
    if keypoints == KEYPOINT_SETTINGS[0]:
        return conf
    return {**conf, "model": with_keypoints(conf["model"], keypoints)}


def with_keypoints(model: dict, keypoints: str) -> dict:
    """Return the configuration of a model with other settings of DoG, if it uses DoG."""
    if "base" in model:
        return {**model, "base": with_keypoints(model["base"], keypoints)}
    return {**model, "keypoints": keypoints} if model["name"] == "dog" else model


def _with_weights(model: dict, weights: str) -> dict:
    """Return the configuration of a model with other weights of its network."""
    if "base" in model:
        return {**model, "base": _with_weights(model["base"], weights)}
    return {**model, "weights": weights}


def descriptor_of(model: dict) -> str | None:
    """Return the base descriptor of a model at DoG keypoints; None for another extractor."""
    found = base_of(model)
    return found.get("descriptor", "sift") if found["name"] == "dog" else None


def keypoints_of(model: dict) -> str | None:
    """Return the name of a model's DoG settings; None for its own options."""
    found = base_of(model)
    return found.get("keypoints") if found.get("options", HLOC_OPTIONS) == HLOC_OPTIONS else None


def levels(conf: dict) -> np.ndarray | None:
    """Return the levels (D, 2**bits) by which a feature is stored; None if they are not codes.

    Raises:
        InputError: when its storage needs levels that there are none of.
    """
    storage = conf.get("storage")
    if storage not in CODED:
        return None
    file = level_file(conf)
    if file is None:
        name = conf["output"].removeprefix("feats-").removeprefix("dog-")
        raise InputError(
            f"{name} has no projection, but --storage {storage} needs one with levels: use a "
            "feature with a projection, --storage uint8, or train levels with --scheme raw of "
            "hloc_reduce.training."
        )
    return projections.levels(file, storage)


def level_file(conf: dict) -> str | None:
    """Return the projection that has the levels of a feature, if any.

    The levels of a network's own descriptors ship as a projection of its name, those of weights of
    the user do not.
    """
    model = conf["model"]
    if projection := model.get("projection"):
        return projection
    if model.get("weights"):
        return None
    shipped = (name for name in projections.names() if name in MODELS)
    return next((name for name in shipped if network_of(MODELS[name]) == network_of(model)), None)


def of_patches(name: str) -> tuple[str, str | None]:
    """Return the base descriptor and the projection, if any, of a feature of patches.

    Args:
        name: name of a feature, or its YAML file.

    Raises:
        InputError: for an unknown feature, or one that cannot describe patches.
    """
    name, conf = get(name)
    descriptor = descriptor_of(conf["model"])
    if descriptor in (None, COLMAP_SIFT):
        raise InputError(f"{name} describes photos, not patches.")
    return choose("descriptor", descriptor, DESCRIPTORS), conf["model"].get("projection")


def read(path: Path) -> dict:
    """Read the configuration of a feature from a YAML file.

    Raises:
        InputError: when the file is not a feature's configuration.
    """
    conf = check(read_yaml(path), path)
    return {"output": f"feats-{path.stem}", **conf}


def check(content: object, path: Path) -> dict:
    """Check the configuration of a feature in a file, and complete it.

    Args:
        content: with `model`, and perhaps `preprocessing` and an `output`, which is ignored.
        path: the file, for messages.

    Returns:
        Its `model` and `preprocessing`.

    Raises:
        InputError: when it is not a feature's configuration.
    """
    content = content if isinstance(content, dict) else {}
    model = content.get("model")
    base = model.get("base", model) if isinstance(model, dict) else None
    if not (
        isinstance(model, dict) and isinstance(base, dict) and "name" in model and "name" in base
    ):
        raise InputError(f"{path} has no model with a name, such as: model: {{name: dog}}.")
    projection = model.get("projection", "" if model["name"] == "reduced" else None)
    if projection is not None and not (isinstance(projection, str) and projection):
        raise InputError(f"{path}: the model {model['name']} needs a projection.")
    if base["name"] == "dog" and "keypoints" not in base:
        model = with_keypoints(model, KEYPOINT_SETTINGS[0])
    if projection and Path(projections.split_prefix(projection)[0]).suffix:
        model = {**model, "projection": str(Path(projection).absolute())}  # for other machines
    if (weights := base.get("weights")) is not None:
        if not isinstance(weights, str):
            raise InputError(f"{path}: weights is a file, not {weights!r}.")
        model = _with_weights(model, str(Path(weights).absolute()))
    given = content.get("preprocessing") or {}
    if not isinstance(given, dict):
        raise InputError(f"{path}: preprocessing cannot be {given!r}.")
    # hloc's confs also have an `output`, which is ignored
    unknown = content.keys() - {"model", "preprocessing", "output"}
    unknown |= given.keys() - {*IN_COLOUR, "resize_force", "resize_min"}
    if unknown:
        raise InputError(f"{path}: unknown keys {', '.join(map(str, sorted(unknown, key=str)))}.")
    preprocessing = {**(IN_COLOUR if network_of(model) else PREPROCESSING), **given}
    resize_max = preprocessing["resize_max"]
    if resize_max is not None and not (isinstance(resize_max, int) and resize_max > 0):
        raise InputError(f"{path}: resize_max is a number of pixels or null, not {resize_max!r}.")
    resize_min = preprocessing.get("resize_min", 0)
    if type(resize_min) is not int or not 0 <= resize_min <= (resize_max or 0):
        said = f"a number of pixels, at most resize_max ({resize_max}), not {resize_min!r}"
        raise InputError(f"{path}: resize_min is {said}.")
    return {"model": model, "preprocessing": preprocessing}
