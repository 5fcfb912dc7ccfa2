"""Maps from photos alone: how many photos, which cameras, keypoints and pairs."""

import re
import shutil
from functools import partial
from itertools import pairwise

import cv2
import numpy as np
import pycolmap
import pytest
from alignment import similarity
from command import outcome, state
from conftest import FOCAL
from PIL import Image

from hloc_reduce import Localizer, maps, pairs_from_sequence
from hloc_reduce.confs import features as features_confs
from hloc_reduce.mapping import registration
from hloc_reduce.mapping.checks import intrinsics
from hloc_reduce.mapping.findings import names_in
from hloc_reduce.utils import colmap, parsers
from pipelines import localize

PIPELINE = localize
PAIRS = ("--pairs", "sequential")


def draw_noise(folder, numbers, size=(270, 360)):
    """Write photos that match no other."""
    generator = np.random.default_rng(1)
    for number in numbers:
        noise = cv2.GaussianBlur(generator.standard_normal(size), (0, 0), 3)
        cv2.imwrite(str(folder / f"{number}.png"), 128 + 30 * noise / noise.std())


def test_photos_alone(plane, tmp_path, run):
    """A map without any model: what is localized in it has its frame and scale."""
    images = plane / "images"
    new = tmp_path / "new"
    new.mkdir()
    shutil.move(images / "4.png", new / "4.png")
    outputs = tmp_path / "outputs"
    given = ("--map_images", images, "--query_images", new, "--outputs", outputs)
    run(*given, "--camera_mode", "single")
    built = maps.Map(outputs / "map")
    summary, rows = outcome(outputs / "queries-new")
    assert summary["map_images"] == len(built.names()) == 4
    assert rows["4.png"]["status"] == "localized"
    poses = parsers.parse_poses(outputs / "queries-new" / summary["poses"])
    model = colmap.read_model(built.sfm)
    poses |= {image.name: image.cam_from_world() for image in model.images.values()}
    true = pycolmap.Reconstruction(plane / "model").images.values()
    centres = np.array([poses[image.name].inverse().translation for image in true])
    known = np.array([image.projection_center() for image in true])
    assert np.linalg.norm(similarity(centres, known), axis=1).max() < 0.02  # of 2.2


def test_fewer_than_half_of_the_photos(plane, tmp_path, monkeypatch, caplog, run, refused):
    """Are refused with their names, and accepted on demand without any work."""
    images, outputs = plane / "images", tmp_path / "outputs"
    draw_noise(images, range(5, 11), (135, 180))
    build = ("--map_images", images, "--outputs", outputs)
    message = refused(*build)
    assert "Only 5 of 11 photos are in the map. Missing: 10.png, 5.png, 6.png" in message
    assert "No other photo matches 10.png" in message and "retake blurred or dark photos" in message
    assert "--accept_partial" in message
    assert not (outputs / "map/map.json").exists()
    caplog.clear()
    monkeypatch.setattr(colmap, "incremental_mapping", None)
    run(*build, "--accept_partial")
    assert "Only 5 of 11 photos" in caplog.text
    built = maps.Map(outputs / "map")
    assert len(built.names()) == 5 and "fewer than half of its photos" in built.doubts
    run(*build)  # is accepted for good


def test_focal_lengths_that_differ(plane, tmp_path, monkeypatch, caplog, run, refused):
    """Those of photos of a plane are not determined, so the map is refused, or accepted."""
    build = ("--map_images", plane / "images", "--outputs", tmp_path / "outputs")
    message = refused(*build)
    assert "The map may be wrong" in message and "--camera_mode single" in message
    assert not (tmp_path / "outputs/map/map.json").exists()
    caplog.clear()
    monkeypatch.setattr(colmap, "incremental_mapping", None)
    run(*build, "--accept_partial")
    assert caplog.text.count("focal lengths differ by a factor") == 1
    [factor] = [
        one.values["factor"]
        for one in maps.Map(tmp_path / "outputs/map").findings
        if one.kind == "focal_lengths"
    ]
    assert factor > 1.2 and f"{factor:.2f}" in message
    run(*build)  # is accepted for good


