"""Wrong, foreign and hostile input: it works where it can, else one clear InputError."""

import json
import os
import pickle
import re
import shutil
import subprocess
import sys
from contextlib import suppress
from types import SimpleNamespace

import h5py
import numpy as np
import pycolmap
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from safetensors.torch import load, save_file

from hloc_reduce import (
    aggregate_features,
    extract_features,
    localize_sfm,
    match_features,
    pairs_from_retrieval,
    projections,
    report,
    storage,
    triangulation,
)
from hloc_reduce.aggregators.vlad import read_vocabulary
from hloc_reduce.confs import features as features_confs
from hloc_reduce.datasets import phototour, scans
from hloc_reduce.evaluation.hpatches import lists
from hloc_reduce.evaluation.hpatches.data import test_sequences as sequences
from hloc_reduce.evaluation.poses import pose_error, read_estimates
from hloc_reduce.extract_features import provenance
from hloc_reduce.localization import intrinsics
from hloc_reduce.localization.records import RECORDS
from hloc_reduce.projections import network
from hloc_reduce.runtime import group_writer
from hloc_reduce.runtime.group_writer import GroupWriter
from hloc_reduce.utils import colmap, parsers
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.feature_files import get_descriptors, get_image_size, get_keypoints, store
from hloc_reduce.utils.h5 import file_provenance, list_h5_names, open_h5
from hloc_reduce.utils.images import list_images
from hloc_reduce.utils.match_files import get_matches, names_to_pair

fuzzed = settings(
    max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


def refuses_or_reads(read, path):
    """Read a file, which may be refused by an InputError that names it, but in no other way."""
    try:
        return read(path)
    except InputError as error:
        assert path.name in str(error) or str(path.parent) in str(error)
        assert str(error).count("\n") < 2
        return None


# ------------------------------------------------------------------------------ text

RECORD = {
    "localized": True,
    "qvec": [1.0, 0.0, 0.0, 0.0],
    "tvec": [0.0, 0.0, 1.0],
    "num_inliers": 9,
}


def read_poses(path):
    for pose in parsers.parse_poses(path).values():
        rotation = pose.rotation.matrix()
        assert np.isfinite(pose.matrix()).all()
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-6)


def read_queries(path):
    for _, camera in parsers.parse_query_list(path):
        assert np.isfinite(camera.params).all() and camera.width > 0


def read_feature(path):
    conf = features_confs.read(path)
    with suppress(InputError):  # no such projection, for example
        provenance(conf)


# what a parser reads: its file, the lines of a sound one, and the parser of its path
TEXTS = {
    "images": ("l.txt", ["db/a.jpg", "db/b.jpg 1 2"], parsers.parse_image_list),
    "queries": (
        "l.txt",
        ["a.jpg PINHOLE 640 480 500 501 320 240", "b.jpg SIMPLE_RADIAL 640 480 500 320 240 0.1"],
        read_queries,
    ),
    "pairs": ("l.txt", ["a.jpg b.jpg", "a.jpg c.jpg"], lambda p: list(parsers.parse_pairs(p))),
    "retrieval": ("l.txt", ["a.jpg b.jpg", "a.jpg c.jpg"], parsers.parse_retrieval),
    "poses": ("l.txt", ["a.jpg 1 0 0 0 1 2 3", "b.jpg 0.6 0.8 0 0 -1 2e3 .5"], read_poses),
    "records": (
        "r_logs.jsonl",
        [
            json.dumps({"records": RECORDS}),
            json.dumps(["a.jpg", RECORD]),
            '["b.jpg", {"localized": false, "qvec": null}]',
        ],
        read_estimates,
    ),
    "transformation": (
        "t.txt",
        ["before", *[""] * 6, "1 0 0 5", "0 1 0 6", "0 0 1 7", "0 0 0 1"],
        scans.read_transformation,
    ),
    "points of PhotoTour": (
        "info.txt",
        ["0 0", "0 0", "1 0", "1 0"],
        lambda path: phototour.read_points(path.parent),
    ),
    "pairs of PhotoTour": (
        phototour.PAIRS,
        ["0 0 0 1 0 0 0", "0 0 0 2 1 0 0"],
        lambda path: phototour.read_pairs(path.parent),
    ),
    "pairs of HPatches": (
        "l.csv",
        [",".join(lists.PAIR_COLUMNS), "i_a,0,1,v_b,5,2"],
        lambda path: lists._read(path, lists.PAIR_COLUMNS, {"i_a": 2, "v_b": 3}),
    ),
    "patches of HPatches": (
        "l.csv",
        [",".join(lists.PATCH_COLUMNS), "i_a,1", "v_b,2"],
        lambda path: lists._read(path, lists.PATCH_COLUMNS, {"i_a": 2, "v_b": 3}),
    ),
    "splits of HPatches": (
        "splits.json",
        ['{"a": {"test": ["i_a"], "train": []}}'],
        lambda path: sequences(path.parent, path.parent, "a"),
    ),
    "feature": (
        "f.yaml",
        [
            "model:",
            "  name: reduced",
            "  base: {name: dog, descriptor: sift}",
            "  projection: sift_sv64",
            "preprocessing: {resize_max: 1000}",
        ],
        read_feature,
    ),
}
HARMFUL = [
    *("nan", "-inf", "1e400", "9" * 5000, "-1", "18446744073709551616", "1e308", "1e-320", "0"),
    *("NaN", "Infinity", "null", "[]", "{}", '"', "\0", "\ufeff", "٣", "0x10", "0" * 9),
    *("..", "/etc/a.jpg", "#", "'", "&a [*a]", "!!python/object/apply:os.abort []", "2020-99-99"),
    *("!!int x", "!!float x", "!!bool x", "!!timestamp x", "? {}", "\u2028"),
]


