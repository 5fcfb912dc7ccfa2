"""Count wrong poses that are accepted as localized, and true poses that are refused.

Each map is tried with held-out photos of its place, with photos of all other places, and with
blurred, mirrored, black and noisy versions of its own; all with their intrinsics and without, its
own also with a wrong focal length. Cropped and squeezed versions of its own are tried without
intrinsics. In a COLMAP model, every third photo is held out. Keypoints and maps are the same for
all features, which have one base: those of colmap_sift_sv64, or of a network. Another --seed holds
out other photos, builds other maps, and draws other photos of other places. Results go to
trials.csv, and as a curve to false_accepts.svg; an interrupted run resumes with the next place.
"""

import argparse
import copy
import csv
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import h5py
import numpy as np
import pycolmap
import torch
from false_accepts_tables import RESHAPED, add_places, levels, own_table, plot, table

from hloc_reduce import extract_features, localize_inloc, maps, projections
from hloc_reduce.confs import features as features_confs
from hloc_reduce.confs import matchers as matchers_confs
from hloc_reduce.datasets import scans, true_poses
from hloc_reduce.datasets.aachen import Aachen
from hloc_reduce.datasets.inloc import InLoc
from hloc_reduce.evaluation.poses import pose_error
from hloc_reduce.localization import intrinsics, mirrored, query
from hloc_reduce.localization.confidence import DEFAULT_GATE, Gate
from hloc_reduce.localization.query import merged
from hloc_reduce.localization.references import Reference, ScanMap, SfmMap
from hloc_reduce.localize_sfm import RANSAC_THRESH
from hloc_reduce.matchers.nearest_neighbor import mutual_nearest
from hloc_reduce.training.tracks import parse_maps
from hloc_reduce.utils import cli, colmap
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.codes import FLOATS, restore, store
from hloc_reduce.utils.feature_files import (
    get_blur,
    get_colmap_keypoints,
    get_descriptors,
    get_image_size,
)
from hloc_reduce.utils.files import replacing, write_csv
from hloc_reduce.utils.h5 import open_file, open_h5
from hloc_reduce.utils.images import read_image

MAP_FEATURES = {"colmap_sift": "colmap_sift_sv64"}  # of a base; default: the base itself
EVERY = 3
ALTERED = ("blurred", "mirrored", "black", "noise")
BLUR = 6.0  # standard deviation in pixels
CROPPED, SQUEEZED = 0.7, 0.75  # share of width and height, share of the height
OFF = 1.15  # factor of a wrong focal length
# a pose is true within metres, or a share of the extent of the cameras, and degrees
TRUE_METRES, TRUE_EXTENT, TRUE_DEGREES = 0.25, 0.01, 2.0
# a pose that is not true is near within this share of the scene's depth and these degrees
NEAR, NEAR_DEGREES = 0.1, 5.0
COLUMNS = (
    *("feature", "map", "place", "photo", "kind", "intrinsics", "matches", "inliers", "confidence"),
    *("agreement", "refusal", "position_error", "rotation_error_deg", "outcome"),
)


@dataclass
class Place:
    """A map and its own queries.

    Args:
        name: name of the place.
        images: folder of all its photos.
        queries: names, intrinsics and true poses, camera from world.
        reference: the map.
        names: the images of the map.
        features: base descriptors of the images of the map and of the queries.
        metric: whether units are metres.
        base: the name of the base feature.
        extent: norm of the standard deviations of the positions of the images.
        cameras: what the images of the map tell about guessed intrinsics.
    """

    name: str
    images: Path
    queries: list[tuple[str, pycolmap.Camera, pycolmap.Rigid3d]]
    reference: Reference
    names: list[str]
    features: Path
    metric: bool
    base: str
    extent: float
    cameras: intrinsics.MapCameras


