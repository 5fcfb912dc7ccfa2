"""The map of the scene in tests/conftest.py, and the matches of its queries."""

import h5py
import numpy as np

from hloc_reduce import localize_sfm, match_features, triangulation
from hloc_reduce.localization.projection import photo_scale
from hloc_reduce.utils import colmap
from hloc_reduce.utils.h5 import list_h5_names
from hloc_reduce.utils.parsers import write_pairs

MATCHER = match_features.confs["NN-ratio"]


def all_pairs(path, queries=(), skip=()):
    """Write the pairs of all map images, or of queries with all map images."""
    names = [f"db/{i}.jpg" for i in range(6) if i not in skip]
    pairs = [(a, b) for a in queries or names for b in names if a != b]
    write_pairs(pairs, path)
    return path


def enlarge(scene, factor, noise):
    """Enlarge the photos, whose keypoints then have a noise in pixels of photos as they were."""
    generator = np.random.default_rng(0)
    reference = colmap.read_model(scene.model)
    (camera,) = reference.cameras.values()
    camera.rescale(factor)
    reference.write(scene.model)
    with h5py.File(scene.features, "a") as file:
        for name in list_h5_names(scene.features):
            keypoints = file[f"{name}/keypoints"]
            moved = keypoints[:] + generator.normal(0, noise, keypoints.shape)
            keypoints[:] = (moved + 0.5) * factor - 0.5
            keypoints.attrs["uncertainty"] = photo_scale(camera)
    intrinsics = camera.width, camera.height, *camera.params
    line = f"SIMPLE_RADIAL {' '.join(map(str, intrinsics))}"
    scene.queries.write_text("".join(f"query/{i}.jpg {line}\n" for i in (6, 7)))


def build(scene):
    """Match and triangulate the images of the map, and match the queries with them."""
    _name(scene)
    all_pairs(scene.pairs)
    match_features.main(MATCHER, scene.pairs, scene.features, matches=scene.matches)
    scene.map = scene.triangulate()
    all_pairs(scene.loc_pairs, ["query/6.jpg", "query/7.jpg"])
    match_features.main(MATCHER, scene.loc_pairs, scene.features, matches=scene.loc_matches)
    return scene


def opened(scene):
    """Return a scene that was built in its folder before."""
    _name(scene)
    scene.map = colmap.read_model(scene.sfm)
    return scene


def _name(scene) -> None:
    """Name the files of the map, and the stages of it."""
    scene.pairs, scene.matches = scene.root / "pairs-db.txt", scene.root / "matches-db.h5"
    scene.loc_pairs = scene.root / "pairs-loc.txt"
    scene.loc_matches = scene.root / "matches-loc.h5"
    scene.sfm = scene.root / "sfm"
    scene.triangulate = lambda sfm=scene.sfm, **options: triangulation.main(
        sfm, scene.model, scene.images, scene.pairs, scene.features, scene.matches, **options
    )
    scene.localize = lambda **overrides: localize_sfm.main(
        **{
            "reference_sfm": scene.sfm,
            "queries": scene.queries,
            "retrieval": scene.loc_pairs,
            "features": scene.features,
            "matches": scene.loc_matches,
            "results": scene.root / "poses.txt",
            **overrides,
        }
    )
