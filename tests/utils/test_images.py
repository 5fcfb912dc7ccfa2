"""Images of all kinds, and files that are no image."""

import os
import struct
import zlib
from io import BytesIO

import cv2
import numpy as np
import pycolmap
import pytest
from PIL import Image

from hloc_reduce import extract_features
from hloc_reduce.utils import colmap
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.h5 import list_h5_names
from hloc_reduce.utils.images import UnreadableImage, check_format, list_images, read_image


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


def png_chunk(kind, data):
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def huge_header():
    """The beginning of a PNG of 200,000 x 200,000 pixels."""
    size = struct.pack(">IIBBBBB", 200_000, 200_000, 8, 0, 0, 0, 0)
    chunks = png_chunk(b"IHDR", size), png_chunk(b"IDAT", b""), png_chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)


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
@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tif"])
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


def with_bits(image, path, bits, chunk=b""):
    """Write an image whose values of some bits are stored in 16, and perhaps a chunk sBIT."""
    deep = (image.astype(float) * (2**bits - 1) / 255).round().astype(np.uint16)
    content = cv2.imencode(".png", deep)[1].tobytes()
    path.write_bytes(content[:33] + (png_chunk(b"sBIT", chunk) if chunk else b"") + content[33:])


@pytest.mark.fault(10)
@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
@pytest.mark.parametrize("is_grey", [True, False])
def test_values_of_fewer_bits_than_are_stored_fill_the_range(bits, is_grey, picture, tmp_path):
    """As of cameras of 10 and 12 bits, whose photos would be black."""
    path, image = tmp_path / "deep.png", picture[..., 0] if is_grey else picture
    with_bits(image if is_grey else image[..., ::-1], path, bits)
    expected = np.dstack([image] * 3) if is_grey else image
    assert np.abs(read_image(path).astype(int) - expected).max() <= (bits == 16)
    grey = cv2.cvtColor(expected, cv2.COLOR_RGB2GRAY).astype(int)
    assert np.abs(read_image(path, grayscale=True) - grey).max() <= 1


@pytest.mark.fault(10)
def test_the_range_is_that_of_all_channels(picture, tmp_path):
    """A blue photo, whose grey values are small."""
    blue, path = picture * np.array([0, 0, 1], np.uint8), tmp_path / "blue.png"
    with_bits(blue[..., ::-1], path, 12)
    expected = cv2.cvtColor(blue, cv2.COLOR_RGB2GRAY).astype(int)
    assert np.abs(read_image(path, grayscale=True) - expected).max() <= 1


@pytest.mark.fault(10)
def test_significant_bits_are_those_that_a_file_declares(picture, tmp_path):
    """So that a photo taken in the dark stays dark; values that exceed them fill all 16 bits."""
    dark, path = picture[..., 0] // 8, tmp_path / "dark.png"
    with_bits(dark, path, 12, bytes([12]))  # its largest value has 9 bits
    assert np.abs(read_image(path, grayscale=True).astype(int) - dark).max() <= 1
    with_bits(picture[..., 0], path, 16, bytes([12]))
    assert np.abs(read_image(path, grayscale=True).astype(int) - picture[..., 0]).max() <= 1


def encoded(kind):
    """Return what encodes an image by Pillow."""

    def encode(image):
        buffer = BytesIO()
        Image.fromarray(image).save(buffer, kind)
        return buffer.getvalue()

    return encode


def box(brand):
    """Return what gives the beginning of a file in the format of MP4, with its brand."""
    return lambda _: b"\0\0\0\x1cftyp" + brand + b"\0\0\0\0mif1" + brand + bytes(100)


OTHERS = {
    "WebP": encoded("WEBP"),
    "GIF": encoded("GIF"),
    "JPEG 2000": encoded("JPEG2000"),
    "HEIC": box(b"heic"),
    "AVIF": box(b"avif"),
    "HEIC or AVIF": box(b"mif1"),
    "CR3": box(b"crx "),
    "a video": box(b"isom"),
    "JPEG XL": lambda _: b"\xff\x0a" + bytes(100),
}


