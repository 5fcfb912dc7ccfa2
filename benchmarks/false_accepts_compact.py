"""Count wrong poses that are accepted in compact maps.

Each map has two thirds of the photos of a COLMAP model. It is packed, and tried with its other
photos, with these mirrored, and with photos of the other places, all without intrinsics. Prints a
Markdown table; an interrupted run resumes with the next place.
"""

import argparse
from pathlib import Path

import numpy as np
import pycolmap

from hloc_reduce import Localizer, compact, maps
from hloc_reduce.runtime import provenance
from hloc_reduce.training.tracks import parse_maps
from hloc_reduce.utils import cli, colmap
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.codes import STORAGES
from hloc_reduce.utils.images import list_images, read_image
from hloc_reduce.utils.progress import progress

EVERY = 3  # photos, of which one is held out
WRONG = 0.05, 4.0  # of the median depth of the inliers, degrees
COLUMNS = ("place", "own", "localized", "wrong", "mirrored", "localized", "others", "localized")


def build(
    images: Path, model: Path, path: Path, args: argparse.Namespace
) -> dict[str, pycolmap.Rigid3d]:
    """Pack a map of two thirds of the photos of a model; return the poses of the others."""
    photos = sorted(colmap.read_model(model).images.values(), key=lambda image: image.name)
    held_out = {photo.name: photo.cam_from_world() for photo in photos[1::EVERY]}
    kept = {photo.name for photo in photos} - held_out.keys()
    part = colmap.write_part(model, kept, path.parent / "model")
    built = maps.main(path.parent / "map", images, part, feature=args.feature)
    compact.main(path, built.folder, storage=args.storage, max_mb=args.max_mb)
    return held_out


def is_wrong(pose: pycolmap.Rigid3d, info: dict, truth: pycolmap.Rigid3d) -> bool:
    """Tell whether a pose is off by more than a share of the distance, or degrees."""
    difference = pose * truth.inverse()
    inliers = info["points3D"][info["inliers"]]
    depth = np.median((truth * inliers)[:, 2])
    moved = np.linalg.norm(pose.inverse().translation - truth.inverse().translation)
    return moved > WRONG[0] * depth or np.degrees(difference.rotation.angle()) > WRONG[1]


def try_place(
    name: str, places: dict[str, tuple[Path, Path]], path: Path, args: argparse.Namespace
) -> dict[str, int]:
    """Localize photos in the compact map of a place, written to a path, and count."""
    images, model = places[name]
    truth = build(images, model, path, args)
    localizer = Localizer(path)
    generator = np.random.default_rng(0)
    own = generator.permutation(sorted(truth))[: args.trials].tolist()
    same = next(({*group} for group in args.same if name in group), {name})
    others = [
        folder / other
        for key, (folder, _) in places.items()
        if key not in same
        for other in generator.permutation(list_images(folder))[: args.trials]
    ]
    counts = {"own": len(own), "own localized": 0, "own wrong": 0, "mirrored": len(own)}
    counts |= {"mirrored localized": 0, "others": len(others), "others localized": 0}
    for photo in progress(own, f"Own photos of {name}", "photo"):
        pixels = read_image(images / photo)
        pose, info = localizer.localize(pixels)
        if pose is not None:
            counts["own localized"] += 1
            counts["own wrong"] += bool(is_wrong(pose, info, truth[photo]))
        flipped, _ = localizer.localize(np.ascontiguousarray(pixels[:, ::-1]))
        counts["mirrored localized"] += flipped is not None
    for other in progress(others, f"Photos of others in {name}", "photo"):
        counts["others localized"] += localizer.localize(read_image(other))[0] is not None
    return counts


def _main() -> None:
    parser = cli.Parser(
        __doc__,
        "--map scenes/fox/images:scenes/fox/sparse "
        "--map scenes/cyprus/images:scenes/cyprus/sparse --feature colmap_sift_sv32",
    )
    parser.add_argument(
        "--map", action="append", default=[], metavar="IMAGES:MODEL", help="may be repeated"
    )
    parser.add_argument(
        "--same",
        nargs="+",
        action="append",
        default=[],
        metavar="PLACE",
        help="places that see each other, whose photos are not tried as wrong ones",
    )
    parser.add_argument("--feature", default="colmap_sift_sv32", help="local feature")
    parser.add_argument("--storage", choices=STORAGES, help="of the points; as hloc_reduce.compact")
    parser.add_argument("--max_mb", type=float, help="largest size of a file; all points if absent")
    parser.add_argument("--trials", type=int, default=12, help="photos of each place, per map")
    parser.add_argument("--output", type=Path, default=Path("outputs/false_accepts_compact"))
    args = parser.parse_args()
    cli.check_positive(args, "trials")
    if args.max_mb is not None and not args.max_mb > 0:
        raise InputError(f"--max_mb {args.max_mb}: it must be above 0.")
    places = parse_maps(args.map)
    if len(places) < 2:
        raise InputError("Give two or more --map.")
    print(f"| {' | '.join(COLUMNS)} |\n| --- |{' ---: |' * (len(COLUMNS) - 1)}")
    sums = np.zeros(len(COLUMNS) - 1, int)
    for name in places:
        kind = "".join(f"-{option}" for option in (args.storage, args.max_mb) if option)
        path = args.output / args.feature / name / f"place{kind}.hlm"
        file = path.with_name(f"counts-{args.trials}{kind}.json")
        tried = {"places": sorted(places), "same": args.same}
        if provenance.read(file).get("tried") != tried:
            counts = try_place(name, places, path, args)
            provenance.write(file, {"tried": tried, "counts": counts})
        row = [*provenance.read(file)["counts"].values()]
        sums += row
        print(f"| {name} | {' | '.join(map(str, row))} |", flush=True)
    print(f"| all | {' | '.join(map(str, sums))} |")


if __name__ == "__main__":
    cli.run(_main)
