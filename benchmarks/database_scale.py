"""Measure how long a map of a large COLMAP database takes, on a synthetic reconstruction.

Cameras stand in a row, one metre apart, in front of a wall. A quarter of the keypoints of each
image observe points of the model, each seen in five images; the others observe nothing. Descriptors
are random bytes of the norm that COLMAP gives them.
"""

import json
import os
import resource
import tempfile
import time
from pathlib import Path

import numpy as np
import pycolmap

from hloc_reduce.maps import from_database
from hloc_reduce.maps.map import FINISHED
from hloc_reduce.utils import cli
from hloc_reduce.utils.progress import progress

CAMERA = pycolmap.Camera(
    model="PINHOLE", width=1600, height=1200, params=[1600.0, 1600.0, 800.0, 600.0], camera_id=1
)
VIEWS = 5  # of each point
DEPTH = 10.0  # metres from the cameras to the wall


def synthesize(number: int, keypoints: int, database: Path, sparse: Path) -> None:
    """Write a database and the model that could have been made from it."""
    generator = np.random.default_rng(0)
    new = keypoints // 4 // VIEWS  # points of an image that the next one does not see
    points = np.arange(number * new)
    xyz = np.stack([points / new, generator.uniform(-3, 3, len(points))], axis=1)
    xyz = np.column_stack([xyz, DEPTH + generator.uniform(-1, 1, len(points))])
    tracks = [pycolmap.Track() for _ in points]
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(CAMERA)
    with pycolmap.Database.open(database) as opened:
        opened.write_camera(CAMERA, use_camera_id=True)
        for place in progress(range(number), "Writing", "image"):
            name = f"{place:05}.jpg"
            opened.write_image(pycolmap.Image(name=name, camera_id=1))
            seen = np.arange(max(0, place - VIEWS + 1) * new, (place + 1) * new)
            pose = pycolmap.Rigid3d(pycolmap.Rotation3d(), [VIEWS / 2 - 1 - place, 0, 0])
            pixels = generator.uniform((0, 0), (CAMERA.width, CAMERA.height), (keypoints, 2))
            pixels[: len(seen)] = CAMERA.img_from_cam(pose * xyz[seen])
            pixels = pixels.astype(np.float32)
            shapes = np.tile(np.float32([2, 0]), (keypoints, 1))
            opened.write_keypoints(place + 1, np.hstack([pixels, shapes]))
            drawn = generator.exponential(size=(keypoints, 128)).astype(np.float32)
            drawn *= 512 / np.linalg.norm(drawn, axis=1, keepdims=True)
            rounded = np.minimum(drawn.round(), 255).astype(np.uint8)
            opened.write_descriptors(
                place + 1, pycolmap.FeatureDescriptors(pycolmap.FeatureExtractorType.SIFT, rounded)
            )
            image = pycolmap.Image(name, pixels.astype(np.float64), camera_id=1, image_id=place + 1)
            model.add_image_with_trivial_frame(image, pose)
            for row, point in enumerate(seen.tolist()):
                tracks[point].add_element(place + 1, row)
    for point, track in zip(xyz, tracks, strict=True):
        model.add_point3D(point, track, np.zeros(3, np.uint8))
    sparse.mkdir()
    model.write(sparse)


def main() -> None:
    """Print the seconds of each stage and the peak of memory."""
    parser = cli.Parser(__doc__, "--images 1000 --keypoints 8000")
    parser.add_argument("--images", type=int, default=1000, help="images of the model")
    parser.add_argument("--keypoints", type=int, default=8000, help="of each image")
    args = parser.parse_args()
    cli.check_positive(args, "images", "keypoints")
    with tempfile.TemporaryDirectory() as folder:
        database, sparse = Path(folder) / "database.db", Path(folder) / "sparse"
        synthesize(args.images, args.keypoints, database, sparse)
        cpu, start = time.process_time(), time.perf_counter()
        built = from_database.main(Path(folder) / "map", database, sparse)
        seconds = time.perf_counter() - start
        children = resource.getrusage(resource.RUSAGE_CHILDREN)
        cpu = time.process_time() - cpu + children.ru_utime + children.ru_stime
        print(f"{args.images} images, {built.num_points3D} points: {seconds:.1f} s,")
        print(f"{cpu:.1f} s of CPU time on {os.cpu_count()} cores; seconds of the stages:")
        print(json.loads((built.folder / FINISHED).read_text())["seconds"])
        print(f"{resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MiB")


if __name__ == "__main__":
    cli.run(main)
