"""What tests share: the folder of real data, and a small scene with answers known in advance."""

import hashlib
import json
import os
import shutil
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import command
import cv2
import h5py
import numpy as np
import pycolmap
import pytest
import small_map
from hypothesis import settings
from scipy.io import savemat

from hloc_reduce import networks
from hloc_reduce.confs import features
from hloc_reduce.descriptors import DESCRIPTORS, weights
from hloc_reduce.networks import lightglue
from hloc_reduce.utils import cli, colmap, downloads
from pipelines import batch, localize

# an example may take long on a busy machine
settings.register_profile("no_deadline", deadline=None)
settings.load_profile("no_deadline")

SHARED = Path(__file__).parents[2] / "shared"

# All tests but test_gpu.py run on a CPU, where equal results are equal to the bit. Kept in the
# environment, which workers of pytest-xdist inherit.
GPUS = os.environ.setdefault("TESTED_GPUS", os.environ.get("CUDA_VISIBLE_DEVICES", "0"))
os.environ["CUDA_VISIBLE_DEVICES"] = ""


@pytest.fixture(scope="session", autouse=True)
def detected_once() -> Iterator[None]:
    """Has keypoints of a photo detected once: most runs in this process are of the same few."""
    found, detect = {}, colmap.detect_dog

    def once(image: np.ndarray, options: dict) -> tuple[np.ndarray, np.ndarray]:
        pixels = hashlib.sha256(image.tobytes()).digest(), image.shape
        key = *pixels, json.dumps(options, sort_keys=True)
        if key not in found:
            found[key] = detect(image, options)
        keypoints, descriptors = found[key]
        return keypoints.copy(), descriptors.copy()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(colmap, "detect_dog", once)
        yield


@pytest.fixture(scope="session")
def computed() -> dict[tuple, object]:
    """Descriptors by patches, and vocabularies by descriptors."""
    return {}


@pytest.fixture
def described_once(monkeypatch, computed) -> None:
    """Has patches described once, and a vocabulary learned once from the same descriptors."""
    from hloc_reduce.descriptors.model import Descriptor
    from hloc_reduce.retrieval.vlad import VLAD

    describe, fit = Descriptor.forward, VLAD.fit

    def digest(array: np.ndarray) -> tuple:
        return array.shape, hashlib.sha256(np.ascontiguousarray(array)).digest()

    def describe_once(descriptor, patches):
        key = descriptor.name, *digest(patches.numpy())
        if key not in computed:
            computed[key] = describe(descriptor, patches)
        return computed[key].clone()

    def fit_once(vlad, descriptors):
        key = json.dumps(vlad.conf, sort_keys=True), *digest(descriptors)
        if key not in computed:
            fit(vlad, descriptors)
            computed[key] = vlad.vocabulary
        vlad.vocabulary = computed[key].copy()

    monkeypatch.setattr(Descriptor, "forward", describe_once)
    monkeypatch.setattr(VLAD, "fit", fit_once)


@pytest.fixture(scope="session")
def written_once(tmp_path_factory) -> Callable[..., None]:
    """Has a folder written by a function the first time, and copied from there for other tests."""
    copies = {}

    def write_or_copy(folder: Path, write: Callable[[], object], *key: object) -> None:
        if key in copies:
            shutil.copytree(copies[key], folder, dirs_exist_ok=True)
            return
        write()
        copies[key] = shutil.copytree(folder, tmp_path_factory.mktemp("copy") / folder.name)

    return write_or_copy


@pytest.fixture(scope="session")
def herz_jesus() -> Path:
    path = SHARED / "aachen_like/herz-jesus"
    if not path.is_dir():
        pytest.skip(f"the real place {path} is not on this machine")
    return path


