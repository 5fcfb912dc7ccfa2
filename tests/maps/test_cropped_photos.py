"""Photos of a map that were cropped, enlarged or misplaced: none is localized by them."""

import json

import pytest
from conftest import FOCAL
from PIL import Image

from hloc_reduce import Localizer, compact, maps
from hloc_reduce.maps import cropping
from hloc_reduce.utils import parsers
from pipelines import localize

PIPELINE = localize


def test_a_photo_of_another_size_by_the_same_camera_is_left_out(plane, tmp_path, caplog, run):
    """It may be a smaller copy, or cropped: EXIF data, which it keeps, do not tell."""
    images, outputs = plane / "images", tmp_path / "outputs"
    for path in sorted(images.iterdir()):
        exif = Image.Exif()
        exif[0x010F], exif[0x0110] = "Maker", "Phone 1"
        exif.get_ifd(0x8769)[0xA405] = round(FOCAL / 360 * 36)
        with Image.open(path) as photo:
            part = photo.crop((0, 0, 252, 189)) if path.stem == "1" else photo
            part.save(path.with_suffix(".jpg"), quality=95, exif=exif)
        path.unlink()
    run("--map_images", images, "--outputs", outputs, "--camera_mode", "single")
    built = maps.Map(outputs / "map")
    assert built.cropped == ["1.jpg"]
    assert built.names() == ["0.jpg", "2.jpg", "3.jpg", "4.jpg"]
    assert "are smaller copies, are not in the map: 1.jpg." in caplog.text
    info = Localizer(built.folder).localize(images / "1.jpg")[1]
    assert "1.jpg" not in info["retrieved"] and info["intrinsics"] == "unknown"


@pytest.mark.parametrize("others_fit", [True, False])
def test_a_map_is_built_again_without_altered_photos(
    plane, tmp_path, others_fit, monkeypatch, caplog, run
):
    def find(sfm):
        whole = sfm.num_reg_images() == 5
        fits = not whole and others_fit
        return cropping.Fit(0.0, []) if fits else cropping.Fit(0.4, ["1.png"] if whole else [])

    monkeypatch.setattr(cropping, "find", find)
    outputs = tmp_path / "outputs"
    run("--map_images", plane / "images", "--outputs", outputs, "--camera_mode", "single")
    built = maps.Map(outputs / "map")
    others = ["0.png", "2.png", "3.png", "4.png"]
    [sfm] = [path.name for path in built.folder.glob("sfm*")]
    if others_fit:
        assert built.cropped == ["1.png"] and built.names() == others and sfm == "sfm-uncropped"
        assert "are not in the map: 1.png." in caplog.text and "may be wrong" not in caplog.text
    else:
        assert not built.cropped and len(built.names()) == 5 and sfm == "sfm"
        assert "The map may be wrong." in caplog.text
    assert built.references() == others


def test_photos_that_may_be_misplaced_localize_no_others(place, tmp_path, run, refused):
    build, images, outputs = place
    new = "--query_images", images / "query/day"
    run(*build, *new)
    file = outputs / "map/map.json"
    content = json.loads(file.read_text())
    content |= {"images_altered": ["db/2.png"], "images_contradicting_others": ["db/0.png"]}
    file.write_text(json.dumps(content))
    compact.main(tmp_path / "place.hlm", outputs / "map")
    again = "--map", outputs / "map", *new, "--outputs", outputs
    run(*again, "--overwrite")
    photo = images / "query/day/a.png"
    for localizer in (Localizer(outputs / "map"), Localizer(tmp_path / "place.hlm")):
        pose, info = localizer.localize(photo)
        assert {*info["retrieved"]} == {"db/1.png", "db/3.png"} and pose is not None
    [pairs] = outputs.glob("queries-day/pairs-*.txt")
    assert {*parsers.parse_retrieval(pairs)["a.png"]} == {"db/1.png", "db/3.png"}

    content["images_altered"] = maps.Map(outputs / "map").names()
    file.write_text(json.dumps(content))
    assert "all of its own may be misplaced" in refused(*again)