@pytest.fixture(params=TEXTS)
def text(request, tmp_path):
    name, lines, read = TEXTS[request.param]
    path = tmp_path / name
    # what stands beside the files of data sets
    (tmp_path / "i_a").mkdir()
    for beside in ("patches0000.bmp", "i_a/ref.png"):
        (tmp_path / beside).touch()
    path.write_text("\n".join(lines), encoding="utf-8")
    read(path)  # it is sound
    return path, lines, read


@fuzzed
@given(content=st.binary() | st.text().map(lambda text: text.encode(errors="surrogatepass")))
def test_any_text_is_read_or_refused(text, content):
    path, _, read = text
    path.write_bytes(content)
    refuses_or_reads(read, path)


def tokens(content):
    """Where the words of a text are, and what is between them."""
    return [(found.start(), found.end()) for found in re.finditer(r"[\w.-]+|\W", content)]


def test_text_with_something_harmful_is_read_or_refused(text):
    path, lines, read = text
    content = "\n".join(lines)
    for start, end in tokens(content):
        for piece in ["", *HARMFUL, *["[" * 2000] * (start == 0)]:  # which takes long to refuse
            path.write_bytes((content[:start] + piece + content[end:]).encode())
            refuses_or_reads(read, path)


@fuzzed
@given(data=st.data(), piece=st.text(max_size=4))
def test_text_with_something_wrong_is_read_or_refused(text, data, piece):
    path, lines, read = text
    content = "\n".join(lines)
    start, end = data.draw(st.sampled_from(tokens(content)))
    changed = content[:start] + piece + content[data.draw(st.sampled_from([start, end])) :]
    path.write_bytes(changed.encode(errors="surrogatepass"))
    refuses_or_reads(read, path)


def test_a_table_with_a_cell_without_an_end_is_refused(tmp_path):
    path = tmp_path / "l.csv"
    path.write_text("s,idx\n" + "i" * 200_000 + ",1\n")
    with pytest.raises(InputError, match="l.csv, line 2: field larger"):
        lists._read(path, lists.PATCH_COLUMNS, {"i_a": 2})


@pytest.mark.parametrize("text", ["images", "queries", "pairs", "poses"], indirect=True)
def test_a_mark_of_byte_order_is_no_part_of_a_name(text):
    path, lines, read = text
    expected = read(path)
    path.write_text("\n".join(lines), encoding="utf-8-sig")
    assert read(path) == expected


# --------------------------------------------------------------------------- h5 files

OURS = ("db/0.jpg", "query/6.jpg")  # the images of the scene that are changed


def put(group, key, value):
    if key in group:
        del group[key]
    if value is not None:
        group[key] = value


def into(key, change):
    """What changes a data set of an image."""
    return lambda group: put(group, key, change(group[key][()]))


def as_data_set(group):
    """Put a data set in the place of an image's group."""
    file, name = group.file, group.name
    del file[name]
    file[name] = np.zeros(3)


def as_group(key):
    def change(group):
        del group[key]
        group[f"{key}/numbers"] = np.zeros(3)

    return change


def with_uncertainty(value):
    def change(group):
        group["keypoints"].attrs["uncertainty"] = value

    return change


