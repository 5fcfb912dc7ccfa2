"""Localize queries in a map: 2D-3D matches through retrieved images, PnP + RANSAC."""

import argparse
import json
from pathlib import Path

import h5py
import numpy as np
import pycolmap
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from tqdm import tqdm

from . import cli, colmap, logger, stamps
from .cli import InputError
from .io import check_matches, get_colmap_keypoints, get_matches, open_h5, replacing
from .parsers import parse_query_lists, parse_retrieval, write_poses

# Three points fit a pose always, and among hundreds of wrong matches a few more agree by chance.
MIN_INLIERS = 8
SEED = 0


def main(
    reference_sfm: Path | pycolmap.Reconstruction,
    queries: Path,
    retrieval: Path,
    features: Path,
    matches: Path,
    results: Path,
    ransac_thresh: float = 12,
    covisibility_clustering: bool = False,
    prepend_camera_name: bool = False,
    config: dict | None = None,
    overwrite: bool = False,
) -> dict[str, dict]:
    """Localize all queries of the lists that match a glob.

    Takes what hloc's `localize_sfm.main` takes.

    Args:
        reference_sfm: the map, made from the same features.
        queries: query list with intrinsics, or a glob of several.
        retrieval: pairs of queries and map images, best first.
        features: feature file of the queries.
        matches: match file of the pairs.
        results: text file of poses, one line for every query.
        ransac_thresh: inliers reproject within so many pixels.
        covisibility_clustering: solve each cluster of retrieved images that see common points by
            itself and keep the pose with the most inliers.
        prepend_camera_name: write `folder/basename` instead of `basename`.
        config: hloc's dict of options of pycolmap, under "estimation" and "refinement".
        overwrite: localize anew what is there.

    Returns:
        For each query a dict: `localized`; `qvec` (w, x, y, z) and `tvec`, camera from world;
        `num_matches` with points of the map, `num_correspondences`, the different ones among
        them, and `num_inliers` of these; `db`, its best retrieved map image. A query that PnP
        could not solve is not localized, and its pose is that of `db`.

        The same is kept in `<results>_logs.jsonl`, from which a later run goes on.

    Raises:
        InputError: when an input is missing or broken, or the map is empty.
    """
    if ransac_thresh <= 0:
        raise InputError(f"ransac_thresh is {ransac_thresh}: it must be above 0.")
    query_list = [query for queries in parse_query_lists(queries).values() for query in queries]
    retrieved = parse_retrieval(retrieval)
    in_memory = isinstance(reference_sfm, pycolmap.Reconstruction)
    reference = reference_sfm if in_memory else colmap.read_model(reference_sfm)
    if reference.num_points3D() == 0:
        raise InputError("The map is empty: no query can be localized in it.")
    config = {**(config or {})}
    config.setdefault("estimation", {"ransac": {"max_error": ransac_thresh}})

    inputs = [retrieval, features, matches, *sorted(queries.parent.glob(queries.name))]
    if not in_memory:
        inputs.append(reference_sfm / "points3D.bin")
    options = {"config": config}
    if covisibility_clustering:
        options["covisibility_clustering"] = True
    made_from = stamps.stamp(options, [path for path in inputs if path.exists()])
    log = _Log(Path(f"{results}_logs.jsonl"), made_from, overwrite or in_memory)
    todo = [query for query in query_list if query[0] not in log.records]
    if todo:
        localizer = QueryLocalizer(reference, config, covisibility_clustering)
        with open_h5(features) as feature_file, open_h5(matches) as match_file, log:
            for name, camera in tqdm(todo, desc="Localizing", unit="query"):
                record = localizer.localize(
                    name, camera, retrieved.get(name, []), feature_file, match_file
                )
                log.add(name, record)
    records = {name: log.records[name] for name, _ in query_list}
    write_poses({n: pose(r) for n, r in records.items()}, results, prepend_camera_name)
    localized = sum(record["localized"] for record in records.values())
    logger.info("Localized %d of %d queries: %s", localized, len(records), results)
    return records


def pose(record: dict) -> pycolmap.Rigid3d:
    """Return the pose of a query's record, camera from world."""
    w, x, y, z = record["qvec"]
    return pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([x, y, z, w])), np.array(record["tvec"]))


