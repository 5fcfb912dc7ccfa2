"""Localize by panoramas and fisheyes in the demo town, with exact poses.

Adds rows to results/panoramas.csv, leaving out what has rows unless --again is given. What the
lenses see is resampled from cubes, at the resolution of their centres. The variants:

    panoramas in photos         panoramas by day, in the town's map of pinhole photos
    fisheyes, given poses       fisheye photos, in a map of fisheye photos with poses
    fisheyes, alone             the same, in a map of the photos alone
    panoramas, alone            panoramas, in a map of panoramas alone, six views each
    photos in panoramas         the town's queries by day, with intrinsics, in that map

All queries are on the market, which the maps of a walk around it see.

Errors in maps of photos alone are measured after a similarity that fits the positions of their
photos; `largest_map_cm` is the largest error of these.
"""

import csv
import os
import shutil
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import torch

from benchmarks import rows
from hloc_reduce import demo
from hloc_reduce.confs import features as features_confs
from hloc_reduce.datasets.aachen import Aachen
from hloc_reduce.demo.cameras import DAY, MAP, WALK, Photo, list_photos, look
from hloc_reduce.demo.photo import expose
from hloc_reduce.demo.render import SUPERSAMPLING, Light, downsample, render
from hloc_reduce.demo.surface import View
from hloc_reduce.demo.town import build_town
from hloc_reduce.evaluation.poses import FAILED, pose_error
from hloc_reduce.maps.map import Map
from hloc_reduce.utils import cli, colmap
from hloc_reduce.utils.files import replacing
from hloc_reduce.utils.parsers import parse_poses, to_line
from hloc_reduce.utils.progress import progress
from pipelines import localize

NAME, SEED = "panoramas", 0
WIDTH = 2048  # pixels of a panorama
FISHEYE = pycolmap.Camera(
    model="OPENCV_FISHEYE",
    width=1024,
    height=768,
    params=[448, 448, 510, 386, -0.02, 0.004, 0, 0],
    camera_id=1,
)
ROUGH = "400,400,512,384,0,0,0,0"  # what a user knows of it
MARKET = 13.0  # metres around its centre, beyond which the walk sees nothing
STEPS = 24  # photos of a walk around the market
AHEAD, BEHIND, RIGHT, LEFT, DOWN, UP = (
    (0, 0, 0), (0, np.pi, 0), (0, -np.pi / 2, 0), (0, np.pi / 2, 0), (np.pi / 2, 0, 0),
    (-np.pi / 2, 0, 0),
)  # fmt: skip
FACES = AHEAD, BEHIND, RIGHT, LEFT, DOWN, UP  # rotation vectors, face from lens


def rays_of_panorama(width: int) -> np.ndarray:
    """Return the unit rays (W / 2, W, 3) of the pixels of a panorama."""
    longitude = ((np.arange(width) + 0.5) / width - 0.5) * 2 * np.pi
    latitude = ((np.arange(width // 2) + 0.5) / (width // 2) - 0.5) * np.pi
    longitude, latitude = np.meshgrid(longitude, latitude)
    x, z = np.sin(longitude) * np.cos(latitude), np.cos(longitude) * np.cos(latitude)
    return np.stack([x, np.sin(latitude), z], axis=-1)


def rays_of_camera(camera: pycolmap.Camera) -> np.ndarray:
    """Return rays (H, W, 3) of the pixels of a camera, less than 90 degrees from its axis."""
    grid = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), axis=-1)
    plane = colmap.cam_from_img(camera, grid.reshape(-1, 2) + 0.5)
    rays = np.pad(plane, ((0, 0), (0, 1)), constant_values=1)
    return rays.reshape(camera.height, camera.width, 3)


def look_around(
    rays: np.ndarray, side: int, cam_from_world: pycolmap.Rigid3d, light: Light
) -> np.ndarray:
    """Return the linear light of the town along rays (H, W, 3), float32 RGB (H, W, 3).

    It is resampled from the faces of a cube, whose width in pixels is given.
    """
    focal_length, size = side / 2, side + 4  # two pixels more on each side, to interpolate
    camera = pycolmap.Camera(
        model="SIMPLE_PINHOLE", width=size, height=size, params=[focal_length, size / 2, size / 2]
    )
    image = np.zeros(rays.shape, np.float32)
    nearest = np.full(rays.shape[:2], -np.inf)
    lengths = np.linalg.norm(rays, axis=-1)
    for turn in FACES:
        face_from_lens = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array(turn)), np.zeros(3))
        x, y, z = np.moveaxis(rays @ face_from_lens.rotation.matrix().T, -1, 0)
        seen = z / lengths > nearest
        if not seen.any():
            continue
        view = View.of(camera, face_from_lens * cam_from_world, SUPERSAMPLING)
        face = downsample(render(build_town(SEED), view, light))
        depth = np.where(z > 0, z, np.inf)
        maps = [focal_length * part / depth + size / 2 - 0.5 for part in (x, y)]
        found = cv2.remap(face, *(part.astype(np.float32) for part in maps), cv2.INTER_LINEAR)
        image[seen], nearest[seen] = found[seen], (z / lengths)[seen]
    return image