@pytest.fixture
def base_weights(monkeypatch, tmp_path_factory) -> Callable[[str], None]:
    """Skips a test for want of the weights of a base, in the shared folders if they are there.

    Those of LightGlue are named as its matchers, such as xfeat+lightglue.
    """
    if (SHARED / "torch_home").is_dir():
        home = tmp_path_factory.mktemp("torch_home")
        checkpoints = home / "hub/checkpoints"
        checkpoints.mkdir(parents=True)
        for path in (SHARED / "torch_home/hub/checkpoints").glob("*"):
            (checkpoints / path.name).symlink_to(path)
        for path in (SHARED / "edgepoint2").glob("*.pth"):
            (checkpoints / f"edgepoint2_{path.name}").symlink_to(path)
        monkeypatch.setenv("TORCH_HOME", str(home))

    def need(name: str) -> None:
        if name.endswith("+lightglue"):
            file = lightglue.LIGHTGLUE[name.removesuffix("+lightglue")].file
            if not (downloads.cache() / file).is_file():
                pytest.skip(f"the weights {file} are not on this machine")
            return
        model = features.confs[name]["model"]
        network = networks.NETWORKS.get(features.network_of(model) or "")
        if network and not network.urls:  # they ship
            return
        base = features.descriptor_of(model)
        path = weights(base) if base in DESCRIPTORS else None
        if network:
            path = downloads.cache() / network.file
        if path and not path.is_file():
            pytest.skip(f"the weights {path} are not on this machine")

    return need


@pytest.fixture
def textured() -> np.ndarray:
    """A grey image (240, 320) uint8 of smooth blobs of all sizes: many DoG keypoints."""
    generator = np.random.default_rng(0)
    image = np.zeros((240, 320))
    for sigma in (1.5, 3, 6, 12):
        noise = cv2.GaussianBlur(generator.standard_normal(image.shape), (0, 0), sigma)
        image += noise / noise.std()
    return (128 + 30 * image).clip(0, 255).astype(np.uint8)


@pytest.fixture
def scene(tmp_path) -> SimpleNamespace:
    """Eight cameras around random points, each point with a descriptor of its own.

    Images 0-5 are the map, 6 and 7 queries. Files are in hloc's formats, exact but for the
    descriptors' float16.
    """
    generator = np.random.default_rng(1)
    points = generator.uniform(-1, 1, (300, 3))
    descriptors = generator.standard_normal((300, 64))
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    camera = pycolmap.Camera(
        model="SIMPLE_RADIAL", width=640, height=480, params=[500, 320, 240, 0.02], camera_id=1
    )
    reference = pycolmap.Reconstruction()
    poses, seen = {}, {}
    features = tmp_path / "features.h5"
    photo = cv2.imencode(".jpg", np.full((480, 640), 99, np.uint8))[1].tobytes()
    with h5py.File(features, "w") as file:
        for i in range(8):
            name = f"db/{i}.jpg" if i < 6 else f"query/{i}.jpg"
            angle = 0.25 * (i if i < 6 else i - 4.5)
            rotation = cv2.Rodrigues(np.array([0.1 * np.cos(3 * angle), angle, 0.05]))[0]
            poses[name] = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), np.array([0, 0, 4.0]))
            pixels = camera.img_from_cam(points @ rotation.T + [0, 0, 4.0])
            order = generator.permutation(len(points))
            group = file.create_group(name)
            # COLMAP's pixels have their origin at the corner, hloc's at the first centre
            group["keypoints"] = (pixels[order] - 0.5).astype(np.float32)
            group["descriptors"] = descriptors[order].T.astype(np.float16)
            seen[name] = order
            if i < 6:
                image = pycolmap.Image(name=name, camera_id=1, image_id=i + 1)
                colmap.add_image(reference, camera, image, poses[name])
            (tmp_path / "images" / name).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / "images" / name).write_bytes(photo)
    model = tmp_path / "reference"
    model.mkdir()
    reference.write(model)
    queries = tmp_path / "day_time_queries_with_intrinsics.txt"
    queries.write_text(
        "".join(f"query/{i}.jpg SIMPLE_RADIAL 640 480 500 320 240 0.02\n" for i in (6, 7))
    )
    return SimpleNamespace(
        root=tmp_path,
        images=tmp_path / "images",
        model=model,
        reference=reference,
        features=features,
        queries=queries,
        poses=poses,
        seen=seen,
        points=points,
    )


