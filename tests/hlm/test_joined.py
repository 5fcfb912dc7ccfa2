"""Several compact maps as one, and whether a compact map is current."""

import shutil

import command
import numpy as np
import pycolmap
import pytest
from command import outcome
from compact_files import change, use

from hloc_reduce import Localizer, compact, maps
from hloc_reduce.compact.__main__ import _main
from hloc_reduce.evaluation.poses import pose_error
from hloc_reduce.hlm.joined import JoinedMap
from hloc_reduce.hlm.reader import CompactMap
from hloc_reduce.utils.cli import InputError
from pipelines import localize

PIPELINE = localize


@pytest.fixture
def built(place, build_map):
    """The map of the plane, and its photos."""
    return build_map("--feature", "colmap_sift_sv32"), place[1]


@pytest.fixture
def parts(built, tmp_path):
    """The map in two files, of two photos each."""
    names = maps.Map(built[0]).names()
    paths = []
    for i, some in enumerate((names[:2], names[2:])):
        (tmp_path / f"{i}.txt").write_text("\n".join(some))
        paths.append(tmp_path / f"part{i}.hlm")
        compact.main(paths[-1], built[0], image_list=tmp_path / f"{i}.txt")
    return paths


def test_parts_of_one_limit_are_joined_whether_it_limits_them_or_not(built, tmp_path):
    names, paths = maps.Map(built[0]).names(), []
    for i, some in enumerate((names[:1], names[1:])):
        (tmp_path / f"{i}.txt").write_text("\n".join(some))
        paths.append(tmp_path / f"part{i}.hlm")
    given = [(path, tmp_path / f"{i}.txt") for i, path in enumerate(paths)]
    sizes = [
        sum(compact.main(path, built[0], image_list=listed).values()) for path, listed in given
    ]
    assert sizes[0] < sizes[1]
    for path, listed in given:
        compact.main(path, built[0], image_list=listed, max_mb=sum(sizes) / 2e6)
    assert len(JoinedMap(paths).names) == len(names)


def test_parts_localize_as_the_whole_map(built, parts, tmp_path, run):
    folder, images = built
    compact.main(tmp_path / "whole.hlm", folder)
    photo = images / "query/day/a.png"
    expected, whole = Localizer(tmp_path / "whole.hlm").localize(photo)
    localizer = Localizer(parts)
    pose, info = localizer.localize(photo)
    assert max(pose_error(pose, expected)) < 0.1
    assert info["num_inliers"] > 0.9 * whole["num_inliers"]
    assert {name.partition("/")[0] for name in info["retrieved"]} == {"part0", "part1"}
    own = [name.partition("/")[2] for name in info["retrieved"]]
    assert own == whole["retrieved"] and sorted(own) == maps.Map(folder).names()
    assert all(name in localizer.reference for name in localizer.names)
    assert "part2/a" not in localizer.reference and own[0] not in localizer.reference
    near, about = localizer.localize(photo, near=expected)
    assert max(pose_error(near, expected)) < 0.1 and about["near"]

    run("--map", *parts, "--query_images", images / "query/day", "--outputs", tmp_path / "out")
    assert outcome(tmp_path / "out/queries-day")[1]["a.png"]["status"] == "localized"
    unpacked = maps.Map(tmp_path / "out/map")
    assert unpacked.names() == list(localizer.names)
    assert pycolmap.Reconstruction(unpacked.sfm).compute_mean_reprojection_error() < 0.01


def test_what_is_in_parts(parts):
    """Points are numbered one file after the other; each is used as in its own file."""
    joined, own = JoinedMap(parts), [CompactMap(path) for path in parts]
    assert len(joined.points) == sum(len(part.points) for part in own)
    start = 0
    for path, part in zip(parts, own, strict=True):
        for name in part.names:
            shown = joined.visible(f"{path.stem}/{name}")
            np.testing.assert_array_equal(shown, part.visible(name) + start)
            np.testing.assert_array_equal(joined.points[shown], part.points[shown - start])
            described = part.descriptors(shown - start)
            np.testing.assert_array_equal(joined.descriptors(shown), described)
            pose, camera = joined.pose(f"{path.stem}/{name}"), joined.camera(f"{path.stem}/{name}")
            assert max(pose_error(pose, part.pose(name))) == 0
            assert camera.params.tolist() == part.camera(name).params.tolist()
        start += len(part.points)
    with pytest.raises(InputError, match="No file of the map has the image part2/a"):
        joined.visible("part2/a")


def test_files_that_are_not_of_one_map(parts, built, tmp_path, refused):
    one, two = parts
    assert CompactMap(one).made_from == maps.Map(built[0]).id
    change(two, None, made_from="another")
    with pytest.raises(InputError, match="may have different frames"):
        Localizer(parts)
    metres = {"units": "m", "told_by": ["gps"]}
    here = {"latitude": 47.0, "longitude": 8.0, "altitude": None}
    for path, east in ((one, 8.0), (two, 8.1)):
        change(path, None, frame={**metres, "origin": here | {"longitude": east}})
    with pytest.raises(InputError, match="differ in the frame"):
        Localizer(parts)
    change(two, None, frame={**metres, "origin": here})
    assert Localizer(parts).frame.units == "m"
    change(two, "vocabulary", lambda words: words[:-1])
    with pytest.raises(InputError, match="different vocabularies"):
        Localizer(parts)
    change(two, None, matcher="NN-mutual")
    with pytest.raises(InputError, match="differ in the matcher"):
        Localizer(parts)
    (tmp_path / "a").mkdir()
    with pytest.raises(InputError, match="need different names"):
        Localizer([two, shutil.copy(one, tmp_path / "a/part1.hlm")])
    with pytest.raises(InputError, match="must be compact ones"):
        Localizer([two, built[0]])
    new = ("--query_images", built[1], "--outputs", tmp_path / "out")
    assert "several maps must be .hlm files" in refused("--map", two, built[0], *new)


def test_a_file_tells_whether_it_is_current(built, tmp_path, monkeypatch, capsys, caplog):
    folder, _ = built
    known, file = maps.Map(folder), tmp_path / "place.hlm"

    def check(*options):
        capsys.readouterr()
        monkeypatch.setattr("sys.argv", ["compact", *map(str, options)])
        with pytest.raises(SystemExit) as done:
            _main()
        printed = capsys.readouterr().out
        assert printed.count("\n") == 1 and str(options[1]) in printed
        return int(done.value.code)

    compact.main(file, folder)
    use(file)
    assert check("--check", file, "--map", folder) == 0
    change(file, None, made_from="another")
    assert check("--check", file, "--map", folder) == 1
    change(file, None, made_from=None)
    assert check("--check", file, "--map", folder) == 1
    compact.main(file, sfm=known.sfm, features=known.features, feature="colmap_sift_sv32")
    assert check("--check", file, "--sfm", known.sfm) == 0
    assert check("--check", file, "--map", folder) == 1
    model = pycolmap.Reconstruction(known.sfm)
    model.points3D[min(model.point3D_ids())].xyz += 1
    model.write(known.sfm)
    assert check("--check", file, "--sfm", known.sfm) == 1
    with pytest.raises(InputError, match="needs --map or --sfm"):
        compact.check(file)
    assert "Give --output" in command.refused(monkeypatch, caplog, compact, "--map", folder)
    with pytest.raises(InputError, match="The map has no image other.jpg"):
        (tmp_path / "list.txt").write_text("other.jpg")
        compact.main(file, folder, image_list=tmp_path / "list.txt")
