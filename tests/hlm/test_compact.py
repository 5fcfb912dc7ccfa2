"""Compact maps: one file to localize in."""

import shutil

import command
import numpy as np
import pycolmap
import pytest
from command import outcome
from compact_files import LIES, change, use

from hloc_reduce import Localizer, aggregate_features, compact, maps, projections
from hloc_reduce.confs import features as features_confs
from hloc_reduce.evaluation.poses import pose_error
from hloc_reduce.hlm import points
from hloc_reduce.hlm.reader import CompactMap
from hloc_reduce.mapping.checks import focal_lengths
from hloc_reduce.maps.unpack import COMPACT
from hloc_reduce.retrieval.ranking import read_global
from hloc_reduce.retrieval.vlad import VOCABULARY, read_vocabulary
from hloc_reduce.runtime import provenance
from hloc_reduce.runtime.outputs import CONF, DELETING
from hloc_reduce.utils import colmap, parsers
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.files import file_sha256
from pipelines import localize

PIPELINE = localize


@pytest.fixture
def built(place, build_map):
    """The map of the plane, and its photos."""
    return build_map("--feature", "colmap_sift_sv32"), place[1]


def test_a_file_localizes_as_its_map(built, tmp_path, run):
    """In memory and through the pipeline, which unpacks it; the same bytes every time."""
    folder, images = built
    file = tmp_path / "place.hlm"
    parts = compact.main(file, folder)
    content = file.read_bytes()
    assert sum(parts.values()) == len(content)
    assert content != b"" and compact.main(file, folder) == parts and file.read_bytes() == content
    photo = images / "query/day/a.png"
    expected, info = Localizer(folder).localize(photo)
    pose, found = Localizer(file).localize(photo)
    assert max(pose_error(pose, expected)) < 0.02
    assert found["num_inliers"] > 0.7 * info["num_inliers"] and found["reason"] is None
    [lens] = maps.Map(folder).cameras.typical.values()
    for one in (info, found):  # no list has its intrinsics, but the map's photos have its size
        assert one["intrinsics"] == "guess"
        assert one["camera"].params[0] == lens.focal_length * 360
        assert one["camera"].params[3] == lens.distortion

    outputs = tmp_path / "of_file"
    new = ("--map", file, "--query_images", images / "query/day", "--outputs", outputs)
    run(*new)
    summary, rows = outcome(outputs / "queries-day")
    assert rows["a.png"]["status"] == "localized" and rows["grey.png"]["status"] == "fallback"
    poses = parsers.parse_poses(outputs / "queries-day" / summary["poses"])
    assert max(pose_error(poses["a.png"], pose)) < 1e-3
    assert int(rows["a.png"]["num_inliers"]) == found["num_inliers"]
    unpacked = maps.Map(outputs / "map")
    assert unpacked.feature == "colmap_sift_sv32" and unpacked.storage == "uint4"
    assert unpacked.cameras == maps.Map(folder).cameras
    model = pycolmap.Reconstruction(unpacked.sfm)
    assert model.compute_mean_reprojection_error() < 0.01
    again = (outputs / "map/map.json").stat().st_mtime_ns
    run(*new)
    assert (outputs / "map/map.json").stat().st_mtime_ns == again


@pytest.mark.parametrize("storage", ["float16", "float32", "uint8"])
def test_descriptors_that_are_not_coded_are_those_of_the_points(storage, built, tmp_path):
    folder, _ = built
    known = maps.Map(folder)
    compact.main(tmp_path / "place.hlm", folder, storage=storage)
    found = CompactMap(tmp_path / "place.hlm")
    everything = points.collect(colmap.read_model(known.sfm), known.features)
    expected = points.Sorted(everything).descriptors(slice(None))
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    described = found.descriptors(np.arange(len(expected)))
    described /= np.linalg.norm(described, axis=1, keepdims=True)
    assert (described * expected).sum(axis=1).min() > 0.999


