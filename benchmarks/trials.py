"""Try maps with photos whose poses are known, and write what is measured of each pose found.

Each map is tried with held-out photos of its place, with photos of all other places, and with
darkened, blurred, mirrored, black and noisy versions of its own; all with their intrinsics and
without, its own also with a wrong focal length. Its own are also tried cropped, cropped and
enlarged, squeezed, and warped as a photo of a print is, without intrinsics; those of other places,
with --turned, as networks see them turned. In a COLMAP model, every third photo is held out.
Keypoints and maps are the same for all features of one base. Another --seed holds out other photos,
builds other maps, and draws other photos of other places. Each trial is a row of
results/trials/FEATURE-SEED.csv, with a --matcher or --keypoints named after FEATURE, with its
outcome (true, near, wrong, none) and all `Measures`, whatever the gate says; `benchmarks.fit_gate`
and the tables of the documentation read these files. An interrupted run resumes with the next
place.
"""

import argparse
import copy
import csv
import os
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import h5py
import numpy as np
import pycolmap
import torch
from scipy.linalg import rq

from benchmarks.rows import add_again_option, how
from benchmarks.split_place import darken
from benchmarks.trial_rows import COLUMNS, RESHAPED, TRIALS, to_row
from hloc_reduce import extract_features, localize_inloc, maps, matchers, projections
from hloc_reduce.confs import features as features_confs
from hloc_reduce.confs import matchers as matchers_confs
from hloc_reduce.datasets import scans, true_poses
from hloc_reduce.datasets.aachen import Aachen
from hloc_reduce.datasets.inloc import InLoc
from hloc_reduce.detectors.dog import KEYPOINT_SETTINGS
from hloc_reduce.evaluation.poses import pose_error
from hloc_reduce.localization import intrinsics, mirrored, query, views
from hloc_reduce.localization.gate import DEFAULT_GATE, Gate
from hloc_reduce.localization.query import merged
from hloc_reduce.localization.references import Reference, ScanMap, SfmMap
from hloc_reduce.localize_sfm import RANSAC_THRESH
from hloc_reduce.training.tracks import parse_maps
from hloc_reduce.utils import cli, colmap
from hloc_reduce.utils.codes import FLOATS, restore, store
from hloc_reduce.utils.feature_files import (
    get_blur,
    get_colmap_keypoints,
    get_descriptors,
    get_features,
    get_image_size,
)
from hloc_reduce.utils.files import replacing, write_csv
from hloc_reduce.utils.h5 import open_file, open_h5
from hloc_reduce.utils.images import list_images, read_image
from hloc_reduce.utils.progress import progress

MAP_FEATURES = {"colmap_sift": "colmap_sift_sv64"}  # of a base; default: the base itself
EVERY = 3
LEAST = 5.0  # confidence of poses whose mirror images are tried
ALTERED = ("blurred", "mirrored", "black", "noise")
BLUR = 6.0  # standard deviation in pixels
CROPPED, SQUEEZED = 0.7, 0.75  # share of width and height, share of the height
WARPED = 0.06  # share of the size by which corners move
OFF = 1.15  # factor of a wrong focal length
# which intrinsics photos are tried with; photos of a calibrated camera are not mirrored
KNOWN = {"own": ("given", "off", "guess"), "mirrored": ("guess",)}
# a pose is true within metres, or a share of the extent of the cameras, and degrees
TRUE_METRES, TRUE_EXTENT, TRUE_DEGREES = 0.25, 0.01, 2.0
# a pose that is not true is near within this share of the scene's depth and these degrees
NEAR, NEAR_DEGREES = 0.1, 5.0


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
        base: the base feature, see `base_of`.
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
    base_name, keypoints = parted(base)
    feature = MAP_FEATURES.get(base_name, base_name)
    built = maps.main(output / "map", images, model, feature, keypoints=keypoints)
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
    conf = base_conf(base)
    return extract_features.main(conf, images, output, image_list=sorted(set(names)))