def with_nan(numbers):
    numbers[1, 5] = np.nan
    return numbers


# a change of two images of a feature file -> the stages that need what is wrong
FEATURES = {
    "as hloc's are": (lambda group: put(group, "image_size", np.array([640, 480])), ()),
    "no keypoints": (into("keypoints", lambda _: None), ("map", "localize")),
    "no descriptors": (
        into("descriptors", lambda _: None),
        ("match", "aggregate", "store"),
    ),
    "keypoints (N,)": (into("keypoints", lambda k: k[:, 0]), ("map", "localize")),
    "keypoints (N, 1)": (into("keypoints", lambda k: k[:, :1]), ("map", "localize")),
    "keypoints (N, 5)": (into("keypoints", lambda k: np.pad(k, ((0, 0), (0, 3)))), ()),
    "keypoints of one number": (into("keypoints", lambda _: 3.0), ("map", "localize")),
    "keypoints of text": (into("keypoints", lambda _: "none"), ("map", "localize")),
    "keypoints of integers": (into("keypoints", lambda k: k.round().astype(np.int16)), ()),
    "keypoints of NaN": (into("keypoints", lambda k: with_nan(k.T).T), ("map", "localize")),
    # which looks like one more image
    "keypoints in a group": (as_group("keypoints"), ("map", "localize", "aggregate", "store")),
    "no uncertainty": (with_uncertainty("much"), ("map", "localize")),
    "negative uncertainty": (with_uncertainty(-1.0), ("map", "localize")),
    "descriptors (N, D)": (into("descriptors", np.transpose), ("match", "aggregate", "store")),
    "descriptors (N,)": (
        into("descriptors", lambda d: d[0]),
        ("match", "aggregate", "store"),
    ),
    "descriptors of one number": (
        into("descriptors", lambda _: 3.0),
        ("match", "aggregate", "store"),
    ),
    "descriptors of NaN": (into("descriptors", with_nan), ("match", "aggregate", "store")),
    "descriptors of 32 numbers": (into("descriptors", lambda d: d[:32]), ("match", "aggregate")),
    "descriptors of integers": (
        into("descriptors", lambda d: np.round(d * 128).astype(np.int8)),
        (),
    ),
    "descriptors in a group": (as_group("descriptors"), ("match", "aggregate", "store")),
    "image_size of one number": (lambda group: put(group, "image_size", 640), ("localize",)),
    "image_size of text": (lambda group: put(group, "image_size", "640x480"), ("localize",)),
    "image_size of NaN": (
        lambda group: put(group, "image_size", np.full(2, np.nan)),
        ("localize",),
    ),
    "image_size of zeros": (lambda group: put(group, "image_size", np.zeros(2)), ("localize",)),
    "more data": (lambda group: put(group, "note", "from elsewhere"), ()),
    "empty data": (lambda group: put(group, "note", h5py.Empty("f4")), ()),
    "a data set": (as_data_set, ("match", "map", "localize", "aggregate", "store")),
    "no image": (
        lambda group: put(group.file, group.name, None),
        ("match", "map", "localize", "aggregate"),
    ),
}


@pytest.fixture
def stages(scene):
    """The stages of a localization by name, each as a function of its features and matches."""
    root, names = scene.root, list(scene.poses)
    pairs, retrieval = root / "pairs.txt", root / "retrieval.txt"
    parsers.write_pairs([(a, b) for a in names[:6] for b in names[:6] if a < b], pairs)
    parsers.write_pairs([(a, b) for a in names[6:] for b in names[:6]], retrieval)
    every = root / "every.txt"
    every.write_text(pairs.read_text() + retrieval.read_text())
    conf = match_features.confs["NN-mutual"]
    matches, model = root / "matches.h5", root / "sfm"

    def localize(features, matches):
        return localize_sfm.main(
            model, scene.queries, retrieval, features, matches, root / "results.txt"
        )

    sound = root / "sound.h5"
    shutil.copy(scene.features, sound)
    match_features.main(conf, every, sound, matches=matches)
    triangulation.main(model, scene.model, scene.images, pairs, sound, matches)
    assert all(record["localized"] for record in localize(sound, matches).values())
    done = {
        "match": lambda features, _: match_features.main(
            conf, every, features, matches=root / "m.h5", overwrite=True
        ),
        "map": lambda features, matches: triangulation.main(
            root / "other", scene.model, scene.images, pairs, features, matches, overwrite=True
        ),
        "localize": localize,
        "aggregate": lambda features, _: aggregate_features.main(
            aggregate_features.confs["vlad"], features, names[:6], overwrite=True
        ),
        "store": lambda features, _: storage.main(features, root / "s.h5", "uint8", overwrite=True),
    }
    return SimpleNamespace(by_name=done, sound=sound, matches=matches, pairs=pairs, names=names)


