"""Images: their names and their pixels."""

from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from PIL import Image

from .. import logger
from .cli import InputError, no_folder, some
from .parsers import check_names, image_names

IMAGE_SUFFIXES = {".jpg", ".jpeg", ".png"}
# photos and videos of other types, which are named and ignored
_PHOTOS = "arw avif bmp cr2 cr3 dng gif heic heif jp2 jxl nef orf ppm raf rw2 tif tiff webp"
_VIDEOS = "3gp avi m4v mkv mov mp4 mpeg mpg mts webm wmv"
CONVERTIBLE = {f".{name}" for name in _PHOTOS.split()}
VIDEO_SUFFIXES = {f".{name}" for name in _VIDEOS.split()}
OTHER_SUFFIXES = CONVERTIBLE | VIDEO_SUFFIXES
CONVERT = "Convert photos and keep their EXIF data, for example with: magick mogrify -format jpg"
# Formats by bytes of a file and where they are. No file of these is read, whatever its name is:
# COLMAP and OpenCV read some of them, in some versions. ImageMagick converts all but videos.
_VIDEO = "a video"
_FORMATS = (
    (0, b"GIF8", "GIF"),
    (8, b"WEBP", "WebP"),
    (4, b"ftypavi", "AVIF"),
    (4, b"ftyphe", "HEIC"),
    *((4, b"ftyp" + brand, "HEIC or AVIF") for brand in (b"mif", b"msf")),
    (4, b"ftypcrx ", "CR3"),
    (4, b"ftyp", _VIDEO),
    *((at, found, "JPEG 2000") for at, found in ((4, b"jP  \r\n"), (0, b"\xff\x4f\xff\x51"))),
    *((at, found, "JPEG XL") for at, found in ((4, b"JXL \r\n"), (0, b"\xff\x0a"))),
)
ORIENTATION = 0x0112  # EXIF tag
ORIENTATIONS = range(1, 9)
# by EXIF orientation, the quarter turns, counterclockwise, that show a photo upright; photos that
# are stored mirrored stay so
TURNS = {3: 2, 4: 2, 5: 3, 6: 3, 7: 1, 8: 1}
NO_IMAGE = "it is not an image, or it is truncated"
_PNG, _TIFF = b"\x89PNG\r\n\x1a\n", (b"II*\0", b"MM\0*")


def list_images(
    image_dir: Path, image_list: Path | str | Iterable[str] | None = None, folder: str = ""
) -> list[str]:
    """Return the names of the images in a folder or in a list.

    Args:
        image_dir: the folder that names are relative to.
        image_list: names, or a text file of them; default: every image in `folder`.
        folder: a folder in `image_dir`.

    Raises:
        InputError: when there is no image, or an image of the list is missing.
    """
    within = Path(image_dir, folder)
    if not within.is_dir():
        raise no_folder(within)
    if image_list is None:
        files = sorted(p.relative_to(image_dir) for p in within.rglob("*") if _may_be_read(p))
        names = [file.as_posix() for file in files if file.suffix.lower() in IMAGE_SUFFIXES]
        others = [str(file) for file in files if file.suffix.lower() in OTHER_SUFFIXES]
        read = ", ".join(sorted(IMAGE_SUFFIXES))
        suffixes = sorted({Path(other).suffix for other in others})
        photos = [f"*{one}" for one in suffixes if one.lower() in CONVERTIBLE]
        hint = f" {CONVERT} {' '.join(photos)}" if photos else ""
        if not names:
            there_are = f" It has {some(others)}, but only {read} are read." if others else ""
            raise InputError(f"There is no image in {within}.{there_are}{hint}")
        if others:
            logger.warning(
                "%d photos and videos in %s are ignored, as only %s are read: %s.%s",
                len(others),
                within,
                read,
                some(others),
                hint,
            )
        return check_names(names, within)
    names = image_names(image_list)
    missing = [name for name in names if not (image_dir / name).is_file()]
    if missing:
        raise InputError(
            f"{len(missing)} of {len(names)} images are not in {image_dir}: {some(missing)}"
        )
    return names


def _may_be_read(path: Path) -> bool:
    """Tell files, and links to nothing, from folders and from pipes, which nobody writes to."""
    return path.is_file() or (path.is_symlink() and not path.exists())


