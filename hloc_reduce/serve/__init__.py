"""Localize photos in a map over HTTP.

POST /localize takes a photo, JPEG or PNG, as its body and answers with the pose as JSON. GET
/health tells how many requests wait. docs/serve.md has the parameters and the answers.
"""

import asyncio
import tempfile
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pycolmap

from ..localization.intrinsics import to_list
from ..utils.cli import InputError, some
from ..utils.images import refusal
from ..utils.parsers import parse_camera

if TYPE_CHECKING:
    from starlette.applications import Starlette
    from starlette.requests import Request
    from starlette.responses import Response

    from ..maps.localizer import Localizer

MAX_MB = 20.0  # 1,000,000 bytes of a photo
QUEUE = 32  # requests that may wait
MAX_PIXELS = 100_000_000  # of a photo: a small file may be a huge image
RETRIEVED_SHOWN = 5  # retrieved images in an answer
BUSY, BUSY_SECONDS = 503, 2  # status of a full queue, after which a client may try again
UPLOAD_SECONDS = 60.0
PHOTO_FORMATS = ("JPEG", "PNG")
PARAMETERS = ("camera", "inliers")  # of a request, as docs/serve.md has them


class Refused(Exception):
    """A request that is refused, with the HTTP status and the reason."""

    def __init__(self, status: int, reason: str):
        self.status, self.reason = status, reason
        super().__init__(reason)


def make_app(localizer: "Localizer", max_mb: float = MAX_MB, queue: int = QUEUE) -> "Starlette":
    """Make the application.

    Photos are localized one after the other: each uses all cores.

    Args:
        localizer: of the map.
        max_mb: the size of a photo, in 1,000,000 bytes, above which it is refused.
        queue: the number of requests above which further ones are refused.
    """
    from starlette.applications import Starlette
    from starlette.requests import ClientDisconnect
    from starlette.responses import JSONResponse
    from starlette.routing import Route

    worker = ThreadPoolExecutor(1, "localize")
    state = {"served": 0, "waiting": 0}

    async def health(_: "Request") -> "Response":
        return JSONResponse({"images": len(localizer.names), **state})

    async def localize(request: "Request") -> "Response":
        try:
            camera, inliers = _parameters(request.query_params.multi_items())
            photo = await _body(request, int(max_mb * 1e6))
            return JSONResponse(await answered(photo, camera, inliers))
        except Refused as error:
            headers = {"Retry-After": str(BUSY_SECONDS)} if error.status == BUSY else None
            return JSONResponse({"error": error.reason}, error.status, headers)
        except ClientDisconnect:
            return JSONResponse({"error": "the client is gone"}, 400)

    async def answered(photo: bytes, camera: pycolmap.Camera | None, inliers: bool) -> dict:
        if state["waiting"] >= queue:
            raise Refused(BUSY, f"{queue} requests are waiting")
        state["waiting"] += 1
        try:
            work = partial(answer, localizer, photo, camera, inliers)
            found = await asyncio.get_running_loop().run_in_executor(worker, work)
            state["served"] += 1
            return found
        finally:
            state["waiting"] -= 1

    routes = [
        Route("/localize", localize, methods=["POST"]),
        Route("/health", health, methods=["GET"]),
    ]
    return Starlette(routes=routes)


async def _body(request: "Request", most: int) -> bytes:
    """Read a body; refuse one that is too large before all of it is read, or too slow."""
    too_large = Refused(413, f"a photo has at most {most:,} bytes")
    declared = request.headers.get("content-length", "0")
    if declared.isdigit() and int(declared) > most:
        raise too_large
    parts, size = [], 0
    try:
        async with asyncio.timeout(UPLOAD_SECONDS):
            async for part in request.stream():
                size += len(part)
                if size > most:
                    raise too_large
                parts.append(part)
    except TimeoutError:
        raise Refused(408, f"the upload took more than {UPLOAD_SECONDS:g} seconds") from None
    return b"".join(parts)


def _parameters(given: list[tuple[str, str]]) -> tuple[pycolmap.Camera | None, bool]:
    """Parse the parameters of a request: the camera, and whether to answer with the inliers."""
    names = [name for name, _ in given]
    if unknown := sorted(set(names) - set(PARAMETERS)):
        named, known = some(name[:20] for name in unknown), " and ".join(PARAMETERS)
        raise Refused(400, f"unknown parameters: {named}; there are {known}")
    if twice := [name for name in PARAMETERS if names.count(name) > 1]:
        raise Refused(400, f"{' and '.join(twice)}: give it once")
    values = dict(given)
    inliers = values.get("inliers", "0")
    if inliers not in ("0", "1"):
        raise Refused(400, f"inliers is {inliers[:20]!r}: it is 0 or 1")
    return _camera(values.get("camera")), inliers == "1"


def _camera(text: str | None) -> pycolmap.Camera | None:
    """Parse intrinsics as in a query list: MODEL WIDTH HEIGHT PARAMS."""
    if text is None:
        return None
    try:
        return parse_camera(text.replace(",", " ").split())
    except ValueError as error:
        raise Refused(400, f"camera: {error}; it is MODEL WIDTH HEIGHT PARAMS") from None


def answer(
    localizer: "Localizer", photo: bytes, camera: pycolmap.Camera | None, inliers: bool
) -> dict[str, Any]:
    """Localize a photo and return the content of the answer.

    Args:
        localizer: of the map.
        photo: content of its file.
        camera: its intrinsics, None if they are not known.
        inliers: whether the answer has them.

    Raises:
        InputError: when it is not a photo, or of another size than its intrinsics.
        Refused: when it has too many pixels.
    """
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(BytesIO(photo), formats=PHOTO_FORMATS) as opened:
            width, height = opened.size
    except Image.DecompressionBombError:
        width = height = MAX_PIXELS
    except (UnidentifiedImageError, OSError, ValueError, SyntaxError):
        reason = refusal(photo[:32])
        said = f"cannot be read: {reason}" if reason else "is not a JPEG or PNG file"
        raise Refused(400, f"the body {said}") from None
    if width * height > MAX_PIXELS:
        raise Refused(413, f"a photo has at most {MAX_PIXELS:,} pixels")
    # a file, as its EXIF data tell the intrinsics
    with tempfile.NamedTemporaryFile(suffix=".jpg") as file:
        Path(file.name).write_bytes(photo)
        try:
            pose, info = localizer.localize(file.name, camera)
        except InputError as error:
            raise Refused(400, str(error).replace(f" {file.name}", "")) from None
    found: dict[str, Any] = {
        "localized": pose is not None,
        "reason": info["reason"],
        "confidence": info["confidence"],
        "agreement": info["agreement"],
        "probability": info["probability"],
        "num_inliers": info["num_inliers"],
        "again": info["again"],
        "turned": info["turned"],
        "camera": to_list(info["camera"]),
        "intrinsics": info["intrinsics"],
        "map_doubts": info["map_doubts"],
        "retrieved": info["retrieved"][:RETRIEVED_SHOWN],
        "seconds": {stage: round(value, 4) for stage, value in info["seconds"].items()},
    }
    if pose is not None:
        x, y, z, w = pose.rotation.quat.tolist()
        found |= {"qvec": [w, x, y, z], "tvec": pose.translation.tolist()}
        found |= {"wgs84": info["wgs84"]} if info["wgs84"] else {}
        found["covariance"] = None if info["covariance"] is None else info["covariance"].tolist()
    if inliers:
        chosen = info["inliers"]
        found["points2D"] = info["points2D"][chosen].tolist()
        found["points3D"] = info["points3D"][chosen].tolist()
    return found