@pytest.mark.parametrize("kind", FEATURES)
def test_features_of_other_tools(kind, scene, stages):
    """A stage that needs what is wrong names the file and the image; others work."""
    change, refusing = FEATURES[kind]
    with h5py.File(scene.features, "r+") as file:
        for name in OURS:
            change(file[name])
    for stage, run in stages.by_name.items():
        if stage not in refusing:
            run(scene.features, stages.matches)
            continue
        with pytest.raises(InputError) as error:
            run(scene.features, stages.matches)
        message = str(error.value)
        assert str(scene.features) in message, (stage, message)
        # of a root group "db" with a data set it is not clear which image it is
        assert any(name in message for name in OURS) or kind == "a data set", (stage, message)


def first_match(value):
    def change(matches0):
        matches0[np.flatnonzero(matches0 >= 0)[0]] = value
        return matches0

    return change


# a change of the matches of a pair -> the stages that refuse it
MATCHES = {
    "floats, no longer than needed": (  # as of hloc's match_dense
        into("matches0", lambda m: m[: np.flatnonzero(m >= 0)[-1] + 1].astype(float)),
        (),
        "matching_scores0",
    ),
    "no matches0": (into("matches0", lambda _: None), ("map", "localize"), None),
    "no scores": (into("matching_scores0", lambda _: None), (), None),
    "scores of another length": (
        into("matching_scores0", lambda s: s[:-1]),
        ("map", "localize"),
        None,
    ),
    "scores of NaN": (into("matching_scores0", lambda s: s * np.nan), ("map", "localize"), None),
    "too long": (
        into("matches0", lambda m: np.append(m, 0)),
        ("map", "localize"),
        "matching_scores0",
    ),
    "too large": (into("matches0", first_match(300)), ("map", "localize"), None),
    "negative": (into("matches0", first_match(-2)), ("map", "localize"), None),
    "two columns": (into("matches0", lambda m: np.stack([m, m], 1)), ("map", "localize"), None),
    "one number": (into("matches0", lambda _: 7), ("map", "localize"), None),
    "text": (into("matches0", lambda _: "none"), ("map", "localize"), None),
    "in a group": (as_group("matches0"), ("map", "localize"), None),
    "a data set": (as_data_set, ("map", "localize"), None),
}


@pytest.mark.parametrize("kind", MATCHES)
def test_matches_of_other_tools(kind, stages):
    change, refusing, drop = MATCHES[kind]
    with h5py.File(stages.matches, "r+") as file:
        for name0, name1 in (("db/0.jpg", "db/1.jpg"), ("query/6.jpg", "db/0.jpg")):
            group = file[names_to_pair(name0, name1)]
            change(group)
            if drop:
                del group[drop]
    for stage in ("map", "localize"):
        if stage not in refusing:
            stages.by_name[stage](stages.sound, stages.matches)
            continue
        with pytest.raises(InputError) as error:
            stages.by_name[stage](stages.sound, stages.matches)
        message = str(error.value).replace("-", "/")
        assert str(stages.matches) in str(error.value), message
        assert "db/0.jpg" in message, message


def test_scores_are_needed_for_a_least_score_only(scene, stages):
    with h5py.File(stages.matches, "r+") as file:
        del file[f"{names_to_pair('db/0.jpg', 'db/1.jpg')}/matching_scores0"]
    with pytest.raises(InputError, match="matches.h5: the pair db/0.jpg, db/1.jpg has no scores"):
        triangulation.main(
            *(scene.root / "other", scene.model, scene.images, stages.pairs),
            *(stages.sound, stages.matches),
            min_match_score=0.5,
        )


@pytest.mark.parametrize("value", [None, 3.0, "none", np.zeros(0), np.full(9, np.nan), np.eye(9)])
def test_global_descriptors_of_other_tools(value, tmp_path):
    path, output = tmp_path / "global.h5", tmp_path / "pairs.txt"
    with h5py.File(path, "w") as file:
        file["version"] = 1  # at the root, where no image is
        for name in "abc":
            file[f"{name}.jpg/global_descriptor"] = np.eye(9)[ord(name) - ord("a")]
    pairs_from_retrieval.main(path, output, 2)
    with h5py.File(path, "r+") as file:
        put(file["a.jpg"], "note", 3)
        put(file["a.jpg"], "global_descriptor", value)
    with pytest.raises(InputError, match="global.h5.*a.jpg"):
        pairs_from_retrieval.main(path, output, 2)


