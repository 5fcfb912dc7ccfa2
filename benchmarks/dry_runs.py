"""Write data sets with the names and numbers of the photos of real ones: for dry runs.

The commands for Aachen Day-Night v1.0, Cambridge Landmarks and 7Scenes run on them as on the real
data, in minutes. Photos have 96x72 pixels and show a wall, along which the camera moves: its upper
half is half as far away as its lower one. Queries are between map images. All frames of a sequence
have names that other sequences have, too; text files have the line ends of Windows.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap

from hloc_reduce.datasets import aachen_v1, cambridge_nvm
from hloc_reduce.datasets.cambridge import Cambridge
from hloc_reduce.datasets.sevenscenes import SevenScenes
from hloc_reduce.utils import cli, colmap
from hloc_reduce.utils.cli import InputError, choose
from hloc_reduce.utils.parsers import to_line
from hloc_reduce.utils.progress import progress

# photos of each folder of queries of Aachen
AACHEN = {"day/milestone": 354, "day/nexus4": 445, "day/nexus5x": 25, "night/nexus5x": 98}
AACHEN_MAP = 4328
# sequences and number of the map images, and of the queries
CAMBRIDGE = {
    "GreatCourt": ((2, 3, 5), 1532, (1, 4), 760),
    "KingsCollege": ((1, 4, 5, 6, 8), 1220, (2, 3, 7), 343),
    "OldHospital": ((1, 2, 3, 5, 6, 7, 9), 895, (4, 8), 182),
    "ShopFacade": ((2,), 231, (1, 3), 103),
    "StMarysChurch": ((1, 2, 4, 6, 7, 8, 9, 10, 11, 12, 14), 1487, (3, 5, 13), 530),
}
HEADER = "Visual Landmark Dataset V1", "ImageFile, Camera Position [X Y Z W P Q R]", ""
SEVENSCENES = {
    "chess": ((1, 2, 4, 6), 4000, (3, 5), 2000),
    "fire": ((1, 2), 2000, (3, 4), 2000),
    "heads": ((2,), 1000, (1,), 1000),
    "office": ((1, 3, 4, 5, 8, 10), 6000, (2, 6, 7, 9), 4000),
    "pumpkin": ((2, 3, 6, 8), 4000, (1, 7), 2000),
    "redkitchen": ((1, 2, 5, 7, 8, 11, 13), 7000, (3, 4, 6, 12, 14), 5000),
    "stairs": ((2, 3, 5, 6), 2000, (1, 4), 1000),
}
DENSE_VLAD, RETRIEVED = "7scenes_densevlad_retrieval_top_10", 10
WIDTH, HEIGHT, FOCAL = 96, 72, 72.0
STEP, METRES = 6, 0.05  # columns of the lower half from one map image to the next; of a column
SPACING = 12  # columns from one point of the model to the next
CAMERA = pycolmap.Camera(
    model="SIMPLE_RADIAL", width=WIDTH, height=HEIGHT, params=[FOCAL, WIDTH / 2, HEIGHT / 2, 0]
)
SPEEDS = 2, 1  # columns of the upper and the lower half that pass by together
UNTURNED = pycolmap.Rotation3d()


@dataclass(frozen=True)
class Photo:
    """A photo of the wall.

    Args:
        name: its name.
        column: of the lower half, at the left side of the photo.
        is_query: whether it is one of a query.
    """

    name: str
    column: int
    is_query: bool

    @property
    def pose(self) -> pycolmap.Rigid3d:
        """Camera from world."""
        return pycolmap.Rigid3d(UNTURNED, np.array([-METRES * self.column, 0, 0]))


class Wall:
    """A wall with random blobs, and points of a model on it.

    Args:
        photos: of it.
    """

    def __init__(self, photos: list[Photo]):
        end = max(photo.column for photo in photos)
        self._halves = [texture(speed * end + WIDTH, speed) for speed in SPEEDS]
        generator = np.random.default_rng(0)
        self.points = []
        self._shown: list[tuple[int, np.ndarray]] = []  # speed, and columns and rows of points
        for half, speed in enumerate(SPEEDS):
            columns = np.arange(0, speed * end + WIDTH, SPACING) + 0.5
            rows = generator.uniform(half * HEIGHT / 2, (half + 1) * HEIGHT / 2, len(columns))
            pixels = np.stack([columns, rows], axis=1)
            offset = (pixels - [WIDTH / 2, HEIGHT / 2]) * METRES / speed
            depth = np.full(len(columns), METRES * FOCAL / speed)
            self.points.append(np.column_stack([offset, depth]))
            self._shown.append((speed, pixels))

    def pixels(self, photo: Photo) -> np.ndarray:
        """Return the pixels (HEIGHT, WIDTH) of a photo."""
        halves = zip(self._halves, SPEEDS, strict=True)
        return np.vstack([half[:, speed * photo.column :][:, :WIDTH] for half, speed in halves])

    def shown(self, photo: Photo) -> tuple[np.ndarray, np.ndarray]:
        """Return the points (N,) that a photo shows, and where (N, 2)."""
        ids, xy, first = [], [], 0
        for speed, pixels in self._shown:
            moved = pixels - [speed * photo.column, 0]
            inside = np.flatnonzero((moved[:, 0] > 0) & (moved[:, 0] < WIDTH))
            ids.append(first + inside)
            xy.append(moved[inside])
            first += len(pixels)
        return np.concatenate(ids), np.concatenate(xy)

    def model(self, photos: Iterable[Photo], scale: float = 1) -> pycolmap.Reconstruction:
        """Return a model of photos, for photos that are larger or smaller by a scale."""
        model = pycolmap.Reconstruction()
        camera = pycolmap.Camera(CAMERA.todict() | {"camera_id": 1})
        camera.rescale(scale)
        tracks: dict[int, pycolmap.Track] = {}
        for image_id, photo in enumerate(photos, 1):
            ids, xy = self.shown(photo)
            image = pycolmap.Image(photo.name, scale * xy, camera_id=1, image_id=image_id)
            colmap.add_image(model, camera, image, photo.pose)
            for row, point in enumerate(ids.tolist()):
                tracks.setdefault(point, pycolmap.Track()).add_element(image_id, row)
        positions = np.concatenate(self.points)
        for point, track in tracks.items():
            if track.length() > 1:
                model.add_point3D(positions[point], track)
        return model


def texture(width: int, seed: int) -> np.ndarray:
    """Return half a wall (HEIGHT / 2, width) uint8 of blobs of several sizes."""
    generator = np.random.default_rng(seed)
    found = np.zeros((HEIGHT // 2, width), np.float32)
    for sigma in (1.2, 2.4, 4.8):
        drawn = generator.standard_normal(found.shape, np.float32)
        blobs = cv2.GaussianBlur(drawn, (0, 0), sigma)
        found += blobs / blobs.std()
    return (128 + 35 * found).clip(0, 255).astype(np.uint8)


def along(map_names: list[str], queries: list[str], share: float) -> list[Photo]:
    """Place a share of the photos along a wall: map images one after the other, queries between."""
    map_names, queries = spread(map_names, share), spread(queries, share)
    places = np.linspace(0, STEP * (len(map_names) - 1), 2 * len(queries) + 1)[1::2]
    photos = [Photo(name, STEP * i, False) for i, name in enumerate(map_names)]
    return photos + [Photo(name, int(at), True) for name, at in zip(queries, places, strict=True)]


def spread(names: list[str], share: float) -> list[str]:
    """Return a share of names, but at least three, from all parts of the list."""
    rows = np.linspace(0, len(names) - 1, max(3, round(share * len(names))))
    return [names[int(row)] for row in rows]


def in_sequences(form: str, sequences: Sequence[int], number: int, first: int) -> list[str]:
    """Return as many names of frames, of which each sequence has about the same number."""
    counts = [len(part) for part in np.array_split(np.arange(number), len(sequences))]
    return [
        form.format(sequence, first + frame)
        for sequence, count in zip(sequences, counts, strict=True)
        for frame in range(count)
    ]


def write_lines(path: Path, lines: Iterable[str]) -> None:
    """Write a text file with the line ends of Windows."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes("".join(f"{line.rstrip()}\r\n" for line in lines).encode())