def test_camera_modes(plane, tmp_path, caplog, run, refused):
    images, outputs = plane / "images", tmp_path / "outputs"
    build = ("--map_images", images, "--outputs", outputs)
    assert "Unknown camera mode 'one'" in refused(*build, "--camera_mode", "one")
    model = ("--map", plane / "model", "--camera_mode", "single")
    assert "photos alone" in refused(*build, *model)
    caplog.set_level("INFO")
    run(*build, "--camera_mode", "single")
    assert "so each has its own" not in caplog.text
    assert colmap.read_model(outputs / "map/sfm").num_cameras() == 1
    assert "--camera_mode single" in refused(*build)
    features = outputs / "map/feats-dog-colmap_sift_sv64.h5"
    before = features.stat().st_mtime_ns
    (outputs / "map/map.json").unlink()  # not finished: the features are kept
    many = "the positions of 3 of its 5 photos are uncertain by more than 5 %"
    assert many in refused(*build, "--camera_mode", "PER_IMAGE")
    run(*build, "--camera_mode", "PER_IMAGE", "--accept_partial")
    assert colmap.read_model(outputs / "map/sfm").num_cameras() == 5
    assert features.stat().st_mtime_ns == before


def files_of(folder, keypoints):
    """Return the files of a map that are of features with other keypoints than hloc's."""
    return sorted(folder.glob(f"*feats-dog-colmap_sift_sv64{keypoints}[._]*"))


def test_photos_are_missing_so_there_are_more_keypoints(plane, tmp_path, monkeypatch, caplog, run):
    """And queries get them, too; the map is the same command's."""
    caplog.set_level("INFO")
    reconstruct = maps.attempts.reconstruction.main

    def fails_once(*args, once, **options):
        if once:
            raise registration.NoModelError("COLMAP could not reconstruct the images.")
        return reconstruct(*args, once=once, **options)

    monkeypatch.setattr(maps.attempts.reconstruction, "main", fails_once)
    outputs = tmp_path / "outputs"
    build = ("--map_images", plane / "images", "--outputs", outputs, "--camera_mode", "single")
    run(*build)
    assert "0 of 5 photos are in the map." in caplog.text
    assert "Trying again with more keypoints." in caplog.text
    built = maps.Map(outputs / "map")
    assert len(built.names()) == 5 and built.keypoints == "adaptive"
    assert features_confs.keypoints_of(built.conf["model"]) == "colmap"
    assert len(files_of(built.folder, "-keypoints_colmap")) == 4
    assert not files_of(built.folder, "")
    assert [path.name for path in built.folder.glob("sfm*")] == ["sfm-keypoints_colmap"]
    # the next run deletes what a killed run left, but not the user's own files
    name = "feats-dog-colmap_sift_sv64"
    (built.folder / f"{name}.h5.pieces").mkdir()
    (built.folder / f"{name}_matches-NN-mutual-ratio.8_pairs-db-exhaustive.h5").touch()
    (built.folder / f"{name}.safetensors").touch()
    (built.folder / "sfm_notes.txt").touch()
    run(*build)
    assert [path.name for path in files_of(built.folder, "")] == [f"{name}.safetensors"]
    assert (built.folder / "sfm_notes.txt").exists()
    (built.folder / f"{name}.safetensors").unlink()
    written = state(built.folder)
    new = tmp_path / "new"
    new.mkdir()
    shutil.copy(plane / "images/0.png", new)
    run(*build, "--query_images", new, "--feature", "colmap_sift_sv64")
    assert state(built.folder) == written
    rows = outcome(outputs / "queries-new")[1]
    _, info = Localizer(built.folder).localize(plane / "images/0.png")
    assert rows["0.png"]["status"] == "localized" and info["reason"] is None
    assert float(rows["0.png"]["confidence"]) == info["confidence"]


