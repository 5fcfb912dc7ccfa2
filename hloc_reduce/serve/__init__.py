"""Localize photos in a map over HTTP.

    POST /localize    a photo as the body (JPEG or PNG); the pose as JSON
    GET /health       whether the map is loaded, and how many requests wait

docs/serve.md has the parameters and the answers.
"""

import tempfile
import threading
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pycolmap

from ..localization.intrinsics import from_list, to_list
from ..utils.cli import InputError
from ..utils.parsers import CAMERA_MODELS

if TYPE_CHECKING:
    from starlette.applications import Starlette
    from starlette.requests import Request
    from starlette.responses import Response

    from ..maps.localizer import Localizer

MAX_MB = 20.0  # 1,000,000 bytes of a photo
QUEUE = 32  # requests that may wait
MAX_PIXELS = 100_000_000  # of a photo: a small file may be a huge image
SHOWN = 5  # retrieved images in an answer
BUSY_SECONDS = 2  # after which a refused client may try again


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
    from starlette.responses import JSONResponse
    from starlette.routing import Route

    worker = ThreadPoolExecutor(1, "localize")
    waiting = threading.BoundedSemaphore(queue)
    state = {"served": 0, "waiting": 0}

    async def health(_: "Request") -> "Response":
        return JSONResponse({"images": len(localizer.names), **state})

    async def localize(request: "Request") -> "Response":
        import asyncio

        if not waiting.acquire(blocking=False):
            reason = f"{queue} requests are waiting"
            return JSONResponse({"error": reason}, 503, {"Retry-After": str(BUSY_SECONDS)})
        state["waiting"] += 1
        try:
            camera = _camera(request.query_params.get("camera"))
            photo = await _body(request, int(max_mb * 1e6))
            whole = request.query_params.get("inliers") == "1"
            work = partial(answer, localizer, photo, camera, whole)
            found = await asyncio.get_running_loop().run_in_executor(worker, work)
            state["served"] += 1
            return JSONResponse(found)
        except Refused as error:
            return JSONResponse({"error": error.reason}, error.status)
        except InputError as error:
            return JSONResponse({"error": str(error)}, 400)
        finally:
            state["waiting"] -= 1
            waiting.release()

    routes = [
        Route("/localize", localize, methods=["POST"]),
        Route("/health", health, methods=["GET"]),
    ]
    return Starlette(routes=routes)


async def _body(request: "Request", most: int) -> bytes:
    """Read a body; refuse one that is too large before all of it is read."""
    too_large = Refused(413, f"a photo has at most {most:,} bytes")
    declared = request.headers.get("content-length", "0")
    if declared.isdigit() and int(declared) > most:
        raise too_large
    parts, size = [], 0
    async for part in request.stream():
        size += len(part)
        if size > most:
            raise too_large
        parts.append(part)
    return b"".join(parts)


def _camera(text: str | None) -> pycolmap.Camera | None:
    """Parse intrinsics as in a query list: MODEL WIDTH HEIGHT PARAMS."""
    if text is None:
        return None
    model, *numbers = text.replace(",", " ").split() or [""]
    try:
        if model not in CAMERA_MODELS:
            raise ValueError
        width, height, *params = (float(number) for number in numbers)
        camera = from_list([model, int(width), int(height), *params])
        if not (
            camera.verify_params() and np.isfinite(camera.params).all() and min(width, height) > 0
        ):
            raise ValueError
    except (ValueError, TypeError, OverflowError):
        raise Refused(
            400, f"camera={text[:100]} is not of the form MODEL WIDTH HEIGHT PARAMS"
        ) from None
    return camera


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
        with Image.open(BytesIO(photo)) as opened:
            width, height = opened.size
            suffix = f".{(opened.format or 'jpg').lower()}"
    except (UnidentifiedImageError, OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        raise Refused(400, "the body is not a photo") from None
    if width * height > MAX_PIXELS:
        raise Refused(413, f"a photo has at most {MAX_PIXELS:,} pixels")
    # a file, as its EXIF data tell the intrinsics
    with tempfile.NamedTemporaryFile(suffix=suffix) as file:
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
        "num_inliers": info["num_inliers"],
        "camera": to_list(info["camera"]),
        "intrinsics": info["intrinsics"],
        "retrieved": info["retrieved"][:SHOWN],
        "seconds": {stage: round(value, 4) for stage, value in info["seconds"].items()},
    }
    if pose is not None:
        x, y, z, w = pose.rotation.quat.tolist()
        found |= {"qvec": [w, x, y, z], "tvec": pose.translation.tolist()}
    if inliers:
        chosen = info["inliers"]
        found["points2D"] = info["points2D"][chosen].tolist()
        found["points3D"] = info["points3D"][chosen].tolist()
    return found
