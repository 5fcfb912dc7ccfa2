"""Images of all kinds, and files that are no image."""

import struct
import zlib

import cv2
import numpy as np
import pytest
from PIL import Image

from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.images import UnreadableImage, list_images, read_image


@pytest.fixture
def picture(textured):
    """A colour image (240, 320, 3) uint8."""
    return np.dstack([textured, textured[::-1], 255 - textured])


def rotated(image, path):
    """Save with EXIF's orientation 6: to be shown turned to the right."""
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(image).save(path, exif=exif)


KINDS = {
    "16_bit.png": lambda image, path: cv2.imwrite(str(path), image[..., ::-1].astype("u2") * 257),
    "16_bit.tif": lambda image, path: cv2.imwrite(str(path), image[..., ::-1].astype("u2") * 257),
    "alpha.png": lambda image, path: Image.fromarray(image).convert("RGBA").save(path),
    "palette.png": lambda image, path: Image.fromarray(image).quantize(256).save(path),
    "cmyk.jpg": lambda image, path: Image.fromarray(image).convert("CMYK").save(path, quality=95),
    "rotated.png": rotated,
    "trailer.png": lambda image, path: path.write_bytes(png(image) + b"and more"),
}


def png(image):
    return cv2.imencode(".png", image[..., ::-1])[1].tobytes()


@pytest.mark.parametrize("name", KINDS)
def test_kinds_of_images(name, picture, tmp_path):
    KINDS[name](picture, tmp_path / name)
    found = read_image(tmp_path / name)
    assert found.shape == picture.shape and found.dtype == np.uint8
    tolerance = {"palette.png": 30, "cmyk.jpg": 10}.get(name, 0)
    assert np.abs(found.astype(int) - picture).mean() <= tolerance
    grey = read_image(tmp_path / name, grayscale=True)
    expected = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY).astype(int)
    assert np.abs(grey - expected).mean() <= tolerance + 1  # libpng rounds down


@pytest.mark.parametrize("mode", ["L", "LA", "I;16", "1"])
def test_grey_images(mode, picture, tmp_path):
    grey = Image.fromarray(picture).convert("L")
    if mode == "I;16":
        grey = Image.fromarray(np.asarray(grey).astype("u2") * 257)
    else:
        grey = grey.convert(mode)
    grey.save(tmp_path / "grey.png")
    found = read_image(tmp_path / "grey.png")
    assert (found[..., 0] == found[..., 1]).all() and (found[..., 0] == found[..., 2]).all()
    if mode != "1":
        assert (found[..., 0] == np.asarray(Image.fromarray(picture).convert("L"))).all()
    assert (read_image(tmp_path / "grey.png", grayscale=True) == found[..., 0]).all()


def huge_header():
    """The beginning of a PNG of 200,000 x 200,000 pixels."""

    def chunk(kind, data):
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    size = struct.pack(">IIBBBBB", 200_000, 200_000, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", size) + chunk(b"IDAT", b"") + chunk(b"IEND", b"")


@pytest.mark.parametrize(
    "cut, message",
    [
        (lambda content: b"", "it is empty"),
        (lambda content: content[:20], "not an image, or it is truncated"),
        (lambda content: content[: len(content) // 2], "not an image, or it is truncated"),
        (lambda content: content[:-30], "not an image, or it is truncated"),
        (lambda content: b"a text", "not an image, or it is truncated"),
        (lambda content: huge_header(), "OpenCV requires"),
        (None, "No such file"),
    ],
)
@pytest.mark.parametrize("suffix", [".png", ".jpg", ".webp"])
def test_what_is_no_image(cut, message, suffix, picture, tmp_path):
    path = tmp_path / f"a{suffix}"
    if cut is not None:
        path.write_bytes(cut(cv2.imencode(suffix, picture)[1].tobytes()))
    with pytest.raises(UnreadableImage, match=message) as error:
        read_image(path)
    assert f"Cannot read image {path}: " in str(error.value)
    assert isinstance(error.value, InputError)


def test_a_folder_is_no_image(tmp_path):
    with pytest.raises(UnreadableImage, match="Is a directory"):
        read_image(tmp_path)


@pytest.mark.parametrize("name", ["a.webp", "a.HEIC", "a.mp4", "a.MOV"])
def test_photos_and_videos_of_other_types_are_named(name, tmp_path, picture, caplog):
    (tmp_path / name).write_bytes(b"")
    (tmp_path / "notes.txt").write_text("")
    (tmp_path / "folder.png").mkdir()
    message = f"no image in .* It has {name}, but only .jpeg, .jpg, .png are read."
    with pytest.raises(InputError, match=message) as error:
        list_images(tmp_path)
    assert ("Convert HEIC photos" in str(error.value)) == (name == "a.HEIC")
    assert name != "a.HEIC" or str(error.value).endswith("-format jpg *.HEIC")
    cv2.imwrite(str(tmp_path / "b.png"), picture)
    assert list_images(tmp_path) == ["b.png"]
    assert "1 photos and videos in" in caplog.text and name in caplog.text