@dataclass(frozen=True)
class Lens:
    """A lens: its rays (H, W, 3), and the pixels across a quarter of a turn in its centre."""

    rays: np.ndarray
    side: int

    def take(self, photos: Iterable[Photo], folder: Path) -> None:
        """Write what it sees instead of a town's cameras, unless it is there."""
        for photo in progress([*photos], "Rendering", "photo"):
            path = folder / photo.name
            if not path.exists():
                see = partial(look_around, self.rays, self.side, photo.cam_from_world)
                with replacing(path) as temporary:
                    temporary.write_bytes(expose(see, photo, SEED))


def walk() -> list[Photo]:
    """Return photos of a walk around the market, upright, which look where they go."""
    found = []
    for i in range(STEPS):
        angle = 2 * np.pi * i / STEPS
        position = np.array([6.5 * np.cos(angle), 6 * np.sin(angle) - 0.5, 1.7])
        pose = look(position, angle + np.pi / 2 + 0.3 * np.sin(3 * angle), 0.05, 0)
        found.append(Photo(MAP, 500 + i, f"{i:04}.jpg", FISHEYE, pose))
    return found


def on_market() -> list[Photo]:
    """Return the town's queries by day on the market."""
    return [
        photo
        for photo in list_photos(SEED, len(WALK))
        if photo.kind == DAY
        and np.linalg.norm(photo.cam_from_world.inverse().translation[:2]) < MARKET
    ]


def queries() -> list[Photo]:
    """Return level photos at the places of `on_market`."""
    found = []
    for photo in on_market():
        position = photo.cam_from_world.inverse().translation
        ahead = photo.cam_from_world.rotation.matrix()[2]
        pose = look(position, np.arctan2(ahead[1], ahead[0]), 0, 0)
        found.append(Photo(DAY, photo.index, Path(photo.name).name, FISHEYE, pose))
    return found


def write_model(photos: list[Photo], folder: Path) -> Path:
    """Write a COLMAP model of the poses of fisheye photos."""
    model = pycolmap.Reconstruction()
    for i, photo in enumerate(photos, 1):
        image = pycolmap.Image(name=photo.name, camera_id=1, image_id=i)
        colmap.add_image(model, FISHEYE, image, photo.cam_from_world)
    return colmap.write_model(model, folder)


def write_list(photos: list[Photo], path: Path) -> Path:
    """Write the query list, with intrinsics, of photos."""
    lines = []
    for photo in photos:
        camera = photo.camera
        size = camera.model.name, camera.width, camera.height
        lines.append(to_line(Path(photo.name).name, *size, *camera.params.tolist()))
    path.write_text("".join(lines))
    return path


def world_of_map(built: Map, photos: list[Photo]) -> tuple[pycolmap.Sim3d, float]:
    """Return the similarity, world from map, of a map of photos alone; and its largest error."""
    true = {photo.name: photo.cam_from_world.inverse().translation for photo in photos}
    centres = {  # of panoramas, the names of the views end with theirs
        image.name: image.projection_center()
        for image in colmap.read_model(built.sfm).images.values()
    }
    expected = np.array([true[name.rpartition("/")[2]] for name in centres])
    found = np.array([*centres.values()])
    moved = pycolmap.estimate_sim3d(found, expected)
    errors = np.linalg.norm(np.array([moved * one for one in found]) - expected, axis=1)
    return moved, float(errors.max())