def test_damaged_data_are_named(scene):
    """A file whose structure is whole but some numbers of which cannot be read."""
    with h5py.File(scene.features, "r+") as file:
        group = file["db/0.jpg"]
        for key in ("keypoints", "descriptors"):
            numbers = group[key][()]
            del group[key]
            group.create_dataset(key, data=numbers, chunks=numbers.shape, compression="gzip")
        offsets = [group[key].id.get_chunk_info(0) for key in ("keypoints", "descriptors")]
    with scene.features.open("r+b") as file:
        for chunk in offsets:
            file.seek(chunk.byte_offset)
            file.write(bytes(chunk.size))
    with open_h5(scene.features) as file:
        for read in (get_keypoints, get_descriptors):
            with pytest.raises(InputError, match="features.h5: .*db/0.jpg cannot be read"):
                read(file, "db/0.jpg")


def write_features(path):
    """Write a feature file: floats, bytes and an image that could not be read."""
    generator = np.random.default_rng(0)
    with GroupWriter(path, {}) as writer:
        for name, kind in (("db/0.jpg", "float16"), ("db/1.jpg", "uint8"), ("db/2.jpg", "float32")):
            features = {
                "keypoints": generator.uniform(0, 99, (20, 2)).astype(np.float32),
                "descriptors": generator.standard_normal((8, 20)).astype(np.float32),
                "image_size": np.array([100, 100]),
            }
            arrays, attrs = store(features, kind)
            attrs["keypoints"] = {"uncertainty": 1.0}
            failed = {"": {group_writer.FAILURE: "no image"}} if kind == "float32" else {}
            writer.add(name, arrays, attrs | failed)


def read_features(path):
    group_writer.failures(path)
    with open_h5(path) as file:
        file_provenance(file)
        for name in list_h5_names(path):
            get_keypoints(file, name)
            get_image_size(file, name)
            get_descriptors(file, name)


def write_matches(path):
    generator = np.random.default_rng(0)
    with GroupWriter(path, {}, compression="gzip") as writer:
        for name in ("db/0.jpg", "db/1.jpg"):
            arrays = {
                "matches0": generator.integers(-1, 20, 20).astype(np.int32),
                "matching_scores0": generator.random(20).astype(np.float16),
            }
            writer.add(names_to_pair("q.jpg", name), arrays)


def read_matches(path):
    GroupWriter(path, {})
    with open_h5(path) as file:
        for name in ("db/0.jpg", "db/1.jpg"):
            get_matches(file, "q.jpg", name, (20, 20))


@pytest.mark.parametrize("old_format", [False, True])  # h5py's default, which hloc's files have
@pytest.mark.parametrize(
    "write, read", [(write_features, read_features), (write_matches, read_matches)]
)
def test_damaged_h5_files_are_read_or_refused(write, read, old_format, tmp_path):
    path = tmp_path / "damaged.h5"
    write(path)
    if old_format:
        with h5py.File(path) as file, h5py.File(tmp_path / "old.h5", "w") as old:
            for name in file:
                file.copy(name, old)
        path = tmp_path / "old.h5"
    content, generator = path.read_bytes(), np.random.default_rng(0)
    read(path)
    for _ in range(300):
        damaged = np.frombuffer(content, np.uint8).copy()
        start, number = generator.integers(len(content)), generator.choice([1, 4, 64, 512])
        match generator.integers(4):
            case 0:
                damaged[start] ^= 1 << generator.integers(8)
            case 1:
                damaged[start : start + number] = 0
            case 2:
                damaged[start : start + number] = 255
            case 3:
                damaged = damaged[:start]
        path.write_bytes(damaged.tobytes())
        refuses_or_reads(read, path)


def test_a_damaged_h5_file_is_not_blamed_for_a_bug(scene):
    with pytest.raises(KeyError, match="no_such"), open_h5(scene.features) as file:
        file["no_such"]
    with pytest.raises(ZeroDivisionError), open_h5(scene.features):
        1 / 0  # noqa: B018