def test_doubts_of_a_map_go_into_its_file(built, tmp_path, run, caplog):
    folder, images = built
    doubtful = focal_lengths.finding(1.36).to_json()
    content = provenance.read(folder / "map.json")
    provenance.write(folder / "map.json", content | {"findings": [doubtful]})
    compact.main(tmp_path / "place.hlm", folder)
    outputs = tmp_path / "of_file"
    new = ("--query_images", images / "query/day", "--outputs", outputs)
    for of_map in (folder, tmp_path / "place.hlm"):
        [doubt] = Localizer(of_map).localize(images / "query/day/a.png")[1]["map_doubts"]
        assert "differ by a factor of 1.36" in doubt
    caplog.clear()
    run("--map", tmp_path / "place.hlm", *new)
    [doubt] = outcome(outputs / "queries-day")[0]["map_doubts"]
    assert "differ by a factor of 1.36" in doubt and f"it has {doubt}" in caplog.text


def test_a_limit_is_met_although_the_first_points_take_most(monkeypatch):
    """As in large maps, where many images show those that are selected first."""

    written = []

    def encode(number):
        seen = int(200 * number**0.7)
        parts = {"coordinates": 6 * number, "descriptors": 8 * number, "visible": seen}
        written.append(number)
        return parts | {"header": 200_000}

    for limit in (0.21, 0.3, 1.0, 5.0):
        number, parts = compact._fit(encode, 1_000_000, 1e6 * limit)
        assert 0.9 * limit < sum(parts.values()) / 1e6 <= limit
        assert number == written[-1] and parts == encode(number)
    with pytest.raises(InputError, match="too small"):
        compact._fit(encode, 1_000_000, 0.2e6)


def test_codes_of_a_projection_of_ones_own(built, tmp_path):
    """The file brings it along; descriptors are those of the points that an image shows."""
    folder, images = built
    own = tmp_path / "my_sv32.safetensors"
    own.write_bytes(projections.find("colmap_sift_sv32").read_bytes() + b"")
    other = maps.main(tmp_path / "own", images, maps.Map(folder).sfm, "colmap_sift", own)
    compact.main(tmp_path / "own.hlm", other.folder, storage="uint2")
    expected, _ = Localizer(tmp_path / "own/").localize(images / "query/day/a.png")
    shutil.rmtree(tmp_path / "own")
    own.unlink()
    localizer = Localizer(tmp_path / "own.hlm")
    pose, _ = localizer.localize(images / "query/day/a.png")
    assert max(pose_error(pose, expected)) < 0.2
    assert localizer.reference.descriptors(np.arange(5)).shape == (5, 32)


def test_a_limit_of_the_size(built, tmp_path):
    folder, images = built
    whole, half = tmp_path / "whole.hlm", tmp_path / "half.hlm"
    compact.main(whole, folder)
    limit = 0.6 * whole.stat().st_size
    compact.main(half, folder, max_mb=limit / 1e6)
    assert 0.9 * limit < half.stat().st_size <= limit
    pose, _ = Localizer(half).localize(images / "query/day/a.png")
    expected, _ = Localizer(whole).localize(images / "query/day/a.png")
    assert max(pose_error(pose, expected)) < 0.2
    found, everything = CompactMap(half), CompactMap(whole)
    assert len(found.names) == 1 and {*found.names} < {*everything.names}  # all show the plane
    assert found.vocabulary.shape == (2, 32) and everything.vocabulary.shape == (64, 32)
    assert found.global_descriptors().shape == (1, 64)
    compact.main(half, folder, max_mb=whole.stat().st_size / 1e6)
    assert half.read_bytes() == whole.read_bytes()
    for too_small in (1e-4, 1e-6):
        with pytest.raises(InputError, match="too small"):
            compact.main(tmp_path / "none.hlm", folder, max_mb=too_small)
    assert not (tmp_path / "none.hlm").exists()


def test_files_of_stages(built, tmp_path):
    """A model and a feature file, as hloc's pipelines leave them, make the same map."""
    folder, images = built
    known = maps.Map(folder)
    parts = compact.main(
        tmp_path / "a.hlm", sfm=known.sfm, features=known.features, feature="colmap_sift_sv32"
    )
    expected = compact.main(tmp_path / "b.hlm", folder)
    assert {**parts, "header": 0} == {**expected, "header": 0}
    with pytest.raises(InputError, match="Give --map, or"):
        compact.main(tmp_path / "a.hlm", sfm=known.sfm)
    with pytest.raises(
        InputError, match="has 32 numbers a descriptor, but colmap_sift_sv64 has 64"
    ):
        other = maps.Map(folder).features
        compact.main(tmp_path / "a.hlm", sfm=known.sfm, features=other, feature="colmap_sift_sv64")


