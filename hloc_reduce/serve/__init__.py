"""Localize photos in a map over HTTP.

POST /localize takes a photo, JPEG or PNG, as its body, POST /localize_rig those of a rig as JSON;
both answer with the pose as JSON. GET /health tells how many requests wait. docs/serve.md has the
parameters and the answers.
"""

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import TYPE_CHECKING

from .answers import answer, answer_of_rig
from .requests import Refused, parameters

if TYPE_CHECKING:
    from starlette.applications import Starlette
    from starlette.requests import Request
    from starlette.responses import Response

    from ..maps.localizer import Localizer

MAX_MB = 20.0  # 1,000,000 bytes of a request
QUEUE = 32  # requests that may wait
BUSY, BUSY_SECONDS = 503, 2  # status of a full queue, after which a client may try again
UPLOAD_SECONDS = 60.0
# path -> what answers, the parameters, and what messages call the body
ENDPOINTS: dict[str, tuple[Callable[..., dict], tuple[str, ...], str]] = {
    "/localize": (answer, ("camera", "inliers", "near", "radius"), "a photo"),
    "/localize_rig": (answer_of_rig, ("inliers",), "a request"),
}


def make_app(localizer: "Localizer", max_mb: float = MAX_MB, queue: int = QUEUE) -> "Starlette":
    """Make the application.

    Photos are localized one after the other: each uses all cores.

    Args:
        localizer: of the map.
        max_mb: the size of a request, in 1,000,000 bytes, above which it is refused.
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

    async def localize(
        make: Callable[..., dict], known: tuple[str, ...], name: str, request: "Request"
    ) -> "Response":
        try:
            given = parameters(request.query_params.multi_items(), known)
            body = await _body(request, int(max_mb * 1e6), name)
            return JSONResponse(await answered(partial(make, localizer, body, **given)))
        except Refused as error:
            headers = {"Retry-After": str(BUSY_SECONDS)} if error.status == BUSY else None
            return JSONResponse({"error": error.reason}, error.status, headers)
        except ClientDisconnect:
            return JSONResponse({"error": "the client is gone"}, 400)

    async def answered(work: Callable[[], dict]) -> dict:
        if state["waiting"] >= queue:
            raise Refused(BUSY, f"{queue} requests are waiting")
        state["waiting"] += 1
        try:
            found = await asyncio.get_running_loop().run_in_executor(worker, work)
            state["served"] += 1
            return found
        finally:
            state["waiting"] -= 1

    routes = [
        Route(path, partial(localize, *how), methods=["POST"]) for path, how in ENDPOINTS.items()
    ]
    return Starlette(routes=[*routes, Route("/health", health, methods=["GET"])])


async def _body(request: "Request", most: int, name: str) -> bytes:
    """Read a body; refuse one that is too large before all of it is read, or too slow."""
    too_large = Refused(413, f"{name} has at most {most:,} bytes")
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