# ------------------------------------------------------------------------------ names

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
    with pytest.raises(InputError, match="model is not a COLMAP model"):
        colmap.read_model(model)


def test_names_of_any_kind_of_letters_and_dots_are_localized(plane):
    """The same letter in both of Unicode's forms makes two names, as it does on a disk."""
    reference = pycolmap.Reconstruction(plane / "model")
    renamed = ["caf\u00e9.png", "cafe\u0301.png", "dir.v2/a..b.png", "\u6771/.hidden.png"]
    query = "q\\..\\\U0001f5fc.png"
    for image, name in zip(
        sorted(reference.images.values(), key=lambda image: image.name),
        [*renamed, query],
        strict=True,
    ):
        (plane / "images" / name).parent.mkdir(exist_ok=True)
        (plane / "images" / image.name).rename(plane / "images" / name)
        image.name = name
    pose = reference.find_image_with_name(query).cam_from_world()
    reference.deregister_frame(reference.find_image_with_name(query).frame_id)
    reference.write(plane / "model")
    for name in ("rigs.bin", "frames.bin"):
        (plane / "model" / name).unlink()
    every, pairs, queries = (plane / f"{name}.txt" for name in ("every", "pairs", "queries"))
    parsers.write_pairs([(query, name) for name in renamed], pairs)
    camera = next(iter(reference.cameras.values()))
    intrinsics.write_queries({query: (camera, "list")}, queries)
    assert parsers.parse_query_list(queries)[0][0] == query
    conf = features_confs.confs["colmap_sift"]
    features = extract_features.main(conf, plane / "images", plane)
    assert sorted(list_h5_names(features)) == sorted([*renamed, query])
    found = aggregate_features.main(aggregate_features.confs["vlad"], features, renamed)
    retrieved = pairs_from_retrieval.main(found, plane / "retrieved.txt", 4, query_list=[query])
    assert set(parsers.parse_retrieval(retrieved)[query]) == set(renamed)
    of_map = [(name, other) for i, name in enumerate(renamed) for other in renamed[:i]]
    parsers.write_pairs(of_map, plane / "map_pairs.txt")
    parsers.write_pairs(of_map + [(query, name) for name in renamed], every)
    matches = match_features.main(
        match_features.confs["NN-ratio"], every, features, matches=plane / "m.h5"
    )
    images, model = plane / "images", plane / "model"
    inputs = (plane / "map_pairs.txt", features, matches)
    triangulation.main(plane / "sfm", model, images, *inputs)
    results = plane / "poses.txt"
    found = localize_sfm.main(plane / "sfm", queries, pairs, features, matches, results)
    assert found[query]["localized"]
    ((name, estimate),) = parsers.parse_poses(results).items()
    assert name == query and pose_error(estimate, pose)[0] < 0.05


@pytest.mark.parametrize("written", ["localize", "match"])
def test_pairs_of_absent_images(written, scene, stages):
    """A retrieved image that is not in the map is left out, one without features is refused."""
    pairs = scene.root / "more.txt"
    if written == "match":
        pairs.write_text("db/0.jpg db/9.jpg\n")
        with pytest.raises(InputError, match="db/9.jpg is not in the file .*features.h5"):
            match_features.main(
                match_features.confs["NN-mutual"],
                pairs,
                scene.features,
                matches=scene.root / "m.h5",
            )
        return
    retrieval = (scene.root / "retrieval.txt").read_text()
    (scene.root / "retrieval.txt").write_text("query/6.jpg db/9.jpg\n" + retrieval)
    records = stages.by_name["localize"](scene.features, stages.matches)
    assert records["query/6.jpg"]["localized"] and records["query/6.jpg"]["db"] == "db/0.jpg"


def test_nothing_is_written_outside_the_folder_of_pictures(tmp_path):
    """Reports name pictures after queries, whose names may come from a file that was changed."""
    folder = tmp_path / "pictures"
    shown = {"label": "../../run", "jpeg": b""}
    queries = ["../../a.jpg", "/etc/x.jpg", "..", "a/b.jpg", "a\0b.jpg"]
    drawn = [{"query": name, "drawn": [{**shown, "jpeg": b"AAAA"}]} for name in queries]
    report._write_pictures(folder, {}, drawn)
    written = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert written and {path.parent for path in written} == {folder}


# ---------------------------------------------------------------------------- round trips

letters = st.text(st.characters(exclude_categories=["C", "Z"], exclude_characters="/"), min_size=1)
some_names = st.lists(
    st.lists(letters, min_size=1, max_size=3)
    .map("/".join)
    .filter(lambda name: parsers._NAME.fullmatch(name)),
    min_size=1,
    max_size=5,
    unique=True,
)


