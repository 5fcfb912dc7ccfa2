"""Supervised reduction to 64 dimensions whose first 32, 24 or 16 are good descriptors, too."""

from . import sv

PREFIXES = (64, 32, 24, 16)
# not in the paper: the losses of the prefixes are learned together
RECIPES = {name: {**recipe, "prefixes": list(PREFIXES)} for name, recipe in sv.RECIPES.items()}
DISTANCE_WEIGHTS, OF_NETWORKS = sv.DISTANCE_WEIGHTS, sv.OF_NETWORKS
OF_BASES = {"aliked": sv.OF_BASES["aliked"]}  # with that of xfeat, it was not measured
train = sv.train
