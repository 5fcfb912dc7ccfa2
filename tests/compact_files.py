"""What tests of compact maps share: all that a file has is used, or a part of it is changed."""

import json

import numpy as np
from safetensors import safe_open
from safetensors.numpy import load_file, save_file

from hloc_reduce.maps import contents


def use(path):
    """Open a map, and use all that it has."""
    found = contents.read(path)
    of_map, names = found.reference, list(found.names)
    for name in names:
        of_map.pose(name)
        of_map.camera(name)
        of_map.lift(name, np.arange(min(3, of_map.num_keypoints(name))))
    of_map.points.all()
    of_map.views()
    of_map.descriptors(np.arange(len(of_map.points)))
    of_map.global_descriptors()
    of_map.check_names()
    size = of_map.global_descriptors().shape[1]
    assert set(found.retrieve(np.ones(size, np.float32), 3)) <= set(names)
    found.steps[0].match({"descriptors": np.eye(found.dim, 5, dtype=np.float32)}, names[:3])
    return found


def change(file, name, value=None, **metadata):
    """Write a file with a changed array, or metadata."""
    arrays = load_file(file)
    with safe_open(file, "np") as opened:
        known = json.loads(opened.metadata()["map"])
    if name:
        arrays[name] = value(arrays[name].copy())
    save_file(arrays, file, {"map": json.dumps(known | metadata)})