@fuzzed
@given(names=some_names)
def test_names_of_lists_round_trip(tmp_path, names):
    path = tmp_path / "list.txt"
    path.write_text("\n".join(names), encoding="utf-8")
    assert parsers.parse_image_list(path) == names
    pairs = [(name, other) for name in names for other in names]
    assert parsers.write_pairs(pairs, path) == len(pairs)
    assert list(parsers.parse_pairs(path)) == pairs
    pose = pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array([1.0, -2e-9, 3e9]))
    parsers.write_poses(dict.fromkeys(names, pose), path, name_parts=None)
    read = parsers.parse_poses(path)
    assert list(read) == names
    assert all((found.translation == pose.translation).all() for found in read.values())


@fuzzed
@given(
    name=some_names.map(min),
    model=st.sampled_from(parsers.CAMERA_MODELS),
    size=st.tuples(st.integers(1, 10**6), st.integers(1, 10**6)),
    seed=st.integers(0, 2**32 - 1),
)
def test_queries_round_trip(tmp_path, name, model, size, seed):
    path = tmp_path / "queries.txt"
    camera = pycolmap.Camera.create_from_model_name(1, model, 500.0, *size)
    camera.params = camera.params * np.random.default_rng(seed).uniform(0.5, 2, len(camera.params))
    intrinsics.write_queries({name: (camera, "guess")}, path)
    ((read_name, read),) = parsers.parse_query_list(path)
    assert read_name == name and read.model == camera.model
    assert (read.width, read.height) == size and (read.params == camera.params).all()


@fuzzed
@given(
    rows=st.lists(
        st.tuples(st.sampled_from(["i_a", "v,b"]), st.integers(0, 1)), min_size=1, max_size=9
    )
)
def test_lists_of_hpatches_round_trip(tmp_path, rows):
    path = tmp_path / "list.csv"
    lists._write(rows, lists.PATCH_COLUMNS, path)
    assert lists._read(path, lists.PATCH_COLUMNS, {"i_a": 2, "v,b": 2}) == rows


def test_lists_are_utf8_whatever_the_locale(tmp_path):
    code = (
        "import sys; from pathlib import Path; from pycolmap import Camera, Rigid3d; "
        "from hloc_reduce.localization import intrinsics; "
        "from hloc_reduce.utils import files, parsers; "
        "name = '\\xe9\\u6771.jpg'; "
        "folder = Path(sys.argv[1]); "
        "camera = Camera(model='SIMPLE_PINHOLE', width=9, height=9, params=[9, 4, 4]); "
        "parsers.write_poses({name: Rigid3d()}, folder / 'poses.txt'); "
        "intrinsics.write_queries({name: (camera, 'list')}, folder / 'queries.txt'); "
        "files.write_csv([{'query': name}], folder / 'queries.csv')"
    )
    environment = {**os.environ, "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0", "LC_ALL": "C"}
    subprocess.run([sys.executable, "-c", code, str(tmp_path)], env=environment, check=True)
    assert list(parsers.parse_poses(tmp_path / "poses.txt")) == ["\xe9\u6771.jpg"]
    assert parsers.parse_query_list(tmp_path / "queries.txt")[0][0] == "\xe9\u6771.jpg"
    assert (tmp_path / "queries.csv").read_text(encoding="utf-8").split()[1] == "\xe9\u6771.jpg"


# ------------------------------------------------------------------- projections, vocabularies


