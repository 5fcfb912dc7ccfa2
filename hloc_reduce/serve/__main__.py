"""Command line of `hloc_reduce.serve`."""

import asyncio
import os
from pathlib import Path

from .. import logger
from ..utils import cli
from ..utils.cli import InputError
from . import MAX_MB, QUEUE, __doc__, make_app

MAX_PORT = 65_535
UPLOADS = 32  # connections beside those that wait


def _main() -> None:
    parser = cli.Parser(__doc__, "--map place.hlm --port 8000")
    add = parser.add_argument
    add("--map", type=Path, required=True, help="map folder, or file of hloc_reduce.compact")
    add("--onnx", type=Path, help="the map's feature, from hloc_reduce.export: needs no torch")
    add("--host", default="127.0.0.1", help="address to listen on; 0.0.0.0 for all networks")
    add("--port", type=int, default=8000, help="port to listen on")
    add("--num_loc", type=int, default=50, help="retrieved map images per photo")
    add("--max_mb", type=float, default=MAX_MB, help="largest photo in 1,000,000 bytes")
    add("--queue", type=int, default=QUEUE, help="requests that may wait; others get status 503")
    args = parser.parse_args()
    cli.check_positive(args, "num_loc", "queue", "port")
    if not args.max_mb > 0:
        raise InputError(f"--max_mb {args.max_mb:g}: it must be above 0.")
    if args.port > MAX_PORT:
        raise InputError(f"--port {args.port}: at most {MAX_PORT}.")
    try:
        import uvicorn
    except ImportError:
        raise InputError("The service needs: pip install 'hloc-reduce[serve]'.") from None
    from ..maps.localizer import Localizer

    check_address(args.host, args.port)  # before the map is loaded
    localizer = Localizer(args.map, args.num_loc, onnx=args.onnx)
    logger.info("Serving %s at http://%s:%d.", args.map, args.host, args.port)
    app = make_app(localizer, args.max_mb, args.queue)
    # photos that are being uploaded are in memory, too
    most = args.queue + UPLOADS
    address = {"host": args.host, "port": args.port}
    uvicorn.run(app, **address, log_level="warning", limit_concurrency=most, timeout_keep_alive=30)


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


if __name__ == "__main__":
    cli.run(_main)
