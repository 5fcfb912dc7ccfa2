"""Photos that were cropped or enlarged: maps of photos alone do without them."""

import pytest
from conftest import FOCAL
from PIL import Image

from hloc_reduce import Localizer, maps
from hloc_reduce.mapping.checks import intrinsics
from hloc_reduce.mapping.findings import names_in
from hloc_reduce.maps import pairing
from pipelines import localize

PIPELINE = localize


@pytest.mark.parametrize("most", [100, 2])
def test_a_photo_of_another_size_by_the_same_camera_is_left_out(
    plane, tmp_path, most, monkeypatch, caplog, run
):
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
    monkeypatch.setattr(pairing, "MAX_EXHAUSTIVE", most)
    run("--map_images", images, "--outputs", outputs, "--camera_mode", "single")
    built = maps.Map(outputs / "map")
    assert names_in(built.findings, "another_size") == {"1.jpg"}
    assert built.names() == ["0.jpg", "2.jpg", "3.jpg", "4.jpg"]
    assert "do not belong in the map, because their size" in caplog.text
    info = Localizer(built.folder).localize(images / "1.jpg")[1]
    assert "1.jpg" not in info["retrieved"] and info["intrinsics"] == "unknown"


@pytest.mark.parametrize(("taken", "number"), [((360, 270), 0), ((360, 203), 5)])
def test_photos_that_exif_data_call_cropped_are_named(
    plane, tmp_path, taken, number, caplog, run, refused
):
    """All were, so all stay; queries of the same kind have unknown intrinsics."""
    images, outputs = plane / "images", tmp_path / "outputs"
    for path in sorted(images.iterdir()):
        exif = Image.Exif()
        exif[0x010F], exif[0x0110] = "Maker", "Phone 1"
        more = exif.get_ifd(0x8769)
        more[0xA405], more[0xA002], more[0xA003] = round(FOCAL / 360 * 36), *taken
        with Image.open(path) as photo:
            photo.save(path.with_suffix(".jpg"), quality=95, exif=exif)
        path.unlink()
    run("--map_images", images, "--outputs", outputs, "--camera_mode", "single")
    built = maps.Map(outputs / "map")
    assert sorted(names_in(built.findings, "cropped")) == [f"{i}.jpg" for i in range(number)]
    assert ("another ratio than their EXIF data say: 0.jpg, 1" in caplog.text) == (number > 0)
    info = Localizer(built.folder).localize(images / "1.jpg")[1]
    assert info["intrinsics"] == ("unknown" if number else "map")
    if number:  # with cameras of their own the focal lengths of a plane differ
        caplog.clear()
        assert "differ by a factor" in refused("--map_images", images, "--outputs", tmp_path / "2")
        assert "another ratio than their EXIF data say: 0.jpg, 1" in caplog.text


@pytest.mark.parametrize(
    ("altered", "others_fit"),
    [(["1.png"], True), (["1.png"], False), (["1.png", "2.png", "4.png"], True)],
)
def test_a_map_is_built_again_without_altered_photos(
    plane, tmp_path, altered, others_fit, monkeypatch, caplog, run
):
    """If they are fewer than half, and the others fit."""

    def measure(sfm):
        whole = sfm.num_reg_images() == 5
        fits = not whole and others_fit
        return intrinsics.Fit(0.0, []) if fits else intrinsics.Fit(0.4, altered if whole else [])

    monkeypatch.setattr(intrinsics, "measure", measure)
    outputs = tmp_path / "outputs"
    run("--map_images", plane / "images", "--outputs", outputs, "--camera_mode", "single")
    built = maps.Map(outputs / "map")
    [sfm] = [path.name for path in built.folder.glob("sfm*")]
    if others_fit and len(altered) == 1:
        assert sorted(names_in(built.findings)) == altered and sfm == "sfm-alike"
        assert built.names() == ["0.png", "2.png", "3.png", "4.png"]
        assert "that of the others: 1.png." in caplog.text and "may be wrong" not in caplog.text
    else:
        assert [one.kind for one in built.findings] == ["intrinsics"]
        assert len(built.names()) == 5 and sfm == "sfm"
        assert "The map may be wrong." in caplog.text