@pytest.fixture
def built(scene, written_once) -> SimpleNamespace:
    """The scene with its map and the matches of its queries."""
    written_once(scene.root, lambda: small_map.build(scene), "small_map")
    return small_map.opened(scene)


SIZE = (360, 270)
FOCAL = 375.0
# the lists of the plane, as if it were a data set of the paper
PLANE = {"Plane": {"day": (2, "query/day/"), "night": (1, "query/night/")}}


@pytest.fixture
def symmetric() -> float:
    """The height of the part of the plane whose right half mirrors the left one, of its height."""
    return 0.0


@pytest.fixture
def plane(tmp_path, symmetric, written_once, described_once) -> Path:
    """Photos of the plane z = 0 and a COLMAP model of their poses with covisibility."""
    written_once(tmp_path, lambda: write_plane(tmp_path, symmetric), "plane", symmetric)
    return tmp_path


def write_plane(root: Path, symmetric: float) -> None:
    generator = np.random.default_rng(0)
    texture = np.zeros((600, 600))
    for sigma in (2, 4, 8):
        noise = cv2.GaussianBlur(generator.standard_normal(texture.shape), (0, 0), sigma)
        texture += noise / noise.std()
    texture = (128 + 30 * texture).clip(0, 255).astype(np.uint8)
    top = round(symmetric * 600)
    texture[:top, 300:] = texture[:top, 299::-1]

    reference = pycolmap.Reconstruction()
    camera = pycolmap.Camera(
        model="SIMPLE_PINHOLE",
        width=SIZE[0],
        height=SIZE[1],
        params=[FOCAL, SIZE[0] / 2, SIZE[1] / 2],
        camera_id=1,
    )
    points = np.column_stack([generator.uniform(-0.5, 0.5, (30, 2)), np.zeros(30)])
    (root / "images").mkdir()
    poses = []
    for i in range(5):
        rotation = cv2.Rodrigues(np.array([0.1 * i - 0.2, 0.15 * i - 0.3, 0.2 * i]))[0]
        translation = np.array([0.05 * i, -0.05, 2.2 + 0.1 * i])
        poses.append(pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), translation))
        # texture index (u, v) -> plane (u - 299.5, v - 299.5) / 300 -> image index
        to_plane = np.array([[1 / 300, 0, -299.5 / 300], [0, 1 / 300, -299.5 / 300], [0, 0, 1]])
        matrix = np.column_stack([rotation[:, :2], translation])
        calibration = camera.calibration_matrix() - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
        homography = calibration @ matrix @ to_plane
        photo = cv2.warpPerspective(texture, homography, SIZE, flags=cv2.INTER_AREA)
        cv2.imwrite(str(root / f"images/{i}.png"), photo)
        pixels = camera.img_from_cam(points @ rotation.T + translation)
        image = pycolmap.Image(
            name=f"{i}.png", keypoints=pixels.reshape(-1, 2), camera_id=1, image_id=i + 1
        )
        colmap.add_image(reference, camera, image, poses[i])
    for j, point in enumerate(points):
        track = pycolmap.Track([pycolmap.TrackElement(i, j) for i in range(1, 6)])
        reference.add_point3D(point, track)
    (root / "model").mkdir()
    reference.write(root / "model")


@pytest.fixture
def aachen_layout(plane, symmetric, written_once) -> Path:
    """The photos of the plane in the layout of Aachen: four of the map, and three queries.

    The queries are one by day, the same by night (darker), and one of a uniform grey.
    """
    root = plane / "dataset"
    written_once(root, lambda: write_aachen_layout(plane, root), "aachen_layout", symmetric)
    return root