def write_photos(wall: Wall, photos: list[Photo], root: Path) -> None:
    """Write photos, those of the night darker."""
    for folder in {(root / photo.name).parent for photo in photos}:
        folder.mkdir(parents=True, exist_ok=True)
    for photo in progress(photos, "Writing photos", "photo", len(photos)):
        pixels = wall.pixels(photo) // (2 if "/night/" in photo.name else 1)
        cv2.imwrite(str(root / photo.name), pixels)


def write_nvm(model: pycolmap.Reconstruction, path: Path, width: int | None = None) -> None:
    """Write a COLMAP model as an NVM file, with focal lengths of photos of a width."""
    ids = sorted(model.reg_image_ids())
    lines = ["NVM_V3", "", str(len(ids))]
    for image in map(model.image, ids):
        camera, pose = image.camera, image.cam_from_world()
        x, y, z, w = pose.rotation.quat
        focal_length = camera.focal_length * (width or camera.width) / camera.width
        numbers = focal_length, w, x, y, z, *image.projection_center()
        distortion = -camera.params[3] if camera.model.name == "SIMPLE_RADIAL" else 0
        lines.append(to_line(image.name, *numbers, distortion, 0))
    lines += ["", str(model.num_points3D())]
    rows = {image_id: row for row, image_id in enumerate(ids)}
    for point in model.points3D.values():
        words = [*point.xyz, *point.color, point.track.length()]
        for element in point.track.elements:
            xy = model.image(element.image_id).points2D[element.point2D_idx].xy
            words += [rows[element.image_id], element.point2D_idx, *xy]
        lines.append(to_line(*words))
    write_lines(path, [*lines, "", "0"])