def test_more_keypoints_that_do_not_help_are_dropped(plane, tmp_path, monkeypatch, caplog, run):
    """As is said of a photo that matches no other; most of them are a map."""
    caplog.set_level("INFO")
    draw_noise(plane / "images", ["other"])
    reconstruct = maps.attempts.reconstruction.main

    def fails_again(*args, once, **options):
        if once:
            return reconstruct(*args, once=once, **options)
        raise registration.NoModelError("COLMAP could not reconstruct the images.")

    monkeypatch.setattr(maps.attempts.reconstruction, "main", fails_again)
    outputs = tmp_path / "outputs"
    run("--map_images", plane / "images", "--outputs", outputs, "--accept_partial")
    assert caplog.text.count("5 of 6 photos are in the map.") == 3
    assert "1 of 6 images are not in the map: other.png." in caplog.text
    assert "What to try" not in caplog.text
    assert "Trying again with one camera" in caplog.text  # PNG files have no EXIF data
    built = maps.Map(outputs / "map")
    assert features_confs.keypoints_of(built.conf["model"]) == "adaptive"
    assert len(files_of(built.folder, "")) == 4
    assert not files_of(built.folder, "-keypoints_colmap")
    assert [path.name for path in built.folder.glob("sfm*")] == ["sfm"]


def sizes_of(pairs):
    """Return the numbers of pairs, first and after each round of more; none follows one without."""
    rounds = sorted(pairs.parent.glob(f"{pairs.stem}-*.txt"))
    sizes = [len({*parsers.parse_pairs(path)}) for path in (pairs, *rounds)]
    assert len(rounds) == 3 or sizes[-1] == sizes[-2]
    assert all(one < another for one, another in pairwise(sizes[:-1]))
    return sizes


def test_more_pairs_where_the_graph_falls_apart(plane, tmp_path, monkeypatch, run):
    """One retrieved photo each leaves two parts; all are in the map in the end."""
    monkeypatch.setattr(maps.pairing, "MAX_EXHAUSTIVE", 4)
    outputs = tmp_path / "outputs"
    build = ("--map_images", plane / "images", "--outputs", outputs, "--camera_mode", "single")
    build += ("--num_covis", 1)

    def apart(descriptors, output, num_matched):
        parsers.write_pairs([("0.png", "1.png"), ("1.png", "2.png"), ("3.png", "4.png")], output)

    monkeypatch.setattr(maps.pairing.pairs_from_retrieval, "main", apart)
    run(*build)
    built = maps.Map(outputs / "map")
    assert len(built.names()) == 5
    sizes = sizes_of(outputs / "map/pairs-db-1.txt")
    assert sizes[0] == 3 < sizes[1] and sizes == sorted(sizes)
    written = state(outputs / "map")
    (outputs / "map/map.json").unlink()
    run(*build)
    again = state(outputs / "map")
    assert all(again[path] == written[path] for path in written if path.suffix in (".h5", ".bin"))


def test_a_map_of_other_pairs_is_refused(plane, tmp_path, monkeypatch, run, refused):
    outputs = tmp_path / "outputs"
    build = ("--map_images", plane / "images", "--outputs", outputs, "--camera_mode", "single")
    run(*build)
    run(*build, "--num_covis", 3)  # of which all pairs know nothing
    assert len(list(parsers.parse_pairs(outputs / "map/pairs-db-exhaustive.txt"))) == 10
    monkeypatch.setattr(maps.pairing, "MAX_EXHAUSTIVE", 4)
    message = refused(*build)
    assert (
        re.search(r"differs: num_covis( \(.*\))? and pairs", message) and "--overwrite" in message
    )