def write_aachen_layout(plane: Path, root: Path) -> None:
    images, model = root / "images_upright", root / "3D-models/aachen_v_1_1"
    for folder in ("db", "query/day", "query/night"):
        (images / folder).mkdir(parents=True)
    reference = pycolmap.Reconstruction(plane / "model")
    truth = []
    for image in reference.images.values():
        photo = cv2.imread(str(plane / "images" / image.name))
        if image.name == "4.png":
            cv2.imwrite(str(images / "query/day/a.png"), photo)
            cv2.imwrite(str(images / "query/night/a.png"), photo // 4)
            cv2.imwrite(str(images / "query/day/grey.png"), np.full_like(photo, 128))
            pose = image.cam_from_world()
            values = [*pose.rotation.quat[[3, 0, 1, 2]], *pose.translation]
            numbers = " ".join(map(repr, map(float, values)))
            truth = [f"query/{name}.png {numbers}\n" for name in ("day/a", "night/a", "day/grey")]
        else:
            image.name = f"db/{image.name}"
            cv2.imwrite(str(images / image.name), photo)
    query = reference.find_image_with_name("4.png")
    reference.deregister_frame(query.frame_id)
    model.mkdir(parents=True)
    reference.write(model)
    for name in ("rigs.bin", "frames.bin"):
        (model / name).unlink()
    (root / "queries").mkdir()
    intrinsics = f"SIMPLE_PINHOLE {SIZE[0]} {SIZE[1]} {FOCAL} {SIZE[0] / 2} {SIZE[1] / 2}\n"
    for time, names in (("day", ["day/a", "day/grey"]), ("night", ["night/a"])):
        path = root / f"queries/{time}_time_queries_with_intrinsics.txt"
        path.write_text("".join(f"query/{name}.png {intrinsics}" for name in names))
    (root / "queries/ground_truth_poses.txt").write_text("".join(truth))


@pytest.fixture
def inloc_layout(plane, symmetric, written_once) -> Path:
    """The photos of the plane in the layout of InLoc: scans on two floors, and three queries.

    Cutouts 0 to 2 are on floor PLA1, 3 on PLA2, in whose frame the plane is 100 m away. Each scan
    has a frame of its own, and no depth in its left 40 columns. The queries are photo 4 as a.JPG
    and as b.JPG, and one of a uniform grey.
    """
    root = plane / "inloc"
    written_once(root, lambda: write_inloc_layout(plane, root), "inloc_layout", symmetric)
    return root


def write_inloc_layout(plane: Path, root: Path) -> None:
    (root / "query/iphone7").mkdir(parents=True)
    reference = pycolmap.Reconstruction(plane / "model")
    names = []
    for image in sorted(reference.images.values(), key=lambda image: image.name):
        photo = cv2.imread(str(plane / "images" / image.name))
        number, pose = image.name[0], image.cam_from_world()
        if number == "4":
            for name, pixels in (("a.JPG", photo), ("grey.JPG", np.full_like(photo, 128))):
                path = root / f"query/iphone7/{name}"
                assert cv2.imwrite(str(path), pixels, [cv2.IMWRITE_JPEG_QUALITY, 100])
                names.append(f"query/iphone7/{name}")
            shutil.copy(root / names[0], root / "query/iphone7/b.JPG")
            names.append("query/iphone7/b.JPG")
            values = " ".join(map(repr, map(float, pose.rotation.quat[[3, 0, 1, 2]])))
            values += " " + " ".join(map(repr, map(float, pose.translation)))
            continue
        floor, shift = ("PLA2", 100.0) if number == "3" else ("PLA1", 0.0)
        folder = root / f"database/cutouts/{floor}/00{number}"
        folder.mkdir(parents=True)
        cutout = folder / f"PLA_cutout_00{number}_0_0.jpg"
        cv2.imwrite(str(cutout), photo, [cv2.IMWRITE_JPEG_QUALITY, 100])
        scan_from_world = scan_frame(int(number))
        v, u = np.mgrid[: SIZE[1], : SIZE[0]]
        rays = np.stack([u + 0.5 - SIZE[0] / 2, v + 0.5 - SIZE[1] / 2, np.full(u.shape, FOCAL)], -1)
        rays = rays @ pose.rotation.matrix()  # in the world's frame
        centre = pose.inverse().translation
        world = centre - rays * (centre[2] / rays[..., 2:])
        scan = world @ scan_from_world[:3, :3].T + scan_from_world[:3, 3]
        scan[:, :40] = np.nan
        savemat(f"{cutout}.mat", {"XYZcut": scan})
        world_from_scan = np.linalg.inv(scan_from_world)
        world_from_scan[0, 3] += shift
        transformations = root / f"database/alignments/{floor}/transformations"
        transformations.mkdir(parents=True, exist_ok=True)
        rows = [" ".join(map(repr, row)) for row in world_from_scan.tolist()]
        text = "\n".join(["before", *["9 9 9 9"] * 4, "", "after", *rows, ""])
        (transformations / f"PLA_trans_00{number}.txt").write_text(text)
    intrinsics = f"SIMPLE_PINHOLE {SIZE[0]} {SIZE[1]} {FOCAL} {SIZE[0] / 2} {SIZE[1] / 2}"
    queries = root / "queries_with_intrinsics.txt"
    queries.write_text("".join(f"{name} {intrinsics}\n" for name in sorted(names)))
    truth = root / "ground_truth_poses.txt"
    truth.write_text("".join(f"{name} {values}\n" for name in names))


def scan_frame(number: int) -> np.ndarray:
    """Return the frame of a scan of `inloc_layout`, scan from world (4, 4)."""
    matrix = np.eye(4)
    matrix[:3, :3] = cv2.Rodrigues(np.array([0.3 * number, -0.2, 0.5]))[0]
    matrix[:3, 3] = [number, 2, -1]
    return matrix


@pytest.fixture(autouse=True)
def propagated(monkeypatch) -> None:
    """Has caplog hear what is logged. pytest decides before the test begins how it listens."""
    monkeypatch.setattr(cli.logger, "propagate", True)


@pytest.fixture
def run(request, monkeypatch) -> Callable[..., None]:
    """Runs the command line of the pipeline that is the PIPELINE of a test's file."""
    return partial(command.run, monkeypatch, request.module.PIPELINE)


@pytest.fixture
def refused(request, monkeypatch, caplog) -> Callable[..., str]:
    """The same with wrong input; returns the message."""
    return partial(command.refused, monkeypatch, caplog, request.module.PIPELINE)


@pytest.fixture
def place(aachen_layout, tmp_path) -> tuple[tuple, Path, Path]:
    """The options that build a map of the plane, its photos, and the folder of its outputs."""
    model, images = aachen_layout / "3D-models/aachen_v_1_1", aachen_layout / "images_upright"
    outputs = tmp_path / "outputs"
    return ("--map", model, "--map_images", images, "--outputs", outputs), images, outputs


@pytest.fixture
def build_map(place, symmetric, written_once, monkeypatch) -> Callable[..., Path]:
    """Builds the map of `place` with more options, once for all tests, and returns its folder."""
    build, _, outputs = place

    def build_once(*options: str) -> Path:
        def write() -> None:
            command.run(monkeypatch, localize, *build, *options)

        written_once(outputs, write, "map", symmetric, options)
        return outputs / "map"

    return build_once


@pytest.fixture
def run_batch(tmp_path, monkeypatch, capsys) -> Callable[..., Path]:
    """Runs the batch of a grid in this process and returns its outputs and what it printed."""

    def run(*grids, options=()):
        job_file = command.write(tmp_path / "jobs.yaml", json.dumps({"jobs": list(grids)}))
        arguments = (job_file, "--outputs", tmp_path / "out", "--executor", "serial", *options)
        try:
            command.run(monkeypatch, batch, *arguments)
        finally:
            run.printed = capsys.readouterr().out
        return tmp_path / "out"

    return run