def stored_size(image: Path) -> tuple[int, int] | None:
    """Return the (width, height) of an image as it is stored, None if it cannot be read."""
    with suppress(Exception), Image.open(image) as opened:  # Pillow raises many
        return opened.size
    return None


def orientation(image: Path) -> int | None:
    """Return the EXIF orientation of a photo, None if EXIF data do not tell."""
    try:
        with Image.open(image) as opened:
            found = opened.getexif().get(ORIENTATION)
    except Exception:  # Pillow raises many types for broken data
        return None
    return int(found) if found is not None and found in ORIENTATIONS else None


class Frame(NamedTuple):
    """How an extractor sees a photo.

    Args:
        size: (2,) int64 width, height in pixels as it is stored.
        turns: by which it is shown, quarter turns, counterclockwise.
        mask: (H, W) bool, which of these pixels may have keypoints; None for all.
    """

    size: np.ndarray
    turns: int = 0
    mask: np.ndarray | None = None

    @property
    def shown(self) -> np.ndarray:
        """The width and height (2,) as it is shown."""
        return self.size[:: -1 if self.turns % 2 else 1]

    def near_kept(self, shape: tuple[int, ...]) -> np.ndarray | None:
        """Return which pixels of the photo as it is shown may have keypoints, None for all.

        That is for detectors which choose the best keypoints. `keeps` decides about each one: here
        a pixel counts if it, or one beside it, shows any that is kept.

        Args:
            shape: height and width as it is shown, resized.

        Returns:
            (H, W) bool.
        """
        if self.mask is None:
            return None
        turned_mask = np.rot90(self.mask, self.turns).astype(np.float32)
        share = cv2.resize(turned_mask, shape[1::-1], interpolation=cv2.INTER_AREA)
        return cv2.dilate((share > 0).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0

    def keeps(self, keypoints: np.ndarray) -> np.ndarray:
        """Tell which keypoints (N, 2), in pixels as it is stored, are not masked; (N,) bool."""
        if self.mask is None:
            return np.ones(len(keypoints), bool)
        pixels = np.floor(keypoints + 0.5).astype(int).clip(0, self.size - 1)
        return self.mask[pixels[:, 1], pixels[:, 0]]


def turned(keypoints: np.ndarray, size: np.ndarray, turns: int) -> np.ndarray:
    """Return where the keypoints of a photo are when it is turned.

    Args:
        keypoints: (N, 2) x, y in pixels, centres at integers.
        size: (2,) its width and height before.
        turns: quarter turns, counterclockwise.
    """
    for _ in range(turns % 4):
        x, y = keypoints.T
        keypoints = np.stack([y, (size[0] - 1).astype(keypoints.dtype) - x], axis=1)
        size = size[::-1]
    return keypoints


def convert(image: np.ndarray, grayscale: bool) -> np.ndarray:
    """Convert pixels (H, W) or (H, W, 3) RGB, uint8, to (H, W) if `grayscale`, else (H, W, 3).

    Raises:
        InputError: for arrays of another shape or type.
    """
    if image.dtype != np.uint8 or image.shape[2:] not in ((), (3,)) or image.size == 0:
        raise InputError(
            f"An image is uint8 (H, W) or (H, W, 3) RGB, not {image.dtype} {image.shape}."
        )
    if image.ndim == 3 and grayscale:
        return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    return cv2.cvtColor(image, cv2.COLOR_GRAY2RGB) if image.ndim == 2 and not grayscale else image


def resized(
    image: Path | np.ndarray, preprocessing: Mapping, mask: np.ndarray | None = None
) -> tuple[np.ndarray, Frame]:
    """Read an image and resize its longer side to at most `resize_max` pixels.

    Smaller images are enlarged to `resize_min` or, with `resize_force`, to `resize_max` pixels.

    Args:
        image: its file, or its pixels (H, W) or (H, W, 3) RGB, uint8.
        preprocessing: `grayscale`, `resize_max`, `resize_force` and `upright`, whether EXIF data
            turn it, of a feature's configuration; and `resize_min`; `turns`, further quarter turns,
            counterclockwise; and `mirrored`, whether to swap left and right.
        mask: (H, W) bool, which pixels of the image as it is stored may have keypoints.

    Returns:
        The image, (H, W) if `grayscale`, else (H, W, 3) RGB, float32 in [0, 1], and how it is
        shown.

    Raises:
        InputError: when it cannot be read, or the mask has another size.
    """
    grayscale = preprocessing.get("grayscale", False)
    pixels = (
        convert(image, grayscale) if isinstance(image, np.ndarray) else read_image(image, grayscale)
    )
    if mask is not None and mask.shape != pixels.shape[:2]:
        sizes = [f"{width}x{height}" for height, width in (mask.shape, pixels.shape[:2])]
        raise InputError(f"The mask has {sizes[0]} pixels, the photo has {sizes[1]}.")
    turns = preprocessing.get("turns", 0)
    if preprocessing.get("upright") and isinstance(image, Path):
        turns += TURNS.get(orientation(image) or 0, 0)
    if preprocessing.get("mirrored"):
        pixels, turns = pixels[:, ::-1], -turns
        mask = None if mask is None else mask[:, ::-1]
    frame = Frame(np.array(pixels.shape[1::-1]), turns % 4, mask)
    pixels, size = np.rot90(pixels, frame.turns).astype(np.float32, order="C"), frame.shown
    resize_max = preprocessing.get("resize_max") or size.max()
    resize_min = preprocessing.get("resize_min", 0)
    if preprocessing.get("resize_force"):
        resize_min = resize_max
    longer = min(max(size.max(), resize_min), resize_max)
    if longer != size.max():
        # at least one pixel: a panorama may be a thousand times wider than high
        new_size = np.maximum(1, np.round(size * (longer / size.max())).astype(int))
        smaller = (new_size <= size).all()
        interpolation = cv2.INTER_AREA if smaller else cv2.INTER_LINEAR  # as hloc
        pixels = cv2.resize(pixels, new_size.tolist(), interpolation=interpolation)
    return pixels / 255, frame


def in_original(features: dict, shape: tuple[int, ...], frame: Frame, noise: float) -> dict:
    """Return the features of a resized image in pixels of the original one, as it is stored.

    Keypoints that the frame masks are dropped.

    Args:
        features: `keypoints` (N, 2), and perhaps `scales` (N,) and `blur`, in pixels, `oris` (N,)
            in degrees, `scores` (N,) and `descriptors` (D, N).
        shape: height and width of the resized image, and perhaps more.
        frame: how the original one is shown.
        noise: standard deviation of the keypoints in pixels of the resized image.

    Returns:
        All features, with `image_size` (2,), `uncertainty` and `blur`, pixels, and the `turns` of
        the frame.
    """
    ratio = (frame.shown / np.array(shape[1::-1])).astype(np.float32)
    keypoints = (features["keypoints"] + 0.5) * ratio - 0.5
    features = {**features, "keypoints": turned(keypoints, frame.shown, -frame.turns)}
    if frame.mask is not None:
        features = _chosen(features, frame.keeps(features["keypoints"]))
    if "oris" in features and frame.turns:
        features["oris"] = (features["oris"] + 90 * frame.turns) % 360
    if "scales" in features:
        features["scales"] = features["scales"] * ratio.mean()
    features["image_size"], features["turns"] = frame.size, frame.turns
    features["uncertainty"] = noise * ratio.mean()
    features["blur"] = features.get("blur", 0.0) * ratio.mean()
    return features


def _chosen(features: dict, rows: np.ndarray) -> dict:
    """Return the features of some keypoints, given which of all (N,) bool."""
    axes = {key: 0 for key in ("keypoints", "scores", "scales", "oris")} | {"descriptors": 1}
    return {
        key: np.compress(rows, value, axes[key]) if key in axes else value
        for key, value in features.items()
    }


class UnreadableImage(InputError):
    """An image file is missing or cannot be read."""


def refusal(head: bytes, suffix: str = ".jpg") -> str | None:
    """Return why an image file is not read, if its first bytes tell.

    Args:
        head: the first 32 bytes of the file, or more.
        suffix: of its name, which stays when the file is converted.
    """
    if not head:
        return "it is empty"
    for start, found, name in _FORMATS:
        if head.startswith(found, start):
            if name == _VIDEO:
                return "it is a video, not JPEG or PNG"
            kept = suffix if suffix.lower() in IMAGE_SUFFIXES else ".jpg"
            how = f"`magick mogrify -format {kept[1:]}` converts it"
            return f"it is {name}, not JPEG or PNG; {how}"
    return None


def unreadable(path: Path, reason: str) -> UnreadableImage:
    """Return the error for an image file that cannot be read."""
    return UnreadableImage(f"Cannot read image {path}: {reason}.")


def with_reasons(failed: Mapping[str, str]) -> str:
    """Name the first few images that could not be read, and why.

    Args:
        failed: messages of UnreadableImage by image name.
    """
    by_reason: dict[str, list[str]] = {}
    for name, message in failed.items():
        by_reason.setdefault(message.rpartition(": ")[2].rstrip("."), []).append(name)
    return "; ".join(f"{some(names)} ({reason})" for reason, names in by_reason.items())


def check_format(path: Path) -> None:
    """Raise an UnreadableImage if a file is missing, or of a format that is not read."""
    try:
        with path.open("rb") as file:
            reason = refusal(file.read(32), path.suffix)
    except OSError as error:
        reason = str(error.strerror)
    if reason:
        raise unreadable(path, reason)


def read_image(path: Path, grayscale: bool = False) -> np.ndarray:
    """Read an image as uint8, (H, W) or (H, W, 3) RGB, without applying EXIF's rotation.

    Values of 10, 12 or 14 bits that are stored in 16 are scaled by their own range.

    Raises:
        UnreadableImage: when OpenCV cannot read the file, or it is of a format that others that
            read photos do not know.
    """
    image = None
    try:
        data = np.fromfile(path, np.uint8)
        if (reason := refusal(data[:32].tobytes(), Path(path).suffix)) is None:
            reason, image = NO_IMAGE, _decode(data, grayscale)
    except OSError as error:
        reason = str(error.strerror)
    except cv2.error as error:
        reason = f"OpenCV requires {error.err}"
    if image is None:
        raise unreadable(path, reason)
    return image if grayscale else cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def _decode(data: np.ndarray, grayscale: bool) -> np.ndarray | None:
    """Return the pixels of a file's content (N,) uint8, (H, W) or (H, W, 3) BGR uint8, or None."""
    as_stored, head = cv2.IMREAD_IGNORE_ORIENTATION, data[:32].tobytes()
    if head.startswith(_TIFF) or head.startswith(_PNG) and head[24:25] == b"\x10":
        # in colour, as grey values are smaller than the largest of a channel
        deep = cv2.imdecode(data, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH | as_stored)
        if deep is not None and deep.dtype == np.uint16 and (bits := _bits(data, deep)) < 16:
            scaled = cv2.convertScaleAbs(deep, alpha=255 / (2**bits - 1))
            return cv2.cvtColor(scaled, cv2.COLOR_BGR2GRAY) if grayscale else scaled
    mode = cv2.IMREAD_GRAYSCALE if grayscale else cv2.IMREAD_COLOR
    return cv2.imdecode(data, mode | as_stored)


def _bits(data: np.ndarray, pixels: np.ndarray) -> int:
    """Return of how many bits the values of 16-bit pixels are.

    The chunk sBIT of a PNG may say it. Its values should fill all 16 bits even so, but those of
    many cameras do not.
    """
    largest = int(pixels.max())
    header = data[: 2**16].tobytes().partition(b"IDAT")[0]
    _, found, rest = header.partition(b"sBIT")
    declared = rest[0] if found and rest else 0
    usual = (declared, 8, 10, 12, 14)
    return next((bits for bits in usual if bits >= 8 and largest < 2**bits), 16)


def check_readable(
    image_dir: Path, names: Iterable[str], read: Callable[[Path], object] = read_image
) -> None:
    """Raise an UnreadableImage that names all images of a folder that cannot be read, and why.

    Args:
        image_dir: the folder.
        names: of the images.
        read: what reads an image.
    """
    failed = {}
    for name in names:
        try:
            read(image_dir / name)
        except UnreadableImage as error:
            failed[name] = str(error)
    if len(failed) == 1:
        raise UnreadableImage(*failed.values())
    if failed:
        raise UnreadableImage(
            f"Cannot read {len(failed)} images in {image_dir}: {with_reasons(failed)}."
        )
