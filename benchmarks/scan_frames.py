"""Make a place in InLoc's layout from the registered RGB-D frames of 3DMatch.

A sequence, such as 7-scenes-redkitchen, has camera-intrinsics.txt (3, 3) and, in a folder frames,
frame-NNNNNN.color.jpg, .depth.png (16 bits, millimetres, 0 where unknown) and .pose.txt, world from
camera (4, 4) in metres. Every frame of --scans becomes a scan with one cutout, and every frame of
--queries a query. `pipelines.inloc --dataset` runs on it.
"""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from scipy.io import savemat

from hloc_reduce.datasets import scans
from hloc_reduce.datasets.inloc import InLoc
from hloc_reduce.utils import cli
from hloc_reduce.utils.cli import InputError

MILLIMETRES = 1000
FARTHEST = 10.0  # metres that depth cameras measure
PIXEL_CENTRE = 0.5  # COLMAP's coordinates of the first pixel, which has 0 in camera-intrinsics.txt


def points_of_depth(depth: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Return the 3D points (H, W, 3) of a depth image, metres in the frame of the camera.

    Args:
        depth: (H, W) in millimetres; points are NaN where it is 0 or too far.
        matrix: (3, 3) intrinsics, the centre of the first pixel at 0.
    """
    metres = depth.astype(np.float32) / MILLIMETRES
    metres[(metres == 0) | (metres > FARTHEST)] = np.nan
    rows, columns = np.indices(depth.shape)
    rays = np.stack([columns, rows, np.ones_like(rows)], axis=-1) @ np.linalg.inv(matrix).T
    return (rays * metres[..., None]).astype(np.float32)


def write_scan(frame: Path, number: int, matrix: np.ndarray, root: Path) -> None:
    """Write a frame as a scan of floor RDK1."""
    name = f"database/cutouts/RDK1/{number:06d}/RDK_cutout_{number:06d}_0_0.jpg"
    transformation = scans.transformation_file(root, name)
    for path in (root / name, transformation):
        path.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(f"{frame}.color.jpg", root / name)
    depth = cv2.imread(f"{frame}.depth.png", cv2.IMREAD_UNCHANGED)
    savemat(root / f"{name}.mat", {"XYZcut": points_of_depth(depth, matrix)}, do_compression=True)
    pose = Path(f"{frame}.pose.txt").read_text().strip()
    transformation.write_text(f"before general ICP\n{pose}\n\nafter general ICP\n{pose}\n")


def main(sequence: Path, output: Path, scanned: range, queried: range) -> None:
    """Write a place.

    Args:
        sequence: folder of camera-intrinsics.txt and frames.
        output: new folder of the place.
        scanned: numbers of the frames that become scans; those that do not exist are left out.
        queried: numbers of the frames that become queries; the same holds for these.

    Raises:
        InputError: if there is no such frame.
    """
    matrix = np.loadtxt(sequence / "camera-intrinsics.txt")
    frames = {
        int(path.name[len("frame-") : -len(".color.jpg")]): path.with_name(path.name.split(".")[0])
        for path in sequence.glob("frames/frame-*.color.jpg")
    }
    if not frames.keys() & set(scanned) or not frames.keys() & set(queried):
        raise InputError(f"{sequence} has no frames/frame-NNNNNN.color.jpg of these numbers.")
    for number in filter(frames.get, scanned):
        write_scan(frames[number], number, matrix, output)
    params = [*matrix.diagonal()[:2], *(matrix[:2, 2] + PIXEL_CENTRE)]
    (output / "query").mkdir(parents=True, exist_ok=True)
    lines, poses = [], []
    for number in filter(frames.get, queried):
        name = f"query/{number:06d}.jpg"
        shutil.copyfile(f"{frames[number]}.color.jpg", output / name)
        height, width = cv2.imread(str(output / name)).shape[:2]
        lines.append(f"{name} PINHOLE {width} {height} {' '.join(map(repr, map(float, params)))}\n")
        world_from_camera = np.loadtxt(f"{frames[number]}.pose.txt")[:3]
        pose = pycolmap.Rigid3d(world_from_camera).inverse()
        x, y, z, w = pose.rotation.quat.tolist()
        numbers = (w, x, y, z, *pose.translation.tolist())
        poses.append(f"{name} {' '.join(map(repr, numbers))}\n")
    place = InLoc(output)
    place.query_list.write_text("".join(lines))
    place.ground_truth.write_text("".join(poses))
    print(f"{output}: {len(place.map_names())} scans, {len(lines)} queries")


def _range(text: str) -> range:
    return range(*map(int, text.split(":")))


def _main() -> None:
    parser = cli.Parser(__doc__, "--sequence 7-scenes-redkitchen --output datasets/redkitchen")
    parser.add_argument("--sequence", type=Path, required=True, help="folder of the sequence")
    parser.add_argument(
        "--scans", type=_range, default="0:500:40", metavar="START:STOP:STEP", help="frames"
    )
    parser.add_argument(
        "--queries", type=_range, default="10:500:20", metavar="START:STOP:STEP", help="frames"
    )
    parser.add_argument("--output", type=Path, required=True, help="new folder of the place")
    args = parser.parse_args()
    main(args.sequence, args.output, args.scans, args.queries)


if __name__ == "__main__":
    cli.run(_main)