def altered(kind: str, photo: np.ndarray, seed: int) -> np.ndarray:
    """Return an altered version of a photo (H, W, 3)."""
    height, width = photo.shape[:2]
    if kind == "blurred":
        return cv2.GaussianBlur(photo, (0, 0), BLUR)
    if kind == "mirrored":
        return photo[:, ::-1]
    if kind == "black":
        return np.zeros_like(photo)
    if kind == "noise":
        return np.random.default_rng(seed).integers(0, 256, photo.shape, np.uint8)
    if kind == "dark":
        return darken(photo, np.random.default_rng(seed))
    if kind == "squeezed":
        return cv2.resize(photo, None, fx=1, fy=SQUEEZED, interpolation=cv2.INTER_AREA)
    if kind == "warped":
        return cv2.warpPerspective(photo, warping(width, height), (width, height))
    assert kind in ("cropped", "zoomed")
    part = photo[int((1 - CROPPED) * height) :, : int(CROPPED * width)]
    return part if kind == "cropped" else cv2.resize(part, (width, height))


def warping(width: int, height: int) -> np.ndarray:
    """Return the homography (3, 3) of a print that is photographed aslant."""
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32)
    moved = [[width, height / 2], [0, 0], [-width / 3, 0], [width / 5, -height]]
    return cv2.getPerspectiveTransform(corners, corners + WARPED * np.array(moved, np.float32))


def warped_pose(camera: pycolmap.Camera, truth: pycolmap.Rigid3d) -> pycolmap.Rigid3d:
    """Return the pose, camera from world, of the camera that takes a warped photo.

    It is at the same position, but turned, and its pixels are not rectangular: with H for the
    homography, HK = K'R.
    """
    homography = warping(camera.width, camera.height) @ camera.calibration_matrix()
    calibration, turn = rq(homography * np.sign(np.linalg.det(homography)))
    turn = np.sign(np.diag(calibration))[:, None] * turn
    return pycolmap.Rigid3d(pycolmap.Rotation3d(turn), np.zeros(3)) * truth


def alter(
    place: Place, output: Path, seed: int
) -> list[tuple[str, pycolmap.Camera | None, pycolmap.Rigid3d | None]]:
    """Write altered photos of a place's queries, and extract their features.

    Returns:
        Names; intrinsics, None for photos of another shape; and true poses, None if unknown.
    """
    written = []
    for i, (name, camera, truth) in enumerate(place.queries):
        photo = read_image(place.images / name)
        for kind in (ALTERED[i % 2] if i > 1 else ALTERED[2 + i], "dark", *RESHAPED):
            path = output / "altered" / kind / Path(name).with_suffix(".png")
            if not path.exists():
                encoded = cv2.imencode(".png", altered(kind, photo, seed + i)[..., ::-1])[1]
                with replacing(path) as temporary:
                    temporary.write_bytes(encoded.tobytes())
            named = path.relative_to(output / "altered").as_posix()
            known = truth if kind in ("blurred", "dark", *RESHAPED) else None
            known = warped_pose(camera, truth) if kind == "warped" else known
            written.append((named, None if kind in RESHAPED else camera, known))
    names = [name for name, _, _ in written]
    conf, features = base_conf(place.base), output / "altered.h5"
    extract_features.main(conf, output / "altered", image_list=names, feature_path=features)
    return written


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


def base_of(feature: str, keypoints: str) -> str:
    """Return the feature whose descriptors a feature projects, or its own: NAME or NAME+KEYPOINTS.

    Args:
        feature: its name.
        keypoints: settings of DoG; the default ones are not named.
    """
    model = features_confs.base_of(features_confs.get(feature)[1]["model"])
    name = next(name for name, conf in features_confs.confs.items() if conf["model"] == model)
    return name if keypoints == KEYPOINT_SETTINGS[0] else f"{name}+{keypoints}"


def parted(base: str) -> tuple[str, str]:
    """Return the name and the settings of DoG of a base feature."""
    name, _, keypoints = base.partition("+")
    return name, keypoints or KEYPOINT_SETTINGS[0]


def base_conf(base: str) -> dict:
    """Return the configuration of a base feature."""
    name, keypoints = parted(base)
    return features_confs.get(name, keypoints=keypoints)[1]


