"""Compare a map of a COLMAP database with one of the photos, by the inliers of queries.

Makes the database with COLMAP's default options from the photos of a model, triangulates them with
the poses of the model, builds both maps and localizes the queries in them.
"""

import csv
import shutil
from pathlib import Path

import numpy as np
import pycolmap

from hloc_reduce.utils import cli, colmap
from pipelines import localize


def make(images: Path, model: Path, folder: Path) -> tuple[Path, Path]:
    """Return a database of the images of a model, and a model with COLMAP's points."""
    database, sparse = folder / "database.db", folder / "sparse"
    if (sparse / "points3D.bin").exists():
        return database, sparse
    shutil.rmtree(folder, ignore_errors=True)
    sparse.mkdir(parents=True)
    reference = colmap.read_model(model)
    colmap.write_reference(database, reference)
    names = [image.name for image in reference.images.values()]
    pycolmap.extract_features(database, images, image_names=names, device=pycolmap.Device.cpu)
    pycolmap.match_exhaustive(database, device=pycolmap.Device.cpu)
    pycolmap.triangulate_points(reference, database, images, sparse)
    return database, sparse


def main() -> None:
    """Print a line for each map."""
    parser = cli.Parser(
        __doc__, "--images photos --model sparse --query_images new --outputs outputs/compared"
    )
    for name in ("images", "model", "query_images", "outputs"):
        parser.add_argument(f"--{name}", type=Path, required=True)
    parser.add_argument("--queries", type=Path, help="query list, or a glob of several")
    parser.add_argument("--ground_truth", type=Path, help="true poses of the queries")
    args = parser.parse_args()
    database, sparse = make(args.images, args.model, args.outputs / "colmap")
    maps = {
        "photos": {"model_or_map": args.model, "map_images": args.images},
        "database": {"model_or_map": sparse, "database": database},
    }
    for name, options in maps.items():
        outputs = args.outputs / name
        built = localize.open_map(outputs, **options)
        results = outputs / "queries"
        localize.main(
            built, args.query_images, results, args.queries, ground_truth=args.ground_truth
        )
        with (results / "queries.csv").open(newline="") as file:
            rows = list(csv.DictReader(file))
        found = [row for row in rows if row["status"] == "localized"]
        inliers = sum(int(row["num_inliers"]) for row in found) / len(rows)
        errors = [float(row["position_error_m"]) for row in found if row.get("position_error_m")]
        median = f"{100 * np.median(errors):.2f} cm" if errors else ""
        print(f"{name:10} {len(found)}/{len(rows)} {inliers:8.1f} {median} {built.num_points3D}")


if __name__ == "__main__":
    cli.run(main)