class Harm:
    """Makes a folder when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return type(self.path).mkdir, (self.path,)


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    """Files of weights, one of each kind, and what reads them."""
    folder = tmp_path_factory.mktemp("weights")
    torch.manual_seed(0)
    mlp = network.MLP((8, 6, 4))
    network.save(mlp, {"descriptor": "sift", "scheme": "sv"}, folder / "p.safetensors")
    torch.save(
        {f"module.{key}": value for key, value in mlp.state_dict().items()}, folder / "p.pth"
    )
    save_file({"vocabulary": torch.randn(4, 8)}, folder / "v.safetensors")
    kinds = {
        "p.safetensors": projections.load,
        "p.pth": projections.load,
        "v.safetensors": read_vocabulary,
    }
    return {name: ((folder / name).read_bytes(), read) for name, read in kinds.items()}


@pytest.mark.parametrize("name", ["p.safetensors", "p.pth", "v.safetensors"])
@fuzzed
@given(data=st.data())
def test_damaged_weights_are_read_or_refused(name, weights, tmp_path, data):
    content, read = weights[name]
    path = tmp_path / name
    path.write_bytes(content)
    read(path)
    start = data.draw(st.integers(0, len(content) - 1) | st.integers(0, 300))
    piece = data.draw(st.binary(max_size=9))
    end = data.draw(st.sampled_from([start, start + len(piece), len(content)]))
    path.write_bytes(content[:start] + piece + content[end:])
    refuses_or_reads(read, path)


METADATA = [
    *(
        '"[8, 6, 4]"',
        "8",
        "null",
        "[]",
        "[8]",
        "[8, 4]",
        "[8, 6, 6, 4]",
        "[8, -6, 4]",
        "[8, .5, 4]",
    ),
    *("[8, 1000000000000, 4]", "[8, 3000000000, 4]", "[[8], 6, 4]", '["8", 6, 4]', "[8, null, 4]"),
    *("[true, 6, 4]", '{"8": 6}', "NaN", "[8, Infinity, 4]", "[8, 6, 4", "", "[" * 10**5),
]


@pytest.mark.parametrize("layers", [*METADATA, None])
def test_projections_of_other_layers_than_they_say_are_refused(layers, weights, tmp_path):
    path = tmp_path / "p.safetensors"
    tensors = load(weights[path.name][0])
    save_file(tensors, path, {} if layers is None else {"layers": layers})
    with pytest.raises(InputError, match="p.safetensors is not a projection"):
        projections.load(path)


def test_projections_whose_tensors_are_wrong_are_refused(weights, tmp_path):
    path = tmp_path / "p.safetensors"
    sound = load(weights[path.name][0])
    for key, tensor in sound.items():
        for wrong in (
            None,
            tensor[:-1],
            tensor[None],
            tensor.flatten()[:1],
            torch.full_like(tensor, torch.nan),
            torch.full_like(tensor, -torch.inf),
            torch.zeros(0),
        ):
            tensors = {**sound, key: wrong}
            if wrong is None:
                del tensors[key]
            save_file(tensors, path, {"layers": "[8, 6, 4]"})
            with pytest.raises(InputError, match="p.safetensors is not a projection"):
                projections.load(path)
    negative = {**sound, "norms.0.running_var": -torch.ones(6)}
    save_file(negative, path, {"layers": "[8, 6, 4]"})
    with pytest.raises(InputError, match="not a projection"):
        projections.load(path)


@pytest.mark.parametrize("shape", [(4,), (0, 8), (1, 2, 3), (2, 2)])
def test_what_is_no_vocabulary_is_refused(shape, tmp_path):
    path = tmp_path / "v.safetensors"
    save_file({"vocabulary": torch.full(shape, np.nan if shape == (2, 2) else 1)}, path)
    with pytest.raises(InputError, match="v.safetensors is not a vocabulary"):
        read_vocabulary(path)
    save_file({"words": torch.zeros(2, 2)}, path)
    with pytest.raises(InputError, match="v.safetensors is not a vocabulary"):
        read_vocabulary(path)


@pytest.mark.parametrize("protocol", [0, 2, 4])
@pytest.mark.parametrize("zipped", [True, False])
def test_no_code_of_weights_is_run(protocol, zipped, tmp_path):
    harmed = tmp_path / "harmed"
    for name in ("p.pth", "p.safetensors", "v.safetensors"):
        path = tmp_path / name
        torch.save(
            {"linears.0.weight": Harm(harmed)},
            path,
            pickle_protocol=protocol,
            _use_new_zipfile_serialization=zipped,
        )
        for content in (path.read_bytes(), pickle.dumps(Harm(harmed), protocol)):
            path.write_bytes(content)
            with pytest.raises(InputError, match=name):
                (read_vocabulary if name[0] == "v" else projections.load)(path)
    assert not harmed.exists()


@pytest.mark.parametrize("tag", ["object/apply:os.mkdir", "object/new:os.mkdir", "name:os.mkdir"])
def test_no_code_of_features_is_run(tag, tmp_path):
    path = tmp_path / "f.yaml"
    path.write_text(f"model: {{name: !!python/{tag} ['{tmp_path / 'harmed'}']}}\n")
    with pytest.raises(InputError, match="f.yaml cannot be read"):
        features_confs.read(path)
    assert not (tmp_path / "harmed").exists()


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