def test_global_descriptors_of_another_file(built, tmp_path, monkeypatch):
    """The file has these, and the vocabulary beside them."""
    known = maps.Map(built[0])
    conf, images = aggregate_features.confs["vlad"], known.names()[:1]
    small = {**conf, "model": {**conf["model"], "num_words": 3}}
    other = aggregate_features.main(small, known.features, images, tmp_path / "elsewhere")
    output = tmp_path / "a.hlm"
    given = ("--sfm", known.sfm, "--features", known.features, "--feature", "colmap_sift_sv32")
    given = (*given, "--global_descriptors", other, "--output", output)
    command.run(monkeypatch, compact, *given)
    found = CompactMap(output)
    expected = read_vocabulary(aggregate_features.vocabulary_of(other))
    np.testing.assert_allclose(found.vocabulary, expected, rtol=1e-3, atol=1e-6)
    whole = read_global(other, found.names)
    assert whole.shape == (4, 96) and (found.global_descriptors() * whole).sum(axis=1).min() > 0.6
    aggregate_features.vocabulary_of(other).unlink()
    with pytest.raises(InputError, match="is not a vocabulary"):
        compact.main(
            output,
            sfm=known.sfm,
            features=known.features,
            feature="colmap_sift_sv32",
            global_descriptors=other,
        )


def test_the_vocabulary_that_ships_is_named(place, build_map, tmp_path):
    """A file is refused where another one ships."""
    _, images, _ = place
    known = maps.Map(build_map())
    assert known.feature == "colmap_sift_sv64"
    descriptors = aggregate_features.main(
        aggregate_features.confs["vlad"],
        known.features,
        export_dir=tmp_path / "elsewhere",
        vocabulary=VOCABULARY,
    )
    shutil.copy(VOCABULARY, aggregate_features.vocabulary_of(descriptors))
    path = tmp_path / "a.hlm"
    given = {"sfm": known.sfm, "features": known.features, "feature": "colmap_sift_sv64"}
    assert "vocabulary" not in compact.main(path, global_descriptors=descriptors, **given)
    np.testing.assert_array_equal(CompactMap(path).vocabulary, read_vocabulary())
    assert Localizer(path).localize(images / "query/day/a.png")[0] is not None
    content, checksum = path.read_bytes(), file_sha256(VOCABULARY).encode()
    assert content.count(checksum) == 1
    path.write_bytes(content.replace(checksum, checksum[::-1]))
    with pytest.raises(InputError, match="a.hlm needs another vocabulary than the one that ships"):
        CompactMap(path)


@pytest.fixture(scope="module")
def packed() -> list[bytes]:
    return []


@pytest.fixture
def file(packed, request, tmp_path):
    """The compact map of the plane, which only the first test builds."""
    path = tmp_path / "place.hlm"
    if not packed:
        compact.main(path, request.getfixturevalue("built")[0])
        packed.append(path.read_bytes())
    path.write_bytes(packed[0])
    return path


