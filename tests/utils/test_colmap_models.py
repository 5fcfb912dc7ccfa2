"""COLMAP models of other programs and of careless hands are read as they are meant, or refused."""

import re
import shutil
import struct
from types import SimpleNamespace

import hostile
import numpy as np
import pycolmap
import pytest

from hloc_reduce import pairs_from_covisibility
from hloc_reduce.datasets.aachen import Aachen
from hloc_reduce.utils import colmap
from hloc_reduce.utils.cli import InputError
from pipelines import localize

PIPELINE = localize
NAMES = ["a.jpg", "b/c.jpg", "d.jpg"]
CAMERAS = ["1 SIMPLE_PINHOLE 640 480 500.5 320 240", "2 PINHOLE 800 600 700 701.25 400 300"]
POSES = [  # of unit length
    (0.5, 0.5, 0.5, 0.5, 1.25, -2.5, 3.75),
    (0.6, 0.0, 0.8, 0.0, 0.5, 0.25, -1e-05),
    (0.28, -0.96, 0.0, 0.0, 0.0, 7.5, 9.25),
]
KEYPOINTS = ["1.5 2.5 7 30.25 1e-05 -1", "10 20 -1 11.5 12.5 7", "1.5 2.5 -1"]
POINTS = ["7 0.5 1e-05 2.5 1 2 3 0.25 1 0 2 1"]


def images(names=NAMES, keypoints=KEYPOINTS, scale=1.0):
    """The lines of images.txt; None for an image without a line of keypoints."""
    lines = []
    for i, (name, pose, shown) in enumerate(zip(names, POSES, keypoints, strict=True), 1):
        numbers = [scale * value for value in pose[:4]] + list(pose[4:])
        lines += [" ".join(map(str, [i, *numbers, 1 + i % 2, name]))] + [shown] * (
            shown is not None
        )
    return lines


def write(folder, **parts):
    """Write a text model; lines of parts replace those of the sound one, None leaves a part out."""
    folder.mkdir(parents=True, exist_ok=True)
    for part, lines in (
        {"cameras": CAMERAS, "images": images(), "points3D": POINTS} | parts
    ).items():
        if lines is not None:
            content = lines if isinstance(lines, bytes) else ("\n".join(lines) + "\n").encode()
            (folder / f"{part}.txt").write_bytes(content)
    return folder


def changed(lines, line, word, value):
    """Replace a word of a line."""
    words = lines[line].split(" ")
    words[word] = value
    return [*lines[:line], " ".join(words), *lines[line + 1 :]]


def as_float(word):
    """Write a whole number as numpy does by default."""
    return f"{int(word):.18e}" if word.lstrip("-").isdigit() else word


def as_bytes(lines, end="\n", encoding="utf-8"):
    return end.join([*lines, ""]).encode(encoding)


def check(model, names=NAMES, keypoints=KEYPOINTS):
    """Check names, poses, cameras and keypoints of a model."""
    assert sorted(model.images) == [1, 2, 3]
    for i, (name, pose, shown) in enumerate(zip(names, POSES, keypoints, strict=True), 1):
        image = model.images[i]
        assert image.name == name and image.camera.width == (800, 640)[i % 2 == 0]
        cam_from_world = image.cam_from_world()
        np.testing.assert_allclose(cam_from_world.rotation.quat, [*pose[1:4], pose[0]], atol=1e-15)
        assert cam_from_world.translation.tolist() == list(pose[4:])
        values = np.array((shown or "").split(), float).reshape(-1, 3)
        assert [point.xy.tolist() for point in image.points2D] == values[:, :2].tolist()
        assert colmap.point3D_ids(image).tolist() == values[:, 2].tolist()
    assert list(model.cameras[1].params) == [500.5, 320, 240]


def track(model):
    return sorted((one.image_id, one.point2D_idx) for one in model.points3D[7].track.elements)