def measure(
    open_map: Callable[[], Map],
    map_photos: list[Photo] | None,
    query_images: Path,
    outputs: Path,
    true: dict[str, pycolmap.Rigid3d],
    **options: object,
) -> dict:
    """Return the measures of queries in a map.

    Args:
        open_map: builds or opens the map.
        map_photos: those of a map of photos alone, whose frame is arbitrary; None if poses were
            given.
        query_images: folder of the queries.
        outputs: folder for the results.
        true: poses of the queries.
        options: of `localize.main`.
    """
    built = open_map()
    summary = localize.main(built, query_images, outputs, **options)
    moved, error = world_of_map(built, map_photos) if map_photos else (None, 0.0)
    with (outputs / "queries.csv").open() as file:
        table = {row["query"]: row for row in csv.DictReader(file)}
    poses = parse_poses(outputs / summary["poses"])
    errors = []
    for name, row in table.items():
        if row["status"] != "localized":
            errors.append(FAILED)
            continue
        pose = poses[name]
        if moved is not None:
            pose = moved.transform_camera_world(pose)
        errors.append(pose_error(pose, true[name]))
    inliers = [int(row["num_inliers"]) for row in table.values()]
    measures = rows.localization(errors, inliers, sum(error != FAILED for error in errors))
    more = {"largest_map_cm": 100 * error} if map_photos else {}
    return measures | more | {"photos": built.num_images, "points": built.num_points3D}


def _main() -> None:
    parser = cli.Parser(__doc__, "--feature colmap_sift_sv64")
    add = parser.add_argument
    add("--feature", nargs="+", default=["colmap_sift_sv64"])
    add("--dataset", type=Path, default=Path("datasets/demo_town"), help="the demo town")
    add("--outputs", type=Path, default=Path("outputs/panoramas"))
    rows.add_again_option(parser)
    args = parser.parse_args()
    torch.set_num_threads(1)
    place, root = Aachen(demo.main(args.dataset, SEED)), args.outputs
    panorama = Lens(rays_of_panorama(WIDTH), round(WIDTH / np.pi))
    fisheye = Lens(rays_of_camera(FISHEYE), round(2 * FISHEYE.mean_focal_length()))
    for name, photos in (("map", walk()), ("queries", queries())):
        panorama.take(photos, root / f"panoramas-{name}")
        fisheye.take(photos, root / f"fisheyes-{name}")
    model = write_model(walk(), root / "fisheyes-model")
    true = {photo.name: photo.cam_from_world for photo in queries()}
    day = {Path(photo.name).name: photo.cam_from_world for photo in on_market()}
    for photo in on_market():
        copy = root / "photos-queries" / Path(photo.name).name
        copy.parent.mkdir(exist_ok=True)
        shutil.copy(place.images / photo.name, copy)
    listed = {
        name: write_list(photos, root / f"{name}.txt")
        for name, photos in (("fisheyes", queries()), ("photos", on_market()))
    }
    folders = {
        "photos": (place.images, place.reference_model),
        "fisheyes": (root / "fisheyes-map", model),
        "fisheyes alone": (root / "fisheyes-map", None),
        "panoramas alone": (root / "panoramas-map", None),
    }
    lens = {"camera_mode": "single", "camera_model": FISHEYE.model.name, "camera_params": ROUGH}
    options = {"fisheyes alone": lens, "panoramas alone": {"panoramas": True}}
    variants = {
        "panoramas in photos": ("photos", "panoramas-queries", true, {"panoramas": True}),
        "fisheyes, given poses": (
            "fisheyes",
            "fisheyes-queries",
            true,
            {"queries": listed["fisheyes"]},
        ),
        "fisheyes, alone": ("fisheyes alone", "fisheyes-queries", true, {}),
        "panoramas, alone": ("panoramas alone", "panoramas-queries", true, {"panoramas": True}),
        "photos in panoramas": (
            "panoramas alone",
            "photos-queries",
            day,
            {"queries": listed["photos"]},
        ),
    }
    known = [] if args.again else rows.read(NAME)
    for feature in args.feature:
        cells = {"place": "demo_town", "list": "day", "feature": feature, "storage": "float16"}
        cells["matcher"] = features_confs.matcher_of(features_confs.get(feature)[1])
        for variant, (given, images, poses, more) in variants.items():
            if rows.select(known, **cells, variant=variant):
                continue
            outputs = root / f"{given}-{feature}".replace(" ", "-")
            map_images, reference = folders[given]
            open_map = partial(
                localize.open_map, outputs, map_images, reference, feature, **options.get(given, {})
            )
            photos = walk() if reference is None else None
            results = outputs / f"queries-{variant}".replace(" ", "-").replace(",", "")
            measures = measure(open_map, photos, root / images, results, poses, **more)
            rows.add(NAME, [cells | {"variant": variant} | measures | rows.how(cores=1)])


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    cli.run(_main)
