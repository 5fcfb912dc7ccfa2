"""Command line of `hloc_reduce.serve`."""

import asyncio
import os
from pathlib import Path
from typing import Annotated

from .. import logger
from ..confs import matchers as matchers_confs
from ..utils import cli, options
from ..utils.cli import InputError
from ..utils.options import ABOVE_0, POSITIVE, Option
from . import MAX_MB, QUEUE, __doc__, make_app

MAX_PORT = 65_535
UPLOADS = 32  # connections beside those that wait


def serve(
    map: Path,
    onnx: Path | None = None,
    matcher: Annotated[str, Option("matcher", matchers_confs.names)] | None = None,
    matcher_onnx: Path | None = None,
    host: str = "127.0.0.1",
    port: Annotated[int, POSITIVE] = 8000,
    num_loc: Annotated[int, POSITIVE] = 50,
    max_mb: Annotated[float, ABOVE_0] = MAX_MB,
    queue: Annotated[int, POSITIVE] = QUEUE,
) -> None:
    """Serve a map until the process is stopped.

    Args:
        map: map folder, or file of hloc_reduce.compact.
        onnx: the map's feature, from hloc_reduce.export: needs no torch.
        matcher: matcher of photos; default: the map's.
        matcher_onnx: LightGlue, with `onnx`, from hloc_reduce.export --matcher lightglue.
        host: address to listen on; 0.0.0.0 for all networks.
        port: port to listen on.
        num_loc: retrieved map images per photo.
        max_mb: largest request in 1,000,000 bytes; photos of a rig, in base64, take a third more.
        queue: requests that may wait; others get status 503.
    """
    if port > MAX_PORT:
        raise InputError(f"--port {port}: at most {MAX_PORT}.")
    try:
        import uvicorn
    except ImportError:
        raise InputError("The service needs: pip install 'hloc-reduce[serve]'.") from None
    from ..maps.localizer import Localizer

    check_address(host, port)  # before the map is loaded
    localizer = Localizer(map, num_loc, onnx=onnx, matcher=matcher, matcher_onnx=matcher_onnx)
    logger.info("Serving %s at http://%s:%d.", map, host, port)
    app = make_app(localizer, max_mb, queue)
    # photos that are being uploaded are in memory, too
    uvicorn.run(
        app,
        host=host,
        port=port,
        log_level="warning",
        limit_concurrency=queue + UPLOADS,
        timeout_keep_alive=30,
    )


def check_address(host: str, port: int) -> None:
    """Raise an InputError if nothing can listen at an address, where uvicorn would only exit."""

    async def listen() -> None:
        server = await asyncio.get_running_loop().create_server(asyncio.Protocol, host, port)
        server.close()

    try:
        asyncio.run(listen())
    except (OSError, UnicodeError) as error:  # the latter for a host like a..b
        # asyncio's own text repeats the address; an unknown host has a negative number
        number = getattr(error, "errno", None) or 0
        reason = os.strerror(number) if number > 0 else getattr(error, "strerror", "no host name")
        raise InputError(
            f"Cannot listen on {host}:{port}: {reason}. Choose another --port or --host."
        ) from None


def _main() -> None:
    options.call(serve, __doc__, "--map place.hlm --port 8000")


if __name__ == "__main__":
    cli.run(_main)
