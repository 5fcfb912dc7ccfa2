"""Names that lists cannot hold, and broken COLMAP models, are refused."""

import os
import re

import h5py
import numpy as np
import pycolmap
import pytest

from hloc_reduce import pairs_from_retrieval
from hloc_reduce.utils import colmap, parsers
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.images import list_images

NO_NAMES = ["/etc/x.jpg", "../x.jpg", "a/../x.jpg", "./x.jpg", "a/./x.jpg", "a//x.jpg", "a/", ".."]


SPACED = [" a.jpg", "a\tb.jpg", "a\u2028b.jpg", "#a.jpg", "a/b.jpg ", "a /b.jpg", "a\nb.jpg"]


QUERY = "PINHOLE 640 480 500 501 320 240"


def model_of(names, folder):
    """Write a COLMAP model of images."""
    camera = pycolmap.Camera(model="SIMPLE_PINHOLE", width=9, height=9, params=[9, 4, 4])
    camera.camera_id = 1
    model = pycolmap.Reconstruction()
    for i, name in enumerate(names, 1):
        image = pycolmap.Image(name=name, camera_id=1, image_id=i)
        colmap.add_image(model, camera, image, pycolmap.Rigid3d())
    folder.mkdir(exist_ok=True)
    model.write(folder)
    return folder


@pytest.mark.parametrize("name", NO_NAMES)
def test_names_that_lead_out_of_a_folder_are_refused(name, tmp_path):
    path = tmp_path / "list.txt"
    for read, line in (
        (parsers.parse_image_list, name),
        (parsers.parse_query_list, f"{name} {QUERY}"),
        (parsers.parse_retrieval, f"{name} a.jpg"),
        (parsers.parse_retrieval, f"a.jpg {name}"),
        (parsers.parse_poses, f"{name} 1 0 0 0 1 2 3"),
    ):
        path.write_text(f"# names\n{line}\n")
        with pytest.raises(InputError, match=re.escape(f"list.txt:2: '{name}' cannot be")):
            read(path)


@pytest.mark.parametrize("name", [*NO_NAMES, *SPACED])
def test_names_of_models_and_lists_in_memory_are_refused(name, tmp_path):
    model = model_of(["a.jpg", name], tmp_path / "model")
    with pytest.raises(InputError, match=f"model: {re.escape(repr(name))} cannot be"):
        colmap.read_model(model)
    with pytest.raises(InputError, match=re.escape(repr(name))):
        list_images(tmp_path, ["a.jpg", name])


def test_names_of_folders_and_h5_files_are_refused(tmp_path):
    path, output = tmp_path / "global.h5", tmp_path / "pairs.txt"
    with h5py.File(path, "w") as file:
        for name in ("a.jpg", "b\tc.jpg"):
            file[f"{name}/global_descriptor"] = np.ones(4)
    with pytest.raises(InputError, match=r"global.h5: 'b\\tc.jpg' cannot be"):
        pairs_from_retrieval.main(path, output, 1)
    for i, name in enumerate((b" a/b.jpg", b"a\tb.jpg", b"#a.jpg", b"\xe9.jpg")):
        file = tmp_path / str(i) / os.fsdecode(name)
        file.parent.mkdir(parents=True)
        file.touch()
        with pytest.raises(InputError, match=f"{i}: '.*jpg' cannot be"):
            list_images(tmp_path / str(i))


def test_a_model_with_a_name_that_is_no_text_is_refused(tmp_path):
    model = model_of(["a\u00e9.jpg"], tmp_path / "model")
    path = model / "images.bin"
    path.write_bytes(path.read_bytes().replace("a\u00e9".encode(), b"a\xe9\xe9"))
    with pytest.raises(InputError, match="images.bin, image 1: the name a.* is not in UTF-8"):
        colmap.read_model(model)


@pytest.mark.parametrize("name", ["cameras", "images", "points3D", "frames"])
def test_models_that_are_cut_off_are_refused(name, aachen_layout):
    """Of some COLMAP would read for ever, or until the memory is full."""
    model = aachen_layout / "3D-models/aachen_v_1_1"
    colmap.read_model(model).write(model)  # with frames
    path = model / f"{name}.bin"
    content = path.read_bytes()
    colmap.read_model(model)
    for length in (0, 7, 8, len(content) // 2, len(content) - 1):
        path.write_bytes(content[:length])
        with pytest.raises(InputError, match=f"not a COLMAP model .{name}.bin is truncated"):
            colmap.read_model(model)


@pytest.mark.fault(7)
def test_names_and_lists_in_latin_1_are_refused(tmp_path):
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / os.fsdecode(b"caf\xe9.jpg")).touch()
    with pytest.raises(InputError, match=r"photos: .* a name is a relative path in UTF-8 that"):
        list_images(tmp_path / "photos")
    path = tmp_path / "list.txt"
    path.write_bytes(f"a.jpg {QUERY}\ncaf\u00e9.jpg {QUERY}\n".encode("latin-1"))
    with pytest.raises(InputError, match=r"list.txt:2: not text in UTF-8.*; save it as UTF-8\."):
        parsers.parse_query_list(path)