def split(name: str, images: Path, model: Path, output: Path, seed: int, base: str) -> Place:
    """Build a map of two thirds of the photos of a COLMAP model; the others are its queries."""
    reconstruction = colmap.read_model(model)
    photos = sorted(reconstruction.images.values(), key=lambda image: image.name)
    held_out = photos[(EVERY // 2 + seed) % EVERY :: EVERY]
    # copies, which outlive the model
    queries = [
        (photo.name, copy.deepcopy(photo.camera), photo.cam_from_world()) for photo in held_out
    ]
    for photo in held_out:
        reconstruction.deregister_frame(photo.frame_id)
    reduced = output / "model"
    reduced.mkdir(parents=True, exist_ok=True)
    reconstruction.write_binary(reduced)
    return _of_model(name, images, reduced, queries, output, False, base)


def of_dataset(root: Path, output: Path, _seed: int, base: str) -> Place:
    """Build the map of a data set in the layout of Aachen Day-Night or of InLoc."""
    if (root / "database/cutouts").is_dir():
        return _of_scans(InLoc(root), output, base)
    place = Aachen(root)
    listed = [query for part in place.query_lists().values() for query in part]
    truth = true_poses([name for name, _ in listed], place.ground_truth, True)
    queries = [(name, camera, truth[name]) for name, camera in listed]
    model = place.reference_model
    return _of_model(root.name, place.images, model, queries, output, True, base)


def _of_model(
    name: str,
    images: Path,
    model: Path,
    queries: list,
    output: Path,
    metric: bool,
    base: str,
) -> Place:
    built = maps.main(output / "map", images, model, MAP_FEATURES.get(base, base))
    reference = SfmMap(colmap.read_model(built.sfm))
    names = sorted(reference.images)
    features = _extract(images, output, [*names, *(query for query, _, _ in queries)], base)
    centres = [image.projection_center() for image in reference.images.values()]
    extent = float(np.linalg.norm(np.std(centres, axis=0)))
    cameras = intrinsics.of_cameras(image.camera for image in reference.images.values())
    return Place(name, images, queries, reference, names, features, metric, base, extent, cameras)


def _of_scans(place: InLoc, output: Path, base: str) -> Place:
    names = place.map_names()
    features = _extract(place.root, output, [*names, *place.query_names()], base)
    truth = true_poses(place.query_names(), place.ground_truth, True)
    queries = [(name, camera, truth[name]) for name, camera in place.queries(features)]
    points = localize_inloc.lift_keypoints(place.root, features, names, output / "points3D.h5")
    poses = {name: scans.read_pose(place.root, name) for name in names}
    reference = ScanMap(open_file(points), open_file(features), poses)
    extent = float(np.linalg.norm(np.std([pose[:3, 3] for pose in poses.values()], axis=0)))
    with open_h5(features) as file:
        cameras = intrinsics.MapCameras({}, {get_image_size(file, name) for name in names})
    about = place.root.name, place.root, queries, reference, names, features
    return Place(*about, True, base, extent, cameras)


def _extract(images: Path, output: Path, names: list[str], base: str) -> Path:
    conf = features_confs.confs[base]
    return extract_features.main(conf, images, output, image_list=sorted(set(names)))


def alter(
    place: Place, output: Path, seed: int
) -> list[tuple[str, pycolmap.Camera | None, pycolmap.Rigid3d | None]]:
    """Write altered photos of a place's queries, and extract their features.

    Returns:
        Names; intrinsics, None for cropped and squeezed photos; and true poses, None if unknown.
    """
    noise = np.random.default_rng(seed)
    altered = []
    for i, (name, camera, truth) in enumerate(place.queries):
        kind = ALTERED[i % 2] if i > 1 else ALTERED[2 + i]
        photo = read_image(place.images / name)
        height, width = photo.shape[:2]
        cut, kept = int((1 - CROPPED) * height), int(CROPPED * width)
        views = {
            "blurred": lambda photo=photo: cv2.GaussianBlur(photo, (0, 0), BLUR),
            "mirrored": lambda photo=photo: photo[:, ::-1],
            "black": lambda photo=photo: np.zeros_like(photo),
            "noise": lambda photo=photo: noise.integers(0, 256, photo.shape, np.uint8),
            "cropped": lambda photo=photo, cut=cut, kept=kept: photo[cut:, :kept],
            "squeezed": lambda photo=photo: cv2.resize(
                photo, None, fx=1, fy=SQUEEZED, interpolation=cv2.INTER_AREA
            ),
        }
        for view in (kind, *RESHAPED):
            path = output / "altered" / view / Path(name).with_suffix(".png")
            if not path.exists():
                with replacing(path) as temporary:
                    encoded = cv2.imencode(".png", views[view]()[..., ::-1])[1]
                    temporary.write_bytes(encoded.tobytes())
            named = path.relative_to(output / "altered").as_posix()
            here = truth if view in ("blurred", *RESHAPED) else None
            altered.append((named, None if view in RESHAPED else camera, here))
    names = [name for name, _, _ in altered]
    extract_features.main(
        features_confs.confs[place.base],
        output / "altered",
        image_list=names,
        feature_path=output / "altered.h5",
    )
    return altered


class Described:
    """Reads base descriptors as those of a feature, with the precision of its storage.

    Args:
        feature: `<name>` or `<name>:<storage>`, the base descriptor or a projection of it.
    """

    def __init__(self, feature: str):
        name, _, storage = feature.partition(":")
        self.storage = storage or FLOATS[0]
        _, conf = features_confs.get(name, storage=self.storage)
        projection, self.levels = conf["model"].get("projection"), features_confs.levels(conf)
        self.project = projections.load(projection) if projection else torch.nn.Identity()

    @torch.no_grad()
    def __call__(self, file: h5py.File, name: str, is_query: bool = False) -> torch.Tensor:
        """Return the descriptors (N, D) of an image of an open feature file; queries as floats."""
        described = self.project(torch.from_numpy(get_descriptors(file, name))).numpy()
        storage = FLOATS[0] if is_query else self.storage
        return torch.from_numpy(
            restore(*store({"descriptors": described.T}, storage, self.levels), unbiased=True)
        )


def base_name(feature: str) -> str:
    """Return the name of the feature whose descriptors a feature projects, or its own."""
    model = features_confs.base_of(features_confs.get(feature)[1]["model"])
    return next(name for name, conf in features_confs.confs.items() if conf["model"] == model)


def trials(
    place: Place, others: list[Place], output: Path, number: int, seed: int
) -> Iterator[tuple]:
    """Yield the photos to try a map with: place, name, camera, true pose, features and kind."""
    for name, camera, truth in place.queries:
        yield place, name, camera, truth, place.features, "own"
    for name, camera, truth in alter(place, output, seed):
        yield place, name, camera, truth, output / "altered.h5", name.split("/")[0]
    pool = [(other, *query[:2]) for other in others for query in other.queries]
    chosen = np.random.default_rng(seed).choice(len(pool), min(number, len(pool)), replace=False)
    for other, name, camera in (pool[i] for i in sorted(chosen)):
        yield other, name, camera, None, other.features, "other"


def run(
    place: Place,
    others: list[Place],
    output: Path,
    feature: str,
    number: int,
    matcher: str,
    seed: int,
) -> list[dict]:
    """Try a map with all photos, and return the rows of trials.csv."""
    model = matchers_confs.confs[matcher]["model"]
    ratio_threshold = model.get("ratio_threshold")
    tried = list(trials(place, others, output, number, seed))
    describe = Described(feature)
    shown, rows = {}, []
    with open_h5(place.features) as file:
        described = {name: describe(file, name) for name in place.names}
    for name, descriptors in described.items():
        ids, _ = place.reference.lift(name, np.arange(len(descriptors)))
        shown[name] = torch.from_numpy(np.flatnonzero(ids >= 0))
    gate = DEFAULT_GATE.of_matches(model, described[place.names[0]].shape[1])

    def match(path: Path, name: str) -> tuple[np.ndarray, dict, Gate]:
        with open_h5(path) as file:
            query = describe(file, name, is_query=True)
            keypoints = get_colmap_keypoints(file, name)[0]
            its_gate = gate.of_photo(get_blur(file, name))
        matches = {}
        for other in place.names:
            rows_of = shown[other]
            found, cosine = mutual_nearest(described[other], query, ratio_threshold, rows_of)
            matched = torch.nonzero(found >= 0)[:, 0]
            matched = matched[cosine[matched].argsort(descending=True)]
            matches[other] = torch.stack([found[matched], rows_of[matched]], 1).numpy()
        return keypoints, matches, its_gate

    for source, name, camera, truth, path, kind in tried:
        images = source.images if path == source.features else output / "altered"
        with open_h5(path) as file:
            size = get_image_size(file, name)
        matched, flipped = match(path, name), None
        known = ("given", "off", "guess") if kind == "own" else ("given", "guess")
        for given in known if camera else ("guess",):
            its_camera, refinement = intrinsics_of(camera, size, given, place.cameras)
            row = localize(place, matched, its_camera, refinement)
            found = row["agreement"], row["confidence"]
            if not row["refusal"] and mirrored.is_doubtful(*found):
                flipped = flipped or match(*mirror(images, output, name, place.base))
                its_camera = mirrored.mirror(its_camera)
                other_row = localize(place, flipped, its_camera, refinement, thorough=False)
                values = row["confidence"], other_row["confidence"]
                row["refusal"] = mirrored.refusal(*values, gate) or ""
            cam_from_world = row.pop("cam_from_world")
            row |= outcome(place, row, cam_from_world, truth)
            first = {"feature": feature, "map": place.name, "place": source.name}
            rows.append(first | {"photo": name, "kind": kind, "intrinsics": given} | row)
    return rows


def mirror(images: Path, output: Path, name: str, base: str) -> tuple[Path, str]:
    """Extract the features of the mirror image of a photo; return their file and its name."""
    conf = copy.deepcopy(features_confs.confs[base])
    conf["preprocessing"]["mirrored"] = True
    path = output / f"mirrored-{images.parent.name}-{images.name}.h5"
    return extract_features.main(conf, images, image_list=[name], feature_path=path), name


def intrinsics_of(
    camera: pycolmap.Camera | None,
    size: tuple[int, int],
    given: str,
    of_map: intrinsics.MapCameras,
) -> tuple[pycolmap.Camera, dict]:
    """Return the intrinsics to try a photo with, and the configuration that refines them.

    Args:
        camera: its true intrinsics.
        size: its width and height.
        given: "given", the true ones; "off", with a wrong focal length; or "guess".
        of_map: what the map tells about guessed ones.
    """
    if given == "guess":
        width, height = size
        guess, source = intrinsics.infer(np.empty((height, width), np.uint8), of_map)
        return guess, intrinsics.refinement(guess, source, of_map)
    camera = copy.deepcopy(camera)
    if given == "off":
        params = camera.params.copy()
        params[list(camera.focal_length_idxs())] *= OFF
        camera.params = params
    return camera, {}


def localize(
    place: Place,
    matched: tuple[np.ndarray, dict, Gate],
    camera: pycolmap.Camera,
    refinement: dict,
    thorough: bool = True,
) -> dict:
    """Localize a query, given its keypoints, matches and gate; its intrinsics may be refined."""
    keypoints, matches, gate = matched
    config = merged(query.ransac_options(RANSAC_THRESH, camera), refinement)
    options = config, gate, thorough
    cam_from_world, info = query.localize(place.reference, keypoints, camera, matches, *options)
    depths = [np.nan]
    if cam_from_world is not None and info["inliers"].any():
        points = info["points3D"][info["inliers"]]
        depths = (points @ cam_from_world.rotation.matrix().T + cam_from_world.translation)[:, 2]
    return {
        "matches": info["num_correspondences"],
        "inliers": info["num_inliers"],
        "confidence": info["confidence"],
        "agreement": info["agreement"],
        "refusal": info["reason"] or "",
        "cam_from_world": cam_from_world,
        "depth": float(np.median(depths)),
    }


def outcome(
    place: Place, row: dict, cam_from_world: pycolmap.Rigid3d | None, truth: pycolmap.Rigid3d | None
) -> dict:
    """Return the errors of a pose, and whether it is true, near, wrong or none."""
    depth = row.pop("depth")
    if cam_from_world is None:
        return {"position_error": "", "rotation_error_deg": "", "outcome": "none"}
    if truth is None:
        return {"position_error": "", "rotation_error_deg": "", "outcome": "wrong"}
    distance, degrees = pose_error(cam_from_world, truth)
    limit = max(TRUE_EXTENT * place.extent, TRUE_METRES if place.metric else 0)
    if distance <= limit and degrees <= TRUE_DEGREES:
        found = "true"
    elif distance <= max(limit, NEAR * depth) and degrees <= NEAR_DEGREES:
        found = "near"
    else:
        found = "wrong"
    return {"position_error": distance, "rotation_error_deg": degrees, "outcome": found}


def _main() -> None:
    parser = cli.Parser(
        __doc__,
        "--map scenes/fox/images:scenes/fox/sparse "
        "--map scenes/cyprus/images:scenes/cyprus/sparse --feature colmap_sift_sv64",
    )
    add_places(parser)
    parser.add_argument(
        "--dataset", type=Path, action="append", default=[], help="in Aachen's or InLoc's layout"
    )
    parser.add_argument(
        "--feature",
        nargs="+",
        default=list(MAP_FEATURES.values()),
        help="features of one base, NAME or NAME:STORAGE",
    )
    parser.add_argument(
        "--matcher",
        help=f"one of {', '.join(matchers_confs.confs)} (default: the features')",
    )
    parser.add_argument("--trials", type=int, default=85, help="photos of other places, per map")
    parser.add_argument(
        "--seed", type=int, default=0, help="seed of the maps and of the drawn photos"
    )
    parser.add_argument("--output", type=Path, default=Path("outputs/false_accepts"))
    args = parser.parse_args()
    torch.set_num_threads(1)
    output = args.output / f"seed{args.seed}"
    same = [set(names) for names in args.same]
    rows = _trials_of_all(args, output)
    write_csv(rows, output / "trials.csv", COLUMNS)
    print(table(sorted(rows, key=lambda row: args.feature.index(row["feature"])), same))
    print()
    print(own_table(rows))
    print()
    print(levels(rows, same))
    plot(rows, same, output / "false_accepts.svg")


def _trials_of_all(args: argparse.Namespace, output: Path) -> list[dict]:
    """Try all maps with all features, and return the rows of trials.csv."""
    bases = {base_name(feature.partition(":")[0]) for feature in args.feature}
    if len(bases) > 1:
        raise InputError(f"The features have several bases: {', '.join(sorted(bases))}.")
    options = args.seed, *bases
    conf = features_confs.get(args.feature[0].partition(":")[0])[1]
    matcher = args.matcher or features_confs.matcher_of(conf)
    sources = [(root.name, of_dataset, (root,)) for root in args.dataset]
    sources += [(name, split, (name, *both)) for name, both in parse_maps(args.map).items()]
    places = {name: make(*given, output / name, *options) for name, make, given in sources}
    rows: list[dict] = []
    for name, place in places.items():
        others = [other for other in places.values() if other is not place]
        for feature in args.feature:
            file = output / name / f"trials_{feature.replace(':', '-')}_{matcher}.csv"
            if not file.exists():
                options = feature, args.trials, matcher, args.seed
                write_csv(run(place, others, output / name, *options), file, COLUMNS)
            with file.open(newline="") as opened:
                rows += csv.DictReader(opened)
        print(f"{name}: {len(rows):,} trials", flush=True)
    return rows


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    cli.run(_main)