def pose_words(photo: Photo) -> list[float]:
    """Return qw, qx, qy, qz of a pose, camera from world."""
    x, y, z, w = photo.pose.rotation.quat
    return [w, x, y, z]


def with_intrinsics(photos: Iterable[Photo]) -> list[str]:
    """Return the lines of a list of names and cameras."""
    words = CAMERA.model.name, CAMERA.width, CAMERA.height, *CAMERA.params
    return [to_line(photo.name, *words) for photo in photos]


def write_aachen(root: Path, share: float) -> None:
    """Write Aachen Day-Night v1.0, and true poses, which it does not have."""
    folders = [folder for folder, number in AACHEN.items() for _ in range(number)]
    queries = [f"query/{folder}/IMG_20161227_{160000 + i}.jpg" for i, folder in enumerate(folders)]
    photos = along([f"db/{i + 1}.jpg" for i in range(AACHEN_MAP)], queries, share)
    wall, of_map = Wall(photos), [photo for photo in photos if not photo.is_query]
    write_photos(wall, photos, root / "images_upright")
    write_nvm(wall.model(of_map), root / aachen_v1.NVM)
    write_lines(root / aachen_v1.INTRINSICS, with_intrinsics(of_map))
    for time in ("day", "night"):
        listed = [photo for photo in photos if photo.name.startswith(f"query/{time}/")]
        path = root / f"queries/{time}_time_queries_with_intrinsics.txt"
        write_lines(path, with_intrinsics(listed))
    poses = [
        to_line(photo.name, *pose_words(photo), *photo.pose.translation)
        for photo in photos
        if photo.is_query
    ]
    write_lines(root / "ground_truth_poses.txt", poses)


def write_cambridge(root: Path, share: float) -> None:
    """Write a scene of Cambridge Landmarks, and the models that hloc's pipeline downloads."""
    sequences, number, of_queries, num_queries = CAMBRIDGE[root.name]
    form = "seq{}/frame{:05}.png"
    map_names = in_sequences(form, sequences, number, 1)
    photos = along(map_names, in_sequences(form, of_queries, num_queries, 1), share)
    wall, of_map = Wall(photos), [photo for photo in photos if not photo.is_query]
    write_photos(wall, photos, root)
    for name, is_query in ((cambridge_nvm.MAP_LIST, False), (cambridge_nvm.QUERY_LIST, True)):
        lines = [
            to_line(photo.name, *photo.pose.inverse().translation, *pose_words(photo))
            for photo in photos
            if photo.is_query == is_query
        ]
        write_lines(root / name, [*HEADER, *lines])
    jpeg = [replace(photo, name=photo.name.replace(".png", ".jpg")) for photo in photos]
    write_nvm(wall.model(jpeg), root / cambridge_nvm.NVM, cambridge_nvm.SIZE[0])
    folder = Cambridge.folder(root)
    write_lines(folder / Cambridge.query_list, [photo.name for photo in photos if photo.is_query])
    for name in (Cambridge.all_images, "model_train"):
        (folder / name).mkdir(exist_ok=True)
    everything = wall.model(photos, 0.5)
    for point in list(everything.point3D_ids()):
        everything.delete_point3D(point)
    everything.write_text(folder / Cambridge.all_images)
    for path in (folder / Cambridge.all_images).iterdir():
        write_lines(path, path.read_text().splitlines())
    wall.model(of_map, 0.5).write_binary(folder / "model_train")