WITHOUT = [None] * 3
EMPTY = [""] * 3
READ = {  # parts of a text model, and what is read
    "sound": ({}, {}),
    "no keypoints": ({"images": images(keypoints=EMPTY), "points3D": []}, {"keypoints": EMPTY}),
    "no lines of keypoints": (
        {"images": images(keypoints=WITHOUT), "points3D": []},
        {"keypoints": EMPTY},
    ),
    "keypoints of one": (
        {"images": images(keypoints=[None, None, KEYPOINTS[2]]), "points3D": []},
        {"keypoints": ["", "", KEYPOINTS[2]]},
    ),
    "no line of the last": (
        {"images": as_bytes(images(keypoints=EMPTY)).rstrip(), "points3D": []},
        {"keypoints": EMPTY},
    ),
    "empty lines between": ({"images": [line for one in images() for line in (one, "")]}, {}),
    "comments between": ({"images": [line for one in images() for line in ("# a", one)]}, {}),
    "a comment in Latin-1": ({"cameras": as_bytes(["# \u00e4", *CAMERAS], encoding="latin-1")}, {}),
    "of Windows": ({"images": as_bytes(images(), "\r\n")}, {}),
    "byte order marks": (
        {
            "cameras": as_bytes(CAMERAS, encoding="utf-8-sig"),
            "images": as_bytes(images(), encoding="utf-8-sig"),
            "points3D": as_bytes(POINTS, encoding="utf-8-sig"),
        },
        {},
    ),
    "tabs": (
        {"cameras": [one.replace(" ", "\t") for one in CAMERAS]}
        | {"images": [one.replace(" ", "\t") for one in images()]}
        | {"points3D": [one.replace(" ", "\t") for one in POINTS]},
        {},
    ),
    "aligned": ({"images": [one.replace(" ", "   ") for one in images()]}, {}),
    "quaternions of length 3.7": ({"images": images(scale=3.7)}, {}),
    "quaternions of length 1.002": ({"images": images(scale=1.002)}, {}),
    "names with spaces": (
        {"images": images(names := ["my photo 1.jpg", "b  c/\u00e9 d.jpg", "e f g h.jpg"])},
        {"names": names},
    ),
    "long lines": (
        {
            "images": images(
                keypoints=(many := [f"{one} " + "3.5 4.5 -1 " * 99 for one in KEYPOINTS])
            )
        },
        {"keypoints": many},
    ),
    "long lines of -1.0": (
        {"images": images(keypoints=[one.replace("-1 ", "-1.0 ") for one in many])},
        {"keypoints": many},
    ),
    "an unused broken camera": ({"cameras": [*CAMERAS, "9 PINHOLE 0 0 0 0 0 0"]}, {}),
    "whole numbers written as others": (
        {"cameras": ["1.0 SIMPLE_PINHOLE 640.0 4.80e+02 500.5 320 240", CAMERAS[1]]}
        | {"images": [" ".join(map(as_float, line.split(" "))) for line in images()]}
        | {"points3D": ["7.0 0.5 1e-05 2.5 1.0 2.00e+00 3 0.25 1.0 0 2 1.0"]},
        {},
    ),
    "points of exponents": ({"points3D": [changed(POINTS, 0, 4, "1e0")[0] + " "]}, {}),
    "comments at the ends of lines": (
        {"cameras": [f"{CAMERAS[0]} # a, 1 2", f"{CAMERAS[1]}\t#b"]}
        | {"images": changed(images(), 1, 5, "-1 # c d e")}
        | {"points3D": [f"{POINTS[0]} # f 1"]},
        {},
    ),
    "no numbers for keypoints without points": (
        {"images": changed(changed(images(), 1, 3, "NaN"), 1, 4, "-inf")},
        {"keypoints": [KEYPOINTS[0].replace("30.25 1e-05", "0 0"), *KEYPOINTS[1:]]},
    ),
    **{
        f"error {error}": ({"points3D": changed(POINTS, 0, 7, error)}, {})
        for error in ("nan", "inf", "-nan", "?", "-1")
    },
    "no error": ({"points3D": [POINTS[0].replace(" 0.25", "")]}, {}),
}


@pytest.mark.fault(7)
@pytest.mark.parametrize("kind", READ)
def test_text_models_are_read_whole(kind, tmp_path, caplog):
    parts, read = READ[kind]
    model = colmap.read_model(write(tmp_path / "model", **parts))
    check(model, **read)
    if "points3D" not in parts or parts["points3D"]:
        assert track(model) == [(1, 0), (2, 1)]
        assert model.points3D[7].xyz.tolist() == [0.5, 1e-05, 2.5]
        assert model.points3D[7].color.tolist() == [1, 2, 3]
    assert not caplog.records


