"""How exact the metres of a map of photos alone are that GPS in their EXIF data tells.

Copies of the photos of a place with true poses in metres get GPS positions with normal noise in
each coordinate, and a map is built of them alone. It is then aligned again with the noise of other
seeds, which `localization.gps` reads from EXIF data, too. A factor multiplies true positions: the
same photos are then of a larger place. Adds rows to results/metres.csv: in how many runs the GPS
was accepted, in how many of these the cameras told which way is up, and the median and the largest
error: of the scale of a run, and of the distances between all cameras, in percent; and of the axes
of the map, in degrees.
"""

import logging
import shutil
import time
from fractions import Fraction
from pathlib import Path

import numpy as np
import pycolmap
from PIL import Image
from scipy.spatial.distance import pdist
from scipy.spatial.transform import Rotation

from benchmarks import rows
from hloc_reduce import logger, maps
from hloc_reduce.confs import features as features_confs
from hloc_reduce.localization.gps import (
    ALTITUDE,
    BELOW,
    GPS,
    LATITUDE,
    LONGITUDE,
    SOUTH_OR_NORTH,
    WEST_OR_EAST,
)
from hloc_reduce.maps import georeference
from hloc_reduce.training.tracks import parse_maps
from hloc_reduce.utils import cli, colmap

NAME = "metres"
ORIGIN = np.array([48.5734, 7.7521, 190.0])  # latitude, longitude, altitude of the true origin
# the frame of the laser scans that give the poses has z down
SCANNER = np.diag([1.0, -1.0, -1.0])
DIGITS = 10**7  # of the seconds of an angle: a ten-millionth is 3 micrometres


def degrees(value: float) -> tuple[Fraction, ...]:
    """Return degrees, minutes and seconds, as EXIF data have them."""
    minutes, seconds = divmod(abs(value) * 3600, 60)
    whole, minutes = divmod(minutes, 60)
    return Fraction(int(whole)), Fraction(int(minutes)), Fraction(round(seconds * DIGITS), DIGITS)


def geotag(photo: Path, output: Path, position: np.ndarray) -> None:
    """Copy a photo with a GPS position (3,), latitude, longitude and altitude, in its EXIF data."""
    with Image.open(photo) as opened:
        exif = opened.getexif()
        latitude, longitude, altitude = map(float, position)
        exif.get_ifd(GPS).update(
            {
                SOUTH_OR_NORTH: "S" if latitude < 0 else "N",
                LATITUDE: degrees(latitude),
                WEST_OR_EAST: "W" if longitude < 0 else "E",
                LONGITUDE: degrees(longitude),
                BELOW: b"\x01" if altitude < 0 else b"\x00",
                ALTITUDE: Fraction(round(abs(altitude) * 10**4), 10**4),
            }
        )
        output.parent.mkdir(parents=True, exist_ok=True)
        opened.save(output, quality="keep", exif=exif)


def true_poses(model: Path) -> dict[str, pycolmap.Rigid3d]:
    """Return the poses of a model, camera from a frame with x east, y north and z up."""
    reference = colmap.read_model(model)
    level = pycolmap.Sim3d(1.0, pycolmap.Rotation3d(SCANNER), np.zeros(3))
    return {
        image.name: level.transform_camera_world(image.cam_from_world())
        for image in reference.images.values()
    }


def positions(
    poses: dict[str, pycolmap.Rigid3d], factor: float, noise: float, seed: int
) -> dict[str, np.ndarray]:
    """Return noisy GPS positions (3,) of cameras; the factor multiplies their true distances."""
    centres = factor * np.array([pose.inverse().translation for pose in poses.values()])
    centres += np.random.default_rng(seed).normal(0, noise, centres.shape)
    return dict(zip(poses, colmap.ellipsoid_from_enu(centres, ORIGIN), strict=True))