def test_sequential_pairs(plane, tmp_path, monkeypatch, run, refused):
    """Neighbours and loop closures are matched, and where they leave parts, more pairs."""
    few = partial(pairs_from_sequence.main, num_matched=0, overlap=1)
    monkeypatch.setattr(maps.pairing.pairs_from_sequence, "main", few)
    outputs = tmp_path / "outputs"
    build = ("--map_images", plane / "images", "--outputs", outputs, "--camera_mode", "single")
    assert "Unknown kind of pairs 'all'" in refused(*build, "--pairs", "all")
    message = refused(*build[:4], *PAIRS, "--map", plane / "model")
    assert message == "--pairs is for maps of photos alone: leave it or --map out."
    assert not (outputs / "map").exists()
    run(*build, *PAIRS)
    built = maps.Map(outputs / "map")
    assert len(built.names()) == 5
    pairs = {*parsers.parse_pairs(outputs / "map/pairs-db-sequential.txt")}
    assert pairs == {(f"{i}.png", f"{i + 1}.png") for i in range(4)}
    assert {*parsers.parse_pairs(outputs / "map/pairs-db-sequential-1.txt")} > pairs
    assert sizes_of(outputs / "map/pairs-db-sequential.txt") == [4, 10, 10]
    written = state(outputs / "map")
    run(*build, *PAIRS)
    assert state(outputs / "map") == written
    message = refused(*build)
    assert "pairs (sequential, 3 rounds of verification before, exhaustive now)" in message
    assert "--pairs is for maps" in refused("--map", outputs / "map", *build[2:4], *PAIRS)


@pytest.mark.parametrize("named", [True, False])
def test_enlarged_photos_get_cameras_of_their_own(named, plane, tmp_path, monkeypatch, caplog, run):
    """Although EXIF data say that one camera took all photos; whichever they are, if not named."""
    caplog.set_level("INFO")
    measure = intrinsics.measure
    if not named:
        monkeypatch.setattr(intrinsics, "measure", lambda sfm: measure(sfm)._replace(altered=[]))
    images = tmp_path / "photos"
    images.mkdir()
    for number in range(5):
        photo = Image.open(plane / f"images/{number}.png").convert("RGB")
        width, height = photo.size
        if number == 3:  # its middle
            box = [round(share * side) for share in (0.1, 0.9) for side in photo.size]
            photo = photo.crop(box).resize((width, height), Image.Resampling.BICUBIC)
        exif = Image.Exif()
        exif[0x010F], exif[0x0110] = "Maker", "Model"
        exif.get_ifd(0x8769)[0xA405] = round(35 * FOCAL / max(photo.size))
        photo.save(images / f"{number}.jpg", quality=97, exif=exif)
    build = "--map_images", images, "--outputs", tmp_path / "outputs"
    run(
        *build, "--accept_partial"
    )  # their own cameras leave the positions of a flat scene uncertain
    built = maps.Map(tmp_path / "outputs/map")
    assert "Trying again with a camera for each photo." in caplog.text
    assert built.sfm.name == "sfm-per_image" and not names_in(built.findings, "intrinsics")
    assert not (built.folder / "sfm").exists()
    model = colmap.read_model(built.sfm)
    focal_lengths = {i.name: i.camera.mean_focal_length() for i in model.images.values()}
    assert focal_lengths["3.jpg"] > 1.15 * np.median(list(focal_lengths.values()))
    caplog.clear()
    run(*build)  # opens it
    assert "Trying again" not in caplog.text


def test_options_of_lenses(plane, tmp_path, monkeypatch, run, refused):
    """They reach the mapper, and wrong ones are told before any work is done."""
    images, outputs = plane / "images", tmp_path / "outputs"
    build = ("--map_images", images, "--outputs", outputs)
    assert "Unknown camera model 'FISH'" in refused(*build, "--camera_model", "FISH")
    fisheye = ("--camera_model", "OPENCV_FISHEYE", "--camera_params")
    assert "OPENCV_FISHEYE has 8, fx, fy" in refused(*build, *fisheye, "9,9")
    assert "Give --camera_model" in refused(*build, "--camera_params", "9,9")
    assert "photos alone" in refused(*build, *fisheye, "9,9", "--map", plane / "model")
    assert not outputs.exists()
    given = {}

    def stop(*_, **options):
        given.update(options["image_options"])
        raise registration.NoModelError("stopped")

    monkeypatch.setattr(maps.attempts.reconstruction, "main", stop)
    params = "375,375,180,135,0,0,0,0"
    assert "stopped" in refused(*build, *fisheye, params)
    assert given == {"camera_model": "OPENCV_FISHEYE", "camera_params": params}