@pytest.mark.fault(10)
@pytest.mark.parametrize("kind", OTHERS)
@pytest.mark.parametrize("suffix", [".jpg", ".JPEG", ".png", ".webp"])
def test_other_formats_are_named_whatever_the_file_is_called(kind, suffix, picture, tmp_path):
    """The same by all that read photos; COLMAP and OpenCV read some of them."""
    path = tmp_path / f"a{suffix}"
    path.write_bytes(OTHERS[kind](picture))
    kept = "jpg" if suffix == ".webp" else suffix[1:]
    how = "" if kind == "a video" else f"; `magick mogrify -format {kept}` converts it"
    message = f"Cannot read image {path}: it is {kind}, not JPEG or PNG{how}."

    def import_images(path):
        mode = pycolmap.CameraMode.AUTO
        colmap.import_images(tmp_path / "new.db", tmp_path, [path.name], mode, {})

    for read in (read_image, colmap.infer_camera, check_format, import_images):
        with pytest.raises(UnreadableImage) as error:
            read(path)
        assert str(error.value) == message, read


@pytest.mark.fault(10)
def test_all_that_cannot_be_read_are_named(picture, tmp_path):
    for i in range(2):
        (tmp_path / f"good{i}.png").write_bytes(png(picture))
        (tmp_path / f"web{i}.jpg").write_bytes(encoded("WEBP")(picture))
    (tmp_path / "cut.png").write_bytes(png(picture)[:1000])
    conf = extract_features.confs["colmap_sift_sv32"]
    with pytest.raises(UnreadableImage) as error:
        extract_features.main(conf, tmp_path, tmp_path / "out")
    of_web = "it is WebP, not JPEG or PNG; `magick mogrify -format jpg` converts it"
    assert str(error.value) == (
        f"Cannot read 3 images in {tmp_path}: cut.png (it is not an image, or it is truncated); "
        f"web0.jpg, web1.jpg ({of_web})."
    )
    for name in ("cut.png", "web0.jpg", "web1.jpg"):
        (tmp_path / name).unlink()
    assert list_h5_names(extract_features.main(conf, tmp_path, tmp_path / "out")) == [
        "good0.png",
        "good1.png",
    ]


@pytest.mark.parametrize("name", ["a.webp", "a.HEIC", "a.mp4", "a.MOV"])
def test_photos_and_videos_of_other_types_are_named(name, tmp_path, picture, caplog):
    (tmp_path / name).write_bytes(b"")
    (tmp_path / "notes.txt").write_text("")
    (tmp_path / "folder.png").mkdir()
    message = f"no image in .* It has {name}, but only .jpeg, .jpg, .png are read."
    with pytest.raises(InputError, match=message) as error:
        list_images(tmp_path)
    is_photo = name in ("a.webp", "a.HEIC")
    assert ("Convert photos" in str(error.value)) == is_photo
    assert not is_photo or str(error.value).endswith(f"-format jpg *{name[1:]}")
    cv2.imwrite(str(tmp_path / "b.png"), picture)
    assert list_images(tmp_path) == ["b.png"]
    assert "1 photos and videos in" in caplog.text and name in caplog.text


@pytest.mark.fault(10)
def test_pipes_are_no_photos(picture, tmp_path):
    """Whoever reads them waits forever; a link to nothing is a photo that cannot be read."""
    Image.fromarray(picture).save(tmp_path / "a.jpg")
    os.mkfifo(tmp_path / "pipe.jpg")
    (tmp_path / "linked.jpg").symlink_to(tmp_path / "pipe.jpg")
    (tmp_path / "lost.jpg").symlink_to(tmp_path / "nothing.jpg")
    assert list_images(tmp_path) == ["a.jpg", "lost.jpg"]