def trials(
    place: Place, others: list[Place], output: Path, number: int, turned: bool, seed: int
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
        for view in views.TURNED if turned else ():
            conf = views.shown(base_conf(place.base), **view.how)
            path = output / f"{view.name}-{other.images.parent.name}-{other.images.name}.h5"
            seen = extract_features.main(conf, other.images, image_list=[name], feature_path=path)
            yield other, name, camera, None, seen, "turned"


def run(
    place: Place,
    others: list[Place],
    output: Path,
    feature: str,
    number: int,
    turned: bool,
    matcher: str,
    seed: int,
) -> list[dict]:
    """Try a map with all photos, and return the rows of trials.csv."""
    model = matchers_confs.confs[matcher]["model"]
    made_from = extract_features.provenance(features_confs.get(feature.partition(":")[0])[1])
    matching = matchers.load(matchers_confs.for_features(model, made_from))
    other_keys = [key for key in matching.feature_keys() if key != "descriptors"]
    tried = list(trials(place, others, output, number, turned, seed))
    describe = Described(feature)
    shown, rows = {}, []

    def features_of(file: h5py.File, name: str, is_query: bool = False) -> dict:
        features = get_features(file, name, other_keys)
        found = {key: torch.from_numpy(value) for key, value in features.items()}
        return {**found, "descriptors": describe(file, name, is_query).T}

    with open_h5(place.features) as file:
        described = {name: features_of(file, name) for name in place.names}
    for name, features in described.items():
        ids, _ = place.reference.lift(name, np.arange(features["descriptors"].shape[1]))
        shown[name] = torch.from_numpy(np.flatnonzero(ids >= 0))
    dim = len(described[place.names[0]]["descriptors"])
    gate = DEFAULT_GATE.of_matches(model, dim)
    labels = {"feature": feature, "matcher": gate.match_kind, "dim": dim}
    labels["commit"] = how()["commit"]

    def match(path: Path, name: str) -> tuple[np.ndarray, dict, float]:
        with open_h5(path) as file:
            query = features_of(file, name, is_query=True)
            keypoints = get_colmap_keypoints(file, name)[0]
            blur = get_blur(file, name)
        matches = {
            other: matching.match_rows(query, described[other], shown[other]).numpy()
            for other in place.names
        }
        return keypoints, matches, blur

    for source, name, camera, truth, path, kind in progress(tried, place.name, "photo"):
        images = output / "altered" if path == output / "altered.h5" else source.images
        with open_h5(path) as file:
            size = get_image_size(file, name)
        (*matched, blur), flipped = match(path, name), None
        for given in KNOWN.get(kind, ("given", "guess")) if camera else ("guess",):
            its_camera, refinement = intrinsics_of(camera, size, given, place.cameras)
            pose, info = localize(place, *matched, its_camera, refinement, gate)
            measures = info["measures"]
            sure = measures.num_inliers >= gate.min_inliers and measures.confidence >= LEAST
            if sure and not measures.is_camera_given:
                flipped = flipped or match(*mirror(images, output, name, place.base))[:2]
                refinement = mirrored.mirror_options(refinement)
                other_camera = mirrored.mirror(its_camera)
                _, other = localize(place, *flipped, other_camera, refinement, gate, False)
                measures = replace(measures, mirror_image=other["confidence"])
            row = labels | {"blur": blur, "map": place.name, "place": source.name, "photo": name}
            row |= {"kind": kind, "intrinsics": given, **outcome(place, info, pose, truth)}
            rows.append(row | to_row(measures))
    return rows


def mirror(images: Path, output: Path, name: str, base: str) -> tuple[Path, str]:
    """Extract the features of the mirror image of a photo; return their file and its name."""
    conf = copy.deepcopy(base_conf(base))
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
    keypoints: np.ndarray,
    matches: dict,
    camera: pycolmap.Camera,
    refinement: dict,
    gate: Gate,
    thorough: bool = True,
) -> tuple[pycolmap.Rigid3d | None, dict]:
    """Localize a query, given its keypoints and matches; its intrinsics may be refined."""
    config = merged(query.ransac_options(RANSAC_THRESH, camera), refinement)
    return query.localize(place.reference, keypoints, camera, matches, config, gate, thorough)


def outcome(
    place: Place,
    info: dict,
    cam_from_world: pycolmap.Rigid3d | None,
    truth: pycolmap.Rigid3d | None,
) -> dict:
    """Return the errors of a pose, and whether it is true, near, wrong or none."""
    if cam_from_world is None:
        return {"outcome": "none"}
    if truth is None:
        return {"outcome": "wrong"}
    distance, degrees = pose_error(cam_from_world, truth)
    points = info["points3D"][info["inliers"]]
    depths = points @ cam_from_world.rotation.matrix().T[:, 2] + cam_from_world.translation[2]
    depth = float(np.median(depths)) if len(depths) else np.nan
    limit = max(TRUE_EXTENT * place.extent, TRUE_METRES if place.metric else 0)
    if distance <= limit and degrees <= TRUE_DEGREES:
        found = "true"
    elif distance <= max(limit, NEAR * depth) and degrees <= NEAR_DEGREES:
        found = "near"
    else:
        found = "wrong"
    errors = {"position_error": f"{distance / depth:.4g}", "rotation_error_deg": f"{degrees:.4g}"}
    return {"outcome": found, **errors}


