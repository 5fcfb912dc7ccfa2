"""The map of the scene in tests/conftest.py, and the matches of its queries."""

from hloc_reduce import localize_sfm, match_features, triangulation
from hloc_reduce.utils.parsers import write_pairs

MATCHER = match_features.confs["NN-ratio"]


def all_pairs(path, queries=(), skip=()):
    """Write the pairs of all map images, or of queries with all map images."""
    names = [f"db/{i}.jpg" for i in range(6) if i not in skip]
    pairs = [(a, b) for a in queries or names for b in names if a != b]
    write_pairs(pairs, path)
    return path


def build(scene):
    """Match and triangulate the images of the map, and match the queries with them."""
    scene.pairs = all_pairs(scene.root / "pairs-db.txt")
    scene.matches = scene.root / "matches-db.h5"
    match_features.main(MATCHER, scene.pairs, scene.features, matches=scene.matches)
    scene.sfm = scene.root / "sfm"
    scene.triangulate = lambda sfm=scene.sfm, **options: triangulation.main(
        *(sfm, scene.model, scene.images, scene.pairs, scene.features, scene.matches), **options
    )
    scene.map = scene.triangulate()
    scene.loc_pairs = all_pairs(scene.root / "pairs-loc.txt", ["query/6.jpg", "query/7.jpg"])
    scene.loc_matches = scene.root / "matches-loc.h5"
    match_features.main(MATCHER, scene.loc_pairs, scene.features, matches=scene.loc_matches)
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
    return scene
