"""Time a Localizer on photos, one at a time, stage by stage, from the start of Python.

Also prints the memory of the process, and how many photos are localized, with how many inliers. It
imports torch only if the map's feature needs it. With --place, it adds a row to
results/localizer.csv.
"""

import resource
import time
from pathlib import Path

START = time.perf_counter()

from hloc_reduce.utils import cli  # noqa: E402
from hloc_reduce.utils.images import list_images  # noqa: E402
from hloc_reduce.utils.progress import progress  # noqa: E402

STAGES = ("extraction", "retrieval", "matching", "pose", "mirror_image")


def megabytes() -> float:
    """Return the largest resident size of this process so far, in 1,000,000 bytes."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6


def _main() -> None:
    parser = cli.Parser(__doc__, "--map place.hlm --query_images photos")
    parser.add_argument(
        "--map",
        type=Path,
        required=True,
        help="map folder of pipelines.localize, or file of hloc_reduce.compact",
    )
    parser.add_argument("--query_images", type=Path, required=True, help="folder of photos")
    parser.add_argument("--queries", type=Path, help="their lists with intrinsics, a glob")
    parser.add_argument("--onnx", type=Path, help="the map's feature, from hloc_reduce.export")
    parser.add_argument("--place", help="what a row calls the place; default: no row")
    args = parser.parse_args()
    from hloc_reduce import Localizer
    from hloc_reduce.utils.parsers import parse_query_lists

    if args.queries:
        photos = [query for part in parse_query_lists(args.queries).values() for query in part]
    else:
        photos = [(name, None) for name in list_images(args.query_images)]
    localizer = Localizer(args.map, onnx=args.onnx)
    opened = time.perf_counter() - START
    localizer.localize(args.query_images / photos[0][0], photos[0][1])
    first = time.perf_counter() - START
    print(
        f"Map of {len(localizer.names)} images. Opened {opened:.2f} s after the start of Python, "
        f"first photo localized after {first:.2f} s, {megabytes():.0f} MB."
    )
    rows, inliers = [], []
    for name, camera in progress(photos, "Localizing", "photo"):
        pose, info = localizer.localize(args.query_images / name, camera)
        seconds = [info["seconds"].get(stage, 0.0) for stage in STAGES]
        rows.append([*seconds, sum(seconds), sum(seconds[1:])])
        inliers += [info["num_inliers"]] if pose is not None else []
    mean = sum(inliers) / (len(inliers) or 1)
    print(
        f"{len(inliers)} of {len(photos)} photos localized, {mean:.0f} inliers on average, "
        f"at most {megabytes():.0f} MB.\n"
    )
    print(f"| milliseconds | {' | '.join(STAGES)} | all | all but extraction |")
    print("| --- |" + " ---: |" * (len(STAGES) + 2))
    columns = [sorted(column) for column in zip(*rows, strict=True)]
    for name, reduce in (
        ("mean", lambda column: sum(column) / len(column)),
        ("median", lambda column: column[len(column) // 2]),
        ("max", max),
    ):
        print(f"| {name} | {' | '.join(f'{1000 * reduce(column):.0f}' for column in columns)} |")
    if args.place:
        resident, means = megabytes(), [1000 * sum(column) / len(column) for column in columns]
        from benchmarks import rows as results
        from hloc_reduce.hlm.reader import CompactMap, is_compact
        from hloc_reduce.maps.map import Map
        from hloc_reduce.runtime import parallel

        opened_map = CompactMap(args.map) if is_compact(args.map) else Map(args.map)
        cores = parallel.cores()
        how = f"{'given' if args.queries else 'inferred'} intrinsics{', ONNX' * bool(args.onnx)}"
        cells = {"place": args.place, "feature": opened_map.feature, "storage": opened_map.storage}
        cells["variant"] = f"{how}, {cores} core{'s' * (cores > 1)}"
        cells |= {"photos": len(localizer.names), "queries": len(photos)}
        cells |= {"localized": len(inliers), "inliers": mean, "resident_mb": resident}
        cells |= {"open_s": opened, "first_s": first}
        names = (*STAGES, "all", "beyond_extraction")
        cells |= {f"{name}_ms": value for name, value in zip(names, means, strict=True)}
        results.add("localizer", [cells | results.how(cores=cores)])


if __name__ == "__main__":
    cli.run(_main)