REFUSED = [  # part, lines, what the message says
    *(("cameras", changed(CAMERAS, 0, 4, f), r"txt:1: not a camera") for f in ("0", "-5", "nan")),
    ("cameras", changed(CAMERAS, 1, 1, "PINHOL"), r"txt:2: .*Unknown camera model 'PINHOL'"),
    ("cameras", CAMERAS[:1], r"images.txt:1: it has camera 2, which is not among the cameras"),
    ("cameras", [*CAMERAS, CAMERAS[0]], r"txt:3: the id 1 is used twice, first at .*txt:1\."),
    ("cameras", [one.replace(".", ",") for one in CAMERAS], r"txt:1: .*points into decimal"),
    ("images", changed(images(), 2, 9, "a.jpg"), r"txt:3: a.jpg is in the model twice, .*txt:1"),
    (
        "images",
        changed(images(), 2, 0, "1"),
        r"txt:3: the id 1 is used twice, first at .*images.txt:1\.",
    ),
    ("images", changed(images(), 2, 0, "4294967277"), r"txt:3: the id 4294967277 is not from"),
    ("images", changed(images(), 2, 0, "-1"), r"txt:3: the id -1 is not from 0"),
    *(("images", changed(images(), 2, 5, t), rf"txt:3: .*{t} is not") for t in ("nan", "1e999")),
    ("images", ["1 0 0 0 0 1 2 3 1 a.jpg"], r"txt:1: not a pose"),
    ("images", changed(images(), 1, 0, "inf"), r"txt:2: .*inf is not a finite number"),
    ("images", changed(images(), 1, 2, "1.5"), r"txt:2: .*1.5 is not a whole number"),
    ("images", [one.replace(" ", ",") for one in images()], r"txt:1: .*put spaces between the"),
    ("images", [one.replace(" ", ";") for one in images()], r"txt:1: .*put spaces between the"),
    ("images", [one.replace(".", ",") for one in images()], r"txt:1: .*points into decimal"),
    ("images", as_bytes(images(["\u00e9.jpg", "b", "c"]), encoding="latin-1"), "txt:1: .*UTF-8"),
    ("images", as_bytes(images(), encoding="utf-16"), "txt:1: not text in UTF-8"),
    *(("points3D", changed(POINTS, 0, 1, x), rf"txt:1: .*{x} is") for x in ("nan", "1e999", "1,5")),
    *(("images", changed(images(), 1, i, "nan"), r"txt:2: .*nan is not a") for i in (0, 1, 2, 5)),
    ("images", changed(images(), 1, 3, "x"), r"txt:2: .*x is not a finite number"),
    ("images", changed(images(), 1, 0, "3.5 4"), r"txt:2: .*keypoints .the number of its words"),
    ("images", changed(images(), 3, 5, "7.5"), r"txt:4: .*keypoints .7.5 is not a whole number"),
    ("images", changed(images(), 3, 3, "x"), r"txt:4: .*keypoints .x is not a finite number"),
    ("images", images(keypoints=["10 20", "", ""]), r"txt:2: .*words. nor its keypoints .the num"),
    ("cameras", changed(CAMERAS, 1, 2, "800.5"), r"txt:2: .*800.5 600 are not a width"),
    ("cameras", changed(CAMERAS, 1, 2, "0"), r"txt:2: not a camera"),
    *(("points3D", changed(POINTS, 0, 4, c), rf"txt:1: .*{c} is not") for c in ("128.5", "1e-1")),
    ("points3D", changed(POINTS, 0, 9, "0.5"), r"txt:1: .*0.5 is not a whole number"),
    ("points3D", changed(POINTS, 0, 0, "9" * 400), r"txt:1: not a point"),
    ("points3D", [*POINTS, POINTS[0]], r"txt:2: the id 7 is used twice, first at .*txt:1\."),
    ("points3D", ["7 0 0 1 9 9"], r"txt:1: not a point .it has too few words"),
    ("rigs", ["1 1 CAMERA 1"], "images.txt:1: image 1 is in no frame"),
]


