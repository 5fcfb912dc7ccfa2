"""The layouts of hloc's data sets: each opens, says what is missing, and can be localized in."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from command import table

from benchmarks import dry_runs
from hloc_reduce.datasets import nvm
from hloc_reduce.datasets.aachen import Aachen
from hloc_reduce.datasets.aachen_v1 import NVM, AachenV1
from hloc_reduce.datasets.cambridge import Cambridge
from hloc_reduce.datasets.cambridge_nvm import CambridgeNvm
from hloc_reduce.datasets.cmu import CMU
from hloc_reduce.datasets.inloc import InLoc
from hloc_reduce.datasets.layouts import LAYOUTS, layout_of, open_model_place
from hloc_reduce.datasets.sevenscenes import SevenScenes
from hloc_reduce.utils import colmap
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.parsers import parse_query_list, to_line, write_poses
from pipelines import aachen, compare

QUERY = "4.png"  # of the plane


def write_nvm(model: pycolmap.Reconstruction, path: Path, width: int | None = None) -> Path:
    """Write an NVM file and the list of its intrinsics, which is returned."""
    dry_runs.write_nvm(model, path, width)
    lines = []
    for image in map(model.image, sorted(model.reg_image_ids())):
        camera = image.camera
        size = camera.model.name, camera.width, camera.height
        lines.append(to_line(image.name, *size, *camera.params))
    listed = path.with_name("database_intrinsics.txt")
    dry_runs.write_lines(listed, lines)
    return listed


def read_nvm(path: Path, intrinsics: Path) -> pycolmap.Reconstruction:
    cameras = dict(parse_query_list(intrinsics))
    return nvm.read(path, lambda view: (view.name, cameras[view.name]))


def synthetic() -> pycolmap.Reconstruction:
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 3, 2, 20
    options.num_points2D_without_point3D = 0
    pycolmap.set_random_seed(0)
    return pycolmap.synthesize_dataset(options)


def test_an_nvm_file_has_the_poses_and_tracks_of_its_model(tmp_path):
    model = synthetic()
    found = read_nvm(tmp_path / "m.nvm", write_nvm(model, tmp_path / "m.nvm"))
    assert found.num_reg_images() == 6 and found.num_points3D() == 20
    images = {image.name: image for image in found.images.values()}
    for image in model.images.values():
        other = images[image.name]
        np.testing.assert_allclose(
            other.cam_from_world().matrix(), image.cam_from_world().matrix(), atol=1e-6
        )
        np.testing.assert_allclose(other.camera.params, image.camera.params)
        assert other.num_points3D == image.num_points3D
    positions = {tuple(np.round(point.xyz, 4)): point for point in model.points3D.values()}
    for point in found.points3D.values():
        same = positions[tuple(np.round(point.xyz, 4))]
        assert (point.color == same.color).all()
        names = [
            sorted(one.image(element.image_id).name for element in seen.track.elements)
            for one, seen in ((found, point), (model, same))
        ]
        assert names[0] == names[1]


def test_a_broken_nvm_file_is_refused(tmp_path):
    path = tmp_path / "m.nvm"
    listed = write_nvm(synthetic(), path)
    lines = path.read_text().splitlines()
    for broken, message in (
        (lines[:5], "ends early: 4 lines"),
        ([*lines[:3], lines[3].rsplit(maxsplit=4)[0], *lines[4:]], "m.nvm:4: not an image"),
        ([*lines[:3], lines[3].replace(" ", " x", 1), *lines[4:]], "m.nvm:4: not an image"),
        ([*lines[:12], lines[12].rsplit(maxsplit=1)[0], *lines[13:]], "m.nvm:13: not a point"),
        (["NVM_V3", "x"], "m.nvm:2: not a number of lines"),
        ([], "not a number of lines"),
    ):
        path.write_text("\n".join(broken))
        with pytest.raises(InputError, match=message):
            read_nvm(path, listed)


@pytest.fixture
def nvm_layout(aachen_layout) -> Path:
    """The plane in the layout of Aachen Day-Night v1.0."""
    folder = aachen_layout / "3D-models/aachen_v_1_1"
    write_nvm(colmap.read_model(folder), aachen_layout / NVM)
    shutil.rmtree(folder)
    return aachen_layout


def test_images_without_intrinsics_are_named(nvm_layout, tmp_path):
    path = AachenV1(nvm_layout).intrinsics
    path.write_text("".join(path.read_text().splitlines(keepends=True)[1:]))
    with pytest.raises(InputError, match="database_intrinsics.txt lacks db/.*, which is in aachen"):
        AachenV1(nvm_layout).reference(tmp_path / "reference")


def write_scene(plane: Path, root: Path, sequence: str) -> pycolmap.Reconstruction:
    """Write the photos of the plane as a scene, and return the model of all of them."""
    (root / sequence).mkdir(parents=True)
    model = pycolmap.Reconstruction(plane / "model")
    for image in model.images.values():
        shutil.copy(plane / "images" / image.name, root / sequence / image.name)
        image.name = f"{sequence}/{image.name}"
    return model


@pytest.fixture
def cambridge_layout(plane) -> Path:
    """The plane as a scene of Cambridge Landmarks, whose models are of photos of half the size."""
    root = plane / "cambridge/Plane"
    models = root.parent / Cambridge.models / root.name
    model = write_scene(plane, root, "seq1")
    for camera in model.cameras.values():
        camera.rescale(0.5)
    for image in model.images.values():
        for point in image.points2D:
            point.xy = point.xy / 2
    for folder in ("empty_all", "model_train"):
        (models / folder).mkdir(parents=True)
    empty = pycolmap.Reconstruction(model)
    for point in list(empty.points3D):
        empty.delete_point3D(point)
    empty.write_text(models / "empty_all")
    query = model.find_image_with_name(f"seq1/{QUERY}")
    model.deregister_frame(query.frame_id)
    model.write_binary(models / "model_train")
    (models / "list_query.txt").write_text(f"seq1/{QUERY}\n")
    return root


@pytest.fixture
def cambridge_nvm_layout(plane) -> Path:
    """The plane as a scene that is downloaded without models, with names of JPEG photos."""
    root = plane / "downloaded/Plane"
    model = write_scene(plane, root, "seq1")
    lists = {"train": [*dry_runs.HEADER], "test": [*dry_runs.HEADER]}
    for image in model.images.values():
        x, y, z, w = image.cam_from_world().rotation.quat
        numbers = *image.projection_center(), w, x, y, z
        listed = lists["test" if image.name == f"seq1/{QUERY}" else "train"]
        listed.append(to_line(image.name, *numbers))
        image.name = image.name.replace(".png", ".jpg")
    for name, lines in lists.items():
        dry_runs.write_lines(root / f"dataset_{name}.txt", lines)
    write_nvm(model, root / "reconstruction.nvm", 1920).unlink()  # the photos are smaller
    return root


@pytest.fixture
def sevenscenes_layout(plane) -> Path:
    """The plane as a scene of 7Scenes."""
    root = plane / "7scenes/plane"
    folder = root.parent / SevenScenes.models / root.name / "triangulated"
    folder.mkdir(parents=True)
    write_scene(plane, root, "seq-01").write_binary(folder)
    (folder / "list_test.txt").write_text(f"seq-01/{QUERY}\n")
    return root


@pytest.fixture
def cmu_layout(plane) -> Path:
    """The plane as a slice of Extended CMU Seasons, whose names tell the camera: c0 or c1."""
    root = plane / "cmu/slice2"
    for folder in ("database", "query", "sparse"):
        (root / folder).mkdir(parents=True)
    model = pycolmap.Reconstruction(plane / "model")
    camera = model.cameras[1]
    line = to_line("c0", camera.model.name, camera.width, camera.height, *camera.params)
    other = to_line("c1", "SIMPLE_PINHOLE", 36, 27, 9, 18, 13.5)
    (root.parent / "intrinsics.txt").write_text(f"# cameras\n\n{other}{line}")
    for image in list(model.images.values()):
        name, folder = f"img_0000{image.name[0]}_c0_99us.png", "database"
        if image.name == QUERY:
            (root / "test-images-slice2.txt").write_text(f"{name}\n")
            model.deregister_frame(image.frame_id)
            folder = "query"
        shutil.copy(plane / "images" / image.name, root / folder / name)
        image.name = name
    model.write_binary(root / "sparse")
    return root


KINDS = {
    "aachen_layout": Aachen,
    "nvm_layout": AachenV1,
    "cambridge_layout": Cambridge,
    "cambridge_nvm_layout": CambridgeNvm,
    "sevenscenes_layout": SevenScenes,
    "cmu_layout": CMU,
    "inloc_layout": InLoc,
}


@pytest.mark.parametrize("kind", KINDS)
def test_layouts_are_recognized(kind, request, monkeypatch):
    root = request.getfixturevalue(kind)
    assert layout_of(root) is KINDS[kind]
    assert [layout for layout in LAYOUTS if layout.recognizes(root)][0] is KINDS[kind]
    place = KINDS[kind](root)
    assert place.map_names() and not {*place.map_names()} & {*place.query_names()}
    assert all((place.images / n).is_file() for n in (*place.map_names(), *place.query_names()))
    place.check(place.map_names())
    assert place.true_poses().keys() <= {*place.query_names()}
    monkeypatch.chdir(root)
    assert layout_of(Path(".")) is KINDS[kind]


LOCALIZED = ["nvm_layout", "cambridge_layout", "cambridge_nvm_layout", "sevenscenes_layout"]


@pytest.mark.parametrize("kind", LOCALIZED)
def test_the_queries_of_a_layout_are_localized(kind, request, tmp_path):
    root = request.getfixturevalue(kind)
    summary = aachen.main(root, tmp_path / "outputs", "sift_sv16")
    assert summary["map_images"] == 4 and summary["map_points3D"] > 100
    (found,) = [one for name, one in summary["lists"].items() if not name.startswith("night")]
    assert found["recall_percent"][-1] == (100 if kind != "nvm_layout" else 50)
    if kind != "nvm_layout":
        assert found["queries"] == 1 and found["median_position_error_m"] < 0.02
        assert (tmp_path / "outputs" / summary["files"]["ground_truth"]).is_file()
        name = (tmp_path / "outputs" / summary["poses"]).read_text().split()[0]
        assert name == open_model_place(root).query_names()[0]


def test_the_queries_of_a_slice_are_localized(cmu_layout, plane, tmp_path):
    """Files of poses have names as the benchmark wants them, without the folder."""
    (name,) = CMU(cmu_layout).query_names()
    truth = colmap.read_model(plane / "model").find_image_with_name(QUERY).cam_from_world()
    write_poses({name: truth}, tmp_path / "truth.txt", name_parts=None)
    truth = tmp_path / "truth.txt"
    summary = aachen.main(cmu_layout, tmp_path / "outputs", "sift_sv16", ground_truth=truth)
    assert summary["map_images"] == 4 and summary["lists"]["slice2"]["localized"] == 1
    assert summary["lists"]["slice2"]["median_position_error_m"] < 0.02
    poses = tmp_path / "outputs" / summary["poses"]
    assert poses.name.startswith("CMU_hloc_") and poses.read_text().split()[0] == name[6:]


def test_the_camera_of_a_query_is_in_its_name(cmu_layout):
    listed = CMU(cmu_layout).query_list
    listed.write_text("img_00007_c1_99us.png\n")
    assert CMU(cmu_layout).queries[0][1].width == 36
    listed.write_text("img_00007_c2_99us.png\n")
    with pytest.raises(InputError, match="slice2.txt: query/img_00007_c2_.* names no camera of"):
        _ = CMU(cmu_layout).queries


def test_intrinsics_of_queries_are_those_of_their_photos(cambridge_layout):
    place = Cambridge(cambridge_layout)
    ((name, camera),) = place.queries
    height, width = cv2.imread(str(place.images / name)).shape[:2]
    assert (camera.width, camera.height) == (width, height)


@pytest.mark.parametrize(
    "kind, part, said",
    [
        ("nvm_layout", "3D-models/database_intrinsics.txt", "visuallocalization.net"),
        ("nvm_layout", "queries", "visuallocalization.net"),
        ("cambridge_layout", f"../{Cambridge.models}/Plane/list_query.txt", "Cambridge/README.md"),
        ("cambridge_layout", f"../{Cambridge.models}/Plane/empty_all", "Cambridge/README.md"),
        ("cambridge_nvm_layout", "dataset_test.txt", "projects/relocalisation"),
        ("sevenscenes_layout", "../" + SevenScenes.models + "/plane/triangulated", "7Scenes/READ"),
        ("cmu_layout", "../intrinsics.txt", "visuallocalization.net"),
        ("cmu_layout", "test-images-slice2.txt", "visuallocalization.net"),
    ],
)
def test_what_is_missing_is_named(kind, part, said, request):
    root = request.getfixturevalue(kind)
    path = (root / part).resolve()
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink()
    with pytest.raises(InputError) as error:
        layout_of(root)(root)
    assert path.name in str(error.value) and said in str(error.value)


def test_a_list_of_other_images_is_refused(cambridge_nvm_layout, caplog):
    root, path = cambridge_nvm_layout, cambridge_nvm_layout / "dataset_train.txt"
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines, f"seq9/0.png {lines[-1].partition(' ')[2]}"]))
    place = CambridgeNvm(root)
    assert len(place.map_names()) == 4 and len(place.posed) == 5
    assert caplog.text.count("seq9/0.png are not in") == 1
    path.write_text("\n".join([*lines, "seq9/3.png 1 2"]))
    with pytest.raises(InputError, match="'seq9/3.png 1 2' is not a line `name x y z qw qx"):
        CambridgeNvm(root).map_names()
    path.write_text("\n".join(lines[:3]))
    with pytest.raises(InputError, match="dataset_train.txt has no line `name x y z qw"):
        CambridgeNvm(root).map_names()
    path.write_text("\n".join([*lines[:3], "seq9/0.png 0 0 0 1 0 0 0"]))
    with pytest.raises(InputError, match="dataset_train.txt has no image of reconstruction.nvm"):
        CambridgeNvm(root).map_names()
    path.write_text("\n".join([*lines, lines[-1]]))
    assert len(CambridgeNvm(root).map_names()) == 4
    path = root / "dataset_test.txt"
    path.write_text(path.read_text().replace("seq1", "seq9"))
    with pytest.raises(InputError, match="dataset_test.txt: seq9/4.png are not in recon"):
        CambridgeNvm(root).query_names()


def test_a_lens_of_an_nvm_file_is_that_of_its_model(tmp_path):
    model = synthetic()  # of SIMPLE_RADIAL
    root = tmp_path / "scene"
    (root / "seq1").mkdir(parents=True)
    for image in model.images.values():
        image.name = f"seq1/{image.image_id}.jpg"
    write_nvm(model, root / "reconstruction.nvm")
    names = [f"seq1/{i}.png 0 0 0 1 0 0 0" for i in model.images]
    dry_runs.write_lines(root / "dataset_train.txt", [*dry_runs.HEADER, *names[1:]])
    dry_runs.write_lines(root / "dataset_test.txt", [*dry_runs.HEADER, names[0]])
    ((name, camera),) = CambridgeNvm(root).queries  # its photo is missing
    assert (camera.width, camera.height) == (1920, 1080)
    expected = model.find_image_with_name(name.replace("png", "jpg")).camera
    np.testing.assert_allclose(camera.params[[0, 3]], expected.params[[0, 3]])


def test_queries_without_a_pose_are_named(sevenscenes_layout):
    folder = SevenScenes.folder(sevenscenes_layout) / "triangulated"
    (folder / "list_test.txt").write_text("seq-01/9.png\n")
    with pytest.raises(InputError, match="seq-01/9.png are not in the model triangulated"):
        SevenScenes(sevenscenes_layout).query_names()


def test_a_converted_model_is_kept_until_the_file_changes(nvm_layout, tmp_path):
    place, folder = AachenV1(nvm_layout), tmp_path / "reference"
    before = {path: path.stat().st_mtime_ns for path in place.reference(folder).iterdir()}
    assert {path: path.stat().st_mtime_ns for path in place.reference(folder).iterdir()} == before
    path = nvm_layout / NVM
    path.write_text(path.read_text().replace("\ndb/0.png", "\ndb/0.png", 1) + "\n")
    place.reference(folder)
    assert (folder / "made_from.json").stat().st_mtime_ns != before[folder / "made_from.json"]


@pytest.mark.check
def test_a_batch_and_a_comparison_take_them(
    cambridge_layout, sevenscenes_layout, run_batch, tmp_path
):
    folder = run_batch(
        {"dataset": [str(cambridge_layout), str(sevenscenes_layout)], "feature": "sift_sv16"}
    )
    rows = table(folder / "jobs.csv")
    assert {row["dataset"] for row in rows} == {"Plane", "plane"}
    assert not any(row["error"] for row in rows)
    assert {row["recall_percent"] for row in rows if row["threshold_m"] == "0.05"} == {"100.0"}
    assert compare.main(cambridge_layout, ["sift_sv16"], tmp_path / "c", max_mb=[1]) == {}
    assert len(table(tmp_path / "c/compare.csv")) == 6  # the whole map and a compact one