def write_sevenscenes(root: Path, share: float) -> None:
    """Write a scene of 7Scenes, and the model and pairs that hloc's pipeline downloads."""
    sequences, number, of_queries, num_queries = SEVENSCENES[root.name]
    form = "seq-{:02}/frame-{:06}.color.png"
    map_names = in_sequences(form, sequences, number, 0)
    photos = along(map_names, in_sequences(form, of_queries, num_queries, 0), share)
    wall, queries = Wall(photos), [photo for photo in photos if photo.is_query]
    write_photos(wall, photos, root)
    for photo in photos:
        frame = root / photo.name.removesuffix("color.png")
        frame.with_name(f"{frame.name}depth.png").write_bytes(BLACK)
        matrix = np.vstack([photo.pose.inverse().matrix(), [0, 0, 0, 1]])
        write_lines(frame.with_name(f"{frame.name}pose.txt"), (to_line(*row) for row in matrix))
    for split, listed in (("Train", sequences), ("Test", of_queries)):
        write_lines(root / f"{split}Split.txt", (f"sequence{one}" for one in listed))
    folder = SevenScenes.folder(root)
    write_lines(folder / SevenScenes.query_list, [photo.name for photo in queries])
    wall.model(photos).write_binary(folder / SevenScenes.all_images)
    of_map = [photo for photo in photos if not photo.is_query]
    pairs = [
        to_line(photo.name, other.name) for photo in queries for other in nearest(photo, of_map)
    ]
    write_lines(root.parent / DENSE_VLAD / f"{root.name}_top{RETRIEVED}.txt", pairs)


def nearest(photo: Photo, of_map: list[Photo]) -> list[Photo]:
    """Return the map images that are nearest to a query. They are one after the other."""
    row = min(max(0, photo.column // STEP - RETRIEVED // 2), max(0, len(of_map) - RETRIEVED))
    some = of_map[row : row + RETRIEVED]
    return sorted(some, key=lambda other: abs(other.column - photo.column))


BLACK = cv2.imencode(".png", np.zeros((HEIGHT, WIDTH), np.uint16))[1].tobytes()
PLACES: dict[str, Callable[[Path, float], None]] = {
    "aachen": write_aachen,
    **{f"cambridge/{scene}": write_cambridge for scene in CAMBRIDGE},
    **{f"7scenes/{scene}": write_sevenscenes for scene in SEVENSCENES},
}


def main(output: Path, place: str, share: float = 1) -> Path:
    """Write a place into its folder in `output`, and return that.

    Args:
        output: the folder of data sets.
        place: a key of `PLACES`.
        share: of the photos.

    Raises:
        InputError: for an unknown place, one that is there, or a share of nothing or too much.
    """
    if not 0 < share <= 1:
        raise InputError(f"--share {share}: above 0, at most 1.")
    write = PLACES[choose("place", place, PLACES)]
    if (root := output / place).exists():
        raise InputError(f"{root} exists: delete it, or choose another folder.")
    write(root, share)
    return root


def _main() -> None:
    parser = cli.Parser(__doc__, "--output datasets/dry --place aachen 7scenes/stairs")
    parser.add_argument("--output", type=Path, required=True, help="folder of data sets")
    parser.add_argument("--place", nargs="+", choices=PLACES, default=[*PLACES], help="which ones")
    parser.add_argument("--share", type=float, default=1, help="of the photos")
    args = parser.parse_args()
    for place in args.place:
        main(args.output, place, args.share)


if __name__ == "__main__":
    cli.run(_main)