def test_truncated_anywhere(file):
    content = file.read_bytes()
    for size in (0, 7, 8, 100, len(content) // 2, len(content) - 1):
        file.write_bytes(content[:size])
        with pytest.raises(InputError, match="is not a compact map, or broken") as error:
            CompactMap(file)
        assert str(error.value).count("\n") == 0
    file.unlink()
    with pytest.raises(InputError, match="There is no map"):
        CompactMap(file)


REDUCED = {"name": "reduced", "base": {"name": "dog", "descriptor": "colmap_sift"}}
REDUCED["projection"] = "colmap_sift_sv32"


def names_of(*lines):
    """Return packed names of a block, each in full."""
    text = b"".join(b"\0" + line + b"\n" for line in lines)
    return lambda _: np.frombuffer(bytes(4) + text, np.uint8)


@pytest.mark.parametrize(
    "name, value, metadata",
    [
        *LIES,
        ("cameras", lambda a: a[:, :-1], {}),
        ("cameras", np.zeros_like, {}),
        (None, None, {"global_dim": 10**10}),
        (None, None, {"global_dim": -1}),
        (None, None, {"matcher": "none"}),
        (None, None, {"conf": {}}),
        (None, None, {"conf": None}),
        (None, None, {"conf": {"model": {"name": "hloc", "conf": {"name": "d2net"}}}}),
        (None, None, {"conf": {"model": {"name": "mini", "weights": "/etc/passwd"}}}),
        (None, None, {"conf": {"model": {**REDUCED, "projection": "/etc/x.safetensors"}}}),
        (None, None, {"conf": {"model": {**REDUCED, "projection": "../../x"}}}),
        (None, None, {"conf": {"model": {**REDUCED, "base": 5}}}),
        (None, None, {"conf": {"model": REDUCED, "preprocessing": {"resize_max": 10**6}}}),
        (None, None, {"lenses": [["NONE", 1, 1]]}),
        (None, None, {"lenses": [["PINHOLE", 9, 9, float("nan"), 1, 1, 1]]}),
        (None, None, {"cameras": {"a": ["PINHOLE", 9, 9, 1]}}),
        (None, None, {"typical": [[9, 9, float("nan"), 0]]}),
        (None, None, {"typical": 5}),
        (None, None, {"shipped": 0}),
        (None, None, {"feature": "a\0b"}),
        ("vocabulary", lambda a: a * np.float16(np.nan), {}),
        ("vocabulary", lambda a: a[:, :-1], {}),
        ("names", names_of(b"a", b"a/b", b"c", b"d"), {}),
        ("names", names_of(b"a", b"a", b"c", b"d"), {}),
        ("names", names_of(b"b", b"a", b"c", b"d"), {}),
        ("names", names_of(b"/a", b"b", b"c", b"d"), {}),
        ("names", names_of(b"a", b"b", b"c", b"\xff"), {}),
        ("names", names_of(b"a", b"b", b"c"), {}),
        (None, None, {"shipped": {"projection": "0"}}),
    ],
)
def test_hostile_files(file, name, value, metadata):
    """They are refused when they are opened, or when what is wrong is used."""
    change(file, name, value, **metadata)
    with pytest.raises(InputError) as error:
        use(file)
    assert str(error.value).count("\n") < 2


def test_a_file_writes_nothing_elsewhere(file, tmp_path):
    """Whatever it says of names of files."""
    conf = {key: CompactMap(file).conf[key] for key in ("model", "preprocessing")}
    change(file, None, conf={**conf, "output": "../../evil"}, feature="../evil")
    built = maps.unpack(file, tmp_path / "a/b/map")
    assert {path.name for path in (tmp_path / "a").iterdir()} == {"b"}
    assert {path.name for path in (tmp_path / "a/b").iterdir()} == {"map"}
    assert built.features.name == "feats-evil.h5" and not list(tmp_path.glob("*evil*"))


def test_an_overwriting_that_was_interrupted_goes_on(file, tmp_path):
    folder = tmp_path / "map"
    names = maps.unpack(file, folder).names()
    provenance.write(folder / CONF, DELETING)
    assert maps.unpack(file, folder).names() == names
    assert provenance.read(folder / CONF).keys() == {COMPACT}


@pytest.mark.parametrize(
    "feature, storage",
    [
        ("colmap_sift_sv32", "uint4"),
        ("colmap_sift_sv64", "uint2"),
        ("xfeat_sv16", "uint2"),
        ("xfeat", "uint2"),
        ("edgepoint2_l32", "float16"),  # no levels ship
        ("sift_nested@24", "uint4"),
    ],
)
def test_the_default_storage_depends_on_the_feature(feature, storage):
    conf = features_confs.get(feature)[1]
    assert compact._storage(conf, None) == storage
    assert compact._storage({**conf, "storage": "uint8"}, None) == "uint8"


def test_bad_arguments(built, tmp_path, refused, place):
    folder, images = built
    for output, options, message in (
        (tmp_path / "a.zip", {}, "must end in .hlm"),
        (tmp_path / "a.hlm", {"max_mb": -1.0}, "must be above 0"),
        (tmp_path / "a.hlm", {"storage": "uint3"}, "Unknown storage"),
        (tmp_path / "a.hlm", {"matcher": "best"}, "Unknown matcher"),
    ):
        with pytest.raises(InputError, match=message):
            compact.main(output, folder, **options)
    file = tmp_path / "a.hlm"
    compact.main(file, folder)
    new = ("--map", file, "--query_images", images / "query/day", "--outputs", tmp_path / "of_file")
    assert "--feature colmap_sift_sv32" in refused(*new, "--feature", "sift_sv64")
    assert "built with --storage uint4" in refused(*new, "--storage", "uint8")
    assert "leave out --map_images" in refused(*new, "--map_images", images)