def _main() -> None:
    parser = cli.Parser(
        __doc__,
        "--map scenes/fox/images:scenes/fox/sparse "
        "--map scenes/cyprus/images:scenes/cyprus/sparse --feature colmap_sift_sv64",
    )
    parser.add_argument(
        "--map", action="append", default=[], metavar="IMAGES:MODEL", help="may be repeated"
    )
    parser.add_argument(
        "--same",
        nargs="+",
        action="append",
        default=[],
        metavar="PLACE",
        help="places that see each other, whose photos are not tried as wrong ones",
    )
    parser.add_argument(
        "--dataset", type=Path, action="append", default=[], help="in Aachen's or InLoc's layout"
    )
    parser.add_argument(
        "--strangers",
        type=Path,
        action="append",
        default=[],
        help="folder of photos of other places, which are tried as wrong ones",
    )
    parser.add_argument("--feature", default="colmap_sift_sv64", help="NAME or NAME:STORAGE")
    parser.add_argument("--keypoints", choices=KEYPOINT_SETTINGS, default=KEYPOINT_SETTINGS[0])
    parser.add_argument(
        "--matcher",
        help=f"one of {', '.join(matchers_confs.confs)} (default: the feature's)",
    )
    parser.add_argument("--trials", type=int, default=40, help="photos of other places, per map")
    parser.add_argument(
        "--turned", action="store_true", help="also show photos of other places turned, three ways"
    )
    parser.add_argument(
        "--seed", type=int, default=0, help="seed of the maps and of the drawn photos"
    )
    parser.add_argument("--output", type=Path, default=Path("outputs/trials"))
    add_again_option(parser)
    args = parser.parse_args()
    torch.set_num_threads(1)
    others = [args.matcher] if args.matcher else []
    others += [args.keypoints] if args.keypoints != KEYPOINT_SETTINGS[0] else []
    name = "+".join([args.feature.replace(":", "-"), *others])
    file = TRIALS / f"{name}-{args.seed}.csv"
    tried = {root.name for root in args.dataset} | set(parse_maps(args.map))
    if file.exists() and not args.again and tried <= {row["map"] for row in _read(file)}:
        print(f"All maps have rows in {file}.")
        return
    rows = _trials_of_all(args)
    write_csv(rows, file, COLUMNS)
    outcomes = Counter(row["outcome"] for row in rows)
    print(f"{len(rows):,} trials: {dict(outcomes)}. They are in {file}.")


def _trials_of_all(args: argparse.Namespace) -> list[dict]:
    """Try all maps, and return the rows."""
    name, output = args.feature.partition(":")[0], args.output / f"seed{args.seed}"
    base, conf = base_of(name, args.keypoints), features_confs.get(name)[1]
    matcher = args.matcher or features_confs.matcher_of(conf)
    sources = [(root.name, of_dataset, (root,)) for root in args.dataset]
    sources += [(name, split, (name, *both)) for name, both in parse_maps(args.map).items()]
    places = {
        name: make(*given, output / base / name, args.seed, base) for name, make, given in sources
    }
    strangers = [_strangers(folder, output / base, base) for folder in args.strangers]
    rows: list[dict] = []
    for name, place in places.items():
        same = {name, *(other for group in args.same if name in group for other in group)}
        others = [other for key, other in places.items() if key not in same] + strangers
        folder = output / base / name
        file = folder / f"trials_{args.feature.replace(':', '-')}_{matcher}.csv"
        if not file.exists():
            options = args.feature, args.trials, args.turned, matcher, args.seed
            write_csv(run(place, others, folder, *options), file, COLUMNS)
        rows += _read(file)
        print(f"{name}: {len(rows):,} trials", flush=True)
    return rows


def _read(file: Path) -> list[dict]:
    with file.open(newline="") as opened:
        return list(csv.DictReader(opened))


def _strangers(folder: Path, output: Path, base: str) -> Place:
    """Return the photos of a folder as queries that no map shows; without intrinsics."""
    names = list_images(folder)
    features = _extract(folder, output / "strangers" / folder.name, names, base)
    queries = [(name, None, None) for name in names]
    nothing = intrinsics.MapCameras({}, set())
    return Place(folder.name, folder, queries, None, [], features, False, base, 0.0, nothing)


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    cli.run(_main)