@pytest.mark.fault(7)
@pytest.mark.parametrize(("part", "lines", "message"), REFUSED)
def test_broken_lines_of_text_models_are_named(part, lines, message, tmp_path):
    folder = write(tmp_path / "model", **{part: lines})
    with pytest.raises(InputError, match=f"model/.*{message}") as refused:
        colmap.read_model(folder)
    assert "Check failed" not in str(refused.value) and "\n" not in str(refused.value)


def binary(folder, change=lambda model: None, drop=()):
    """Write the sound model in binary files, changed and without some."""
    model = colmap.read_model(write(folder / "text"))
    change(model)
    written = folder / "model"
    written.mkdir()
    model.write_binary(written)
    for part in drop:
        (written / f"{part}.bin").unlink()
    return written


def scale_quaternions(model):
    for frame in model.frames.values():
        pose = frame.rig_from_world
        rotation = pycolmap.Rotation3d(1.002 * pose.rotation.quat)
        frame.rig_from_world = pycolmap.Rigid3d(rotation, pose.translation)


@pytest.mark.fault(7)
@pytest.mark.parametrize("drop", [(), ("rigs", "frames")])
def test_quaternions_of_binary_models_are_normalized(drop, tmp_path):
    check(colmap.read_model(binary(tmp_path, scale_quaternions, drop)))


def set_focal_length(model):
    model.cameras[1].params = [0, 320, 240]


def set_position(model):
    model.points3D[7].xyz = np.array([0, np.nan, 0])


def set_pose(model):
    frame = model.images[2].frame
    frame.rig_from_world = pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array([0, 0, np.inf]))


def set_name(model):
    model.images[2].name = "a.jpg"


@pytest.mark.fault(7)
@pytest.mark.parametrize(
    ("change", "message"),
    [
        (set_focal_length, "cameras.bin, camera 1: not a camera"),
        (set_position, "points3D.bin, point 7: its position is not finite"),
        (set_pose, "frames.bin, frame 2: not a pose"),
        (set_name, "images.bin, image 2: a.jpg is in the model twice, first at .*image 1"),
    ],
)
def test_broken_records_of_binary_models_are_named(change, message, tmp_path):
    with pytest.raises(InputError, match=f"model/{message}"):
        colmap.read_model(binary(tmp_path, change))


@pytest.mark.fault(7)
@pytest.mark.parametrize(
    ("part", "record", "message"),
    [
        ("cameras", struct.pack("<IiQQ3d", 1, 0, 9, 9, 9, 4, 4), "has camera 2"),
        ("rigs", struct.pack("<IIiI", 1, 1, 0, 1), "frame 1: it has rig 2"),
        ("frames", struct.pack("<II7dI", 9, 1, 1, *[0] * 6, 0), "image 1 is in no frame"),
    ],
)
def test_binary_models_without_a_record_are_refused(part, record, message, tmp_path):
    folder = binary(tmp_path)
    (folder / f"{part}.bin").write_bytes(struct.pack("<Q", 1) + record)
    with pytest.raises(InputError, match=message):
        colmap.read_model(folder)


@pytest.mark.fault(7)
@pytest.mark.parametrize("suffix", [".bin", ".txt"])
@pytest.mark.parametrize(
    ("points", "points_of_images"),
    [
        (POINTS, (7, 7)),
        ([], (-1, -1)),
        (None, (-1, -1)),
        (["9" + POINTS[0][1:]], (-1, -1)),
        ([POINTS[0].removesuffix(" 2 1")], (7, 7)),
        ([POINTS[0] + " 3 5"], (7, 7)),
        ([POINTS[0] + " 99 0"], (7, 7)),
        ([POINTS[0].replace(" 2 1", " 99 1")], (7, 7)),
    ],
)
def test_images_tell_which_keypoints_show_points(
    suffix, points, points_of_images, tmp_path, caplog
):
    """Whatever points say of it: COLMAP crashes when it removes an image from such a model."""
    folder = write(tmp_path / "text", points3D=points)
    if suffix == ".bin":
        folder = binary(tmp_path, drop=["points3D"])
        if points is not None:
            (folder / "points3D.bin").write_bytes(packed(points))
    model = colmap.read_model(folder)
    assert ("images and points disagree" in caplog.text) == (points != POINTS)
    assert tuple(model.images[i].point2D(i - 1).point3D_id for i in (1, 2)) == tuple(
        2**64 - 1 if point == -1 else point for point in points_of_images
    )
    if 7 in points_of_images:
        assert track(model) == [(1, 0), (2, 1)]
    part = colmap.read_model(colmap.write_part(folder, {"a.jpg", "d.jpg"}, tmp_path / "part"))
    assert {image.name for image in part.images.values()} == {"a.jpg", "d.jpg"}