def errors(
    model: pycolmap.Reconstruction, poses: dict[str, pycolmap.Rigid3d], factor: float
) -> tuple[np.ndarray, float, float]:
    """Return errors: of distances (N,) and the scale, in percent, and of the axes, in degrees."""
    names = sorted(model.images[i].name for i in model.reg_image_ids())
    found = {image.name: image.cam_from_world() for image in model.images.values()}
    distances, true = (  # between all pairs of cameras
        pdist([some[name].inverse().translation for name in names]) for some in (found, poses)
    )
    turns = [(found[name].inverse() * poses[name]).rotation.matrix() for name in names]
    angle = Rotation.from_matrix(turns).mean().magnitude()
    scale = distances @ true / (factor * true @ true)
    of_distances = np.abs(distances / (factor * true) - 1)
    return 100 * of_distances, float(100 * abs(scale - 1)), float(np.rad2deg(angle))


def measure(
    built: maps.Map,
    photos: Path,
    poses: dict[str, pycolmap.Rigid3d],
    factor: float,
    noise: float,
    seeds: int,
) -> dict[str, object]:
    """Return the measures of a map that is aligned with the noise of several seeds."""
    found, level = [], 0
    for seed in range(seeds):
        for name, position in positions(poses, factor, noise, seed).items():
            geotag(built.images / name, photos / name, position)
        model = colmap.read_model(built.sfm)
        logging.disable(logging.WARNING)
        told = georeference.by_exif(model, photos)
        logging.disable(logging.NOTSET)
        if told:
            found.append(errors(model, poses, factor))
            level += "gravity" in told["frame"]["told_by"]
    cells: dict[str, object] = {"runs": seeds, "accepted": len(found), "level_by_cameras": level}
    if found:
        of_distances, of_scale, of_axes = map(np.array, zip(*found, strict=True))
        for name, values in (
            ("scale_percent", of_scale),
            ("distance_percent", of_distances),
            ("axes_deg", of_axes),
        ):
            cells |= {name: float(np.median(values)), f"largest_{name}": float(np.max(values))}
    return cells


def _main() -> None:
    parser = cli.Parser(__doc__, "--map scenes/fountain-P11/images:scenes/fountain-P11/sparse")
    add = parser.add_argument
    add("--map", action="append", required=True, metavar="IMAGES:MODEL", help="may be repeated")
    add("--outputs", type=Path, default=Path("outputs/metres"), help="folder of the maps")
    add("--feature", default=features_confs.RECOMMENDED, help="name or YAML file")
    add("--noise", type=float, nargs="+", default=[0, 0.1, 0.5, 2], help="metres")
    add("--factor", type=float, nargs="+", default=[1, 10], help="of the true distances")
    add("--seeds", type=int, default=20, help="alignments of each map and noise")
    rows.add_again_option(parser)
    args = parser.parse_args()
    known = [] if args.again else rows.read(NAME)
    for place, (images, model) in parse_maps(args.map).items():
        poses = true_poses(model)
        folder = args.outputs / place
        shutil.rmtree(folder / "noisy", ignore_errors=True)
        if not (folder / "photos").exists():
            for name, position in positions(poses, 1, 0, 0).items():
                geotag(images / name, folder / "photos" / name, position)
        built = maps.main(folder / "map", folder / "photos", feature=args.feature)
        for factor in args.factor:
            for noise in args.noise:
                variant = f"{noise:g} m, {factor:g} times as large"
                cells = {"place": place, "feature": args.feature, "variant": variant}
                if rows.select(known, **cells):
                    continue
                start = time.perf_counter()
                seeds = args.seeds if noise else 1
                found = measure(built, folder / "noisy", poses, factor, noise, seeds)
                logger.info("%s, %s: %s", place, variant, found)
                cells |= {"photos": built.num_images, "points": built.num_points3D, **found}
                rows.add(NAME, [cells | rows.how(time.perf_counter() - start)])


if __name__ == "__main__":
    cli.run(_main)