class QueryLocalizer:
    """Localizes single queries in a map.

    Args:
        reconstruction: the map.
        config: hloc's dict of options of pycolmap, under "estimation" and "refinement".
        covisibility_clustering: as of `main`.
    """

    def __init__(
        self,
        reconstruction: pycolmap.Reconstruction,
        config: dict | None = None,
        covisibility_clustering: bool = False,
    ):
        self.config = config or {}
        self.covisibility_clustering = covisibility_clustering
        self.images = {image.name: image for image in reconstruction.images.values()}
        ids = np.array(sorted(reconstruction.point3D_ids()), np.int64)
        self.point_ids = ids
        self.points = np.array([reconstruction.points3D[i].xyz for i in ids])
        self.first = self.images[min(self.images)]
        self._rows: dict[str, np.ndarray] = {}

    def point_rows(self, name: str) -> np.ndarray:
        """Return for each keypoint of a map image the row of `points` (N,), -1 where none."""
        if name not in self._rows:
            ids = colmap.point3D_ids(self.images[name])
            self._rows[name] = np.where(ids >= 0, np.searchsorted(self.point_ids, ids), -1)
        return self._rows[name]

    def correspondences(
        self, name: str, num_keypoints: int, db_names: list[str], match_file: h5py.File
    ) -> tuple[np.ndarray, int]:
        """Collect the 2D-3D matches of a query with so many keypoints through retrieved images.

        Returns:
            Different pairs (M, 2) of keypoint index and row of `points`, sorted, and the number
            of matches that they stand for.
        """
        found = [np.zeros((0, 2), np.int64)]
        for db_name in db_names:
            matches, _ = get_matches(match_file, name, db_name)
            rows = self.point_rows(db_name)
            check_matches(matches, (name, db_name), (num_keypoints, len(rows)))
            rows = rows[matches[:, 1]]
            found.append(np.stack([matches[:, 0], rows], 1)[rows >= 0])
        found = np.concatenate(found)
        return np.unique(found, axis=0), len(found)

    def clusters(self, db_names: list[str]) -> list[list[str]]:
        """Split map images into clusters that see no common point, the largest first."""
        rows = [self.point_rows(name) for name in db_names]
        image = np.repeat(np.arange(len(rows)), [len(part) for part in rows])
        point = np.concatenate([*rows, np.zeros(0, np.int64)])
        seen = coo_array(
            (np.ones((point >= 0).sum()), (image[point >= 0], point[point >= 0])),
            shape=(len(rows), len(self.points)),
        ).tocsr()
        number, label = connected_components(seen @ seen.T, directed=False)
        clusters = [[] for _ in range(number)]
        for name, cluster in zip(db_names, label, strict=True):
            clusters[cluster].append(name)
        return sorted(clusters, key=len, reverse=True) or [[]]

    def localize(
        self,
        name: str,
        camera: pycolmap.Camera,
        retrieved: list[str],
        feature_file: h5py.File,
        match_file: h5py.File,
    ) -> dict:
        """Localize a query; the record is as `main` returns it."""
        db_names = [db_name for db_name in retrieved if db_name in self.images]
        if len(db_names) < len(retrieved):
            absent = len(retrieved) - len(db_names)
            logger.warning("%d images retrieved for %s are not in the map.", absent, name)
        if not db_names:
            logger.warning("No map image was retrieved for %s.", name)
        keypoints, _ = get_colmap_keypoints(feature_file, name)
        clusters = self.clusters(db_names) if self.covisibility_clustering else [db_names]
        solved = []
        for cluster in clusters:
            pairs, num_matches = self.correspondences(name, len(keypoints), cluster, match_file)
            found = colmap.estimate_pose(
                keypoints[pairs[:, 0]], self.points[pairs[:, 1]], camera, self.config, SEED
            )
            num_inliers = int(found["num_inliers"]) if found else 0
            solved.append((num_inliers, num_matches, len(pairs), found))
        num_inliers, num_matches, num_correspondences, found = max(solved, key=lambda s: s[0])
        localized = num_inliers >= MIN_INLIERS
        best = self.images[db_names[0]] if db_names else self.first
        cam_from_world = found["cam_from_world"] if localized else best.cam_from_world()
        x, y, z, w = cam_from_world.rotation.quat
        return {
            "localized": localized,
            "qvec": [float(value) for value in (w, x, y, z)],
            "tvec": [float(value) for value in cam_from_world.translation],
            "num_matches": num_matches,
            "num_correspondences": num_correspondences,
            "num_inliers": num_inliers,
            "db": db_names[0] if db_names else None,
        }


class _Log:
    """Records of queries, one JSON line each, under a first line that says what made them."""

    def __init__(self, path: Path, made_from: dict, overwrite: bool):
        self.path, self.records = path, {}
        header = json.dumps(made_from, sort_keys=True)
        lines = [] if overwrite or not path.exists() else path.read_text().split("\n")
        if lines and lines[0] == header:
            # what follows the last line end was cut off by a kill
            self.records = dict(json.loads(line) for line in lines[1:-1])
        kept = [json.dumps(item) for item in self.records.items()]
        with replacing(path) as temporary:
            temporary.write_text("\n".join([header, *kept]) + "\n")

    def __enter__(self) -> None:
        self.file = self.path.open("a")

    def __exit__(self, *_) -> None:
        self.file.close()

    def add(self, name: str, record: dict) -> None:
        self.records[name] = record
        self.file.write(json.dumps([name, record]) + "\n")
        self.file.flush()


def _main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__,
        epilog="example: python -m hloc_reduce.localize_sfm --reference_sfm outputs/sfm "
        "--queries queries.txt --retrieval pairs.txt --features outputs/feats-dog-sift_sv64.h5 "
        "--matches outputs/matches.h5 --results outputs/poses.txt",
        formatter_class=cli.HelpFormatter,
    )
    parser.add_argument("--reference_sfm", type=Path, required=True, help="folder of the map")
    parser.add_argument(
        "--queries", type=Path, required=True, help="query list with intrinsics, or a glob"
    )
    parser.add_argument("--retrieval", type=Path, required=True, help="pairs of queries and map")
    parser.add_argument("--features", type=Path, required=True, help="feature file")
    parser.add_argument("--matches", type=Path, required=True, help="match file")
    parser.add_argument("--results", type=Path, required=True, help="text file of poses")
    parser.add_argument(
        "--ransac_thresh", type=float, default=12.0, help="inliers reproject within so many pixels"
    )
    parser.add_argument(
        "--covisibility_clustering",
        action="store_true",
        help="solve each cluster of retrieved images that see common points by itself",
    )
    parser.add_argument(
        "--prepend_camera_name", action="store_true", help="write folder/basename of each query"
    )
    parser.add_argument("--overwrite", action="store_true", help="localize anew what is there")
    main(**vars(parser.parse_args()))


if __name__ == "__main__":
    cli.run(_main)