def packed(lines):
    """The content of points3D.bin with the points in lines."""
    content = struct.pack("<Q", len(lines))
    for line in lines:
        number, *words = line.split()
        values = [*map(float, words[:3]), *map(int, words[3:6]), float(words[6])]
        elements = list(map(int, words[7:]))
        content += struct.pack("<Q3d3BdQ", int(number), *values, len(elements) // 2)
        content += struct.pack(f"<{len(elements)}I", *elements)
    return content


RIGS = [  # the second camera is turned by 180 degrees around z, and 1 to the side
    "1 2 CAMERA 1 CAMERA 2 1 0 0 0 {scale} 1 0 0",
]
FRAMES = ["5 1 {scale} 0 0 0 0 0 4 2 CAMERA 1 11 CAMERA 2 12"]
OF_RIG = ["11 9 9 9 9 9 9 9 1 a.jpg", "", "12 9 9 9 9 9 9 9 2 b.jpg", ""]


@pytest.mark.fault(7)
@pytest.mark.parametrize("scale", ["1", "1.002", "3"])
def test_rotations_of_rigs_are_normalized(scale, tmp_path):
    rigs, frames = ([one.format(scale=scale) for one in lines] for lines in (RIGS, FRAMES))
    parts = {"rigs": rigs, "frames": frames, "images": OF_RIG, "points3D": []}
    model = colmap.read_model(write(tmp_path / "model", **parts))
    for name, quaternion, translation in (
        ("a.jpg", [0, 0, 0, 1], [0, 0, 4]),
        ("b.jpg", [0, 0, 1, 0], [1, 0, 4]),
    ):
        pose = model.find_image_with_name(name).cam_from_world()
        assert pose.rotation.quat.tolist() == quaternion
        assert pose.translation.tolist() == translation


@pytest.mark.fault(7)
@pytest.mark.parametrize(
    ("part", "lines", "message"),
    [
        ("rigs", ["3 1 CAMERA 1"], "frames.txt:1: it has rig 1, which is not among the rigs"),
        ("rigs", ["1 1 CAMERA 1"], "rigs.txt:1: the rig has no camera 2"),
        ("rigs", ["1 2 CAMERA 1 CAMERA 2 0"], "rigs.txt:1: the rig has no camera 2, or no pose"),
        ("rigs", ["1 2 CAMERA 1 CAMERA"], "rigs.txt:1: not a rig"),
        ("rigs", ["1 1 CAMERA 7"], "rigs.txt:1: it has camera 7, which is not among the cameras"),
        ("rigs", None, "frames.txt:1: it has rig 1"),
        ("rigs", [RIGS[0].format(scale=0)], "rigs.txt:1: not a pose"),
        ("frames", ["5 1 1 0 0 0 0 0 4 1 CAMERA 1 11"], "images.txt:3: image 12 is in no frame"),
        ("frames", [FRAMES[0].format(scale=0)], "frames.txt:1: not a pose"),
        ("frames", None, "images.txt:1: image 11 is in no frame"),
        ("images", OF_RIG[:2], "frames.txt:1: it has image 12, which is not among the images"),
    ],
)
def test_rigs_that_do_not_fit_are_refused(part, lines, message, tmp_path):
    rigs, frames = ([one.format(scale=1) for one in lines] for lines in (RIGS, FRAMES))
    parts = {"rigs": rigs, "frames": frames, "images": OF_RIG, "points3D": []} | {part: lines}
    with pytest.raises(InputError, match=f"model/{message}"):
        colmap.read_model(write(tmp_path / "model", **parts))


@pytest.mark.fault(7)
@pytest.mark.parametrize("missing", ["cameras", "images"])
def test_a_missing_file_is_named(missing, tmp_path):
    folder = write(tmp_path / "model", **{missing: None})
    with pytest.raises(InputError, match=rf"not a COLMAP model .it has no {missing}.txt"):
        colmap.read_model(folder)


@pytest.mark.fault(7)
def test_a_broken_model_ends_a_run_before_photos_are_read(tmp_path, refused):
    folder = write(tmp_path / "model", cameras=changed(CAMERAS, 0, 4, "0"))
    message = refused("--map", folder, "--map_images", tmp_path, "--outputs", tmp_path / "outputs")
    assert "cameras.txt:1: not a camera (sizes and focal lengths are positive" in message
    assert not (tmp_path / "outputs").exists()


@pytest.fixture
def sparse(tmp_path):
    """A folder with several models, as COLMAP writes it."""
    whole = write(tmp_path / "sparse/0")
    single = write(tmp_path / "sparse/1", images=images()[:2], points3D=[])
    ten = tmp_path / "sparse/10"
    ten.mkdir()
    colmap.read_model(whole).write_binary(ten)
    (tmp_path / "sparse/project.ini").write_text("")
    return SimpleNamespace(folder=tmp_path / "sparse", whole=whole, single=single, ten=ten)


@pytest.mark.fault(8)
@pytest.mark.parametrize("suffix", [".txt", ".bin"])
def test_the_only_model_in_a_folder_is_taken(suffix, sparse):
    taken, other = (sparse.whole, sparse.ten)[:: 1 if suffix == ".txt" else -1]
    shutil.rmtree(other)
    shutil.rmtree(sparse.single)
    check(colmap.read_model(sparse.folder))
    assert colmap.find_model(sparse.folder) == colmap.find_model(taken) == taken
    assert colmap.model_files(sparse.folder) == colmap.model_files(taken)
    assert {path.suffix for path in colmap.model_files(taken)} == {suffix}


@pytest.mark.fault(8)
def test_several_models_in_a_folder_are_named(sparse, tmp_path, refused):
    said = f"{sparse.folder} has 3 COLMAP models: 0 (3 photos), 1 (1 photos), 10 (3 photos)"
    for read in (colmap.find_model, colmap.read_model, colmap.model_files):
        with pytest.raises(InputError, match=re.escape(said)):
            read(sparse.folder)
    new = ("--outputs", tmp_path / "outputs")
    assert said in refused("--map", sparse.folder, "--map_images", tmp_path, *new)
    assert "is a COLMAP model: give its photos" in refused("--map", sparse.folder, *new)


@pytest.mark.fault(8)
def test_stages_and_data_sets_take_the_only_model_in_a_folder(aachen_layout, tmp_path):
    model = aachen_layout / "3D-models/aachen_v_1_1"
    whole = pairs_from_covisibility.main(model, tmp_path / "whole.txt", 2).read_text()
    names = Aachen(aachen_layout).map_names()
    model.rename(tmp_path / "0")
    model.mkdir()
    (tmp_path / "0").rename(model / "0")
    assert pairs_from_covisibility.main(model, tmp_path / "in.txt", 2).read_text() == whole
    assert Aachen(aachen_layout).map_names() == names
    assert Aachen(aachen_layout).reference_model == model / "0"


@pytest.mark.fault(7)
@pytest.mark.parametrize(
    ("part", "lines"),
    [("cameras", CAMERAS[:1]), ("images", ["1 1 0 0 0 1.5 2 3 1 a.jpg", "1.5 2 7"])]
    + [("points3D", ["7 0.5 1 2 1 2 3 0.2 1 0"]), ("rigs", RIGS), ("frames", FRAMES)],
)
def test_any_text_is_read_or_refused(part, lines, tmp_path):
    pose = "9 9 9 9 9 9 9"
    parts = {"images": [f"1 {pose} 1 a.jpg", "1.5 2 7"], "points3D": ["7 0 1 2 1 2 3 0.2 1 0"]}
    if part in ("rigs", "frames"):
        parts = {"rigs": RIGS, "frames": FRAMES, "images": OF_RIG, "points3D": []}
        parts |= {
            name: [line.format(scale=1) for line in parts[name]] for name in ("rigs", "frames")
        }
    folder = write(tmp_path / "model", **parts)
    hostile.check_text(
        folder / f"{part}.txt",
        [line.format(scale=1) for line in lines],
        lambda path: colmap.read_model(path.parent),
    )
