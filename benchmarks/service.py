"""Ask the HTTP service for many poses, several at a time, and watch its memory.

Starts `python -m hloc_reduce.serve`, sends it the photos of a folder again and again, and prints a
Markdown table: the memory of the service, and its answers a second, after a number of answers.
"""

import json
import os
import socket
import subprocess
import sys
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from urllib.error import HTTPError, URLError
from urllib.request import Request, urlopen

from hloc_reduce.utils import cli
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.images import list_images

ROWS = 10  # of the table
START_SECONDS = 60


def answer_of(url: str, photo: bytes) -> str:
    """Send a photo and tell what became of it."""
    try:
        with urlopen(Request(url + "/localize", photo), timeout=600) as answer:
            return "localized" if json.loads(answer.read())["localized"] else "not localized"
    except HTTPError as error:
        return f"status {error.code}"


def resident(pid: int) -> float:
    """Return the resident size of a process in 1,000,000 bytes."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def wait(url: str, service: subprocess.Popen) -> None:
    """Wait until the service answers."""
    for _ in range(10 * START_SECONDS):
        try:
            urlopen(url + "/health", timeout=5).close()
            return
        except URLError:
            if service.poll() is not None:
                break
            time.sleep(0.1)
    raise InputError("The service did not start, see above.")


def _main() -> None:
    parser = cli.Parser(__doc__, "--map place.hlm --query_images photos")
    parser.add_argument("--map", type=Path, required=True, help="file of hloc_reduce.compact")
    parser.add_argument("--query_images", type=Path, required=True, help="folder of photos")
    parser.add_argument("--requests", type=int, default=1000, help="number of requests")
    parser.add_argument("--clients", type=int, default=8, help="that ask at the same time")
    args = parser.parse_args()
    cli.check_positive(args, "requests", "clients")
    photos = [(args.query_images / name).read_bytes() for name in list_images(args.query_images)]
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [sys.executable, "-m", "hloc_reduce.serve", "--map", args.map, "--port", str(port)]
    service = subprocess.Popen(command)
    url = f"http://127.0.0.1:{port}"
    try:
        wait(url, service)
        print(f"Started with {resident(service.pid):.0f} MB.\n\n| answers | MB | a second |")
        print("| ---: | ---: | ---: |")
        answers: Counter[str] = Counter()
        sent = [photos[i % len(photos)] for i in range(args.requests)]
        start, size = time.perf_counter(), -(-args.requests // ROWS)
        with ThreadPoolExecutor(args.clients) as pool:
            for number, found in enumerate(pool.map(lambda p: answer_of(url, p), sent), 1):
                answers[found] += 1
                if number % size == 0 or number == args.requests:
                    rate = number / (time.perf_counter() - start)
                    print(f"| {number:,} | {resident(service.pid):.0f} | {rate:.2f} |", flush=True)
        print("\n" + ", ".join(f"{found}: {number:,}" for found, number in answers.items()))
    finally:
        service.terminate()
        service.wait()


if __name__ == "__main__":
    cli.run(_main)
