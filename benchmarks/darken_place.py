"""Make a place with strongly darkened queries, in the layout of Aachen Day-Night, from a map.

Every third photo of the map becomes a query, the others stay the map. Each query is exposed 2 to 4
stops less: linear light, shot and read noise, 8 bits; noise and exposure come from a seed.
Run pipelines.aachen on the result, and benchmarks/summaries.py on its outputs.
"""

import argparse
import shutil
from pathlib import Path

import cv2
import numpy as np

from hloc_reduce import cli, colmap
from hloc_reduce.datasets import Aachen
from hloc_reduce.training.__main__ import parse_maps

EVERY = 3
STOPS = (2.0, 4.0)
GAMMA = 2.2
SHOT_NOISE, READ_NOISE = 0.01, 0.002  # of full exposure, in linear light


def darken(image: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """Expose an 8-bit image less, as another 8-bit image."""
    light = (image / 255) ** GAMMA * 0.5 ** generator.uniform(*STOPS)
    noise = np.sqrt(SHOT_NOISE**2 * light + READ_NOISE**2)
    light = light + noise * generator.standard_normal(light.shape)
    return np.round(255 * light.clip(0, 1) ** (1 / GAMMA)).astype(np.uint8)


def main(images: Path, model: Path, output: Path) -> None:
    """Write the place."""
    reconstruction = colmap.read_model(model)
    photos = sorted(reconstruction.images.values(), key=lambda image: image.name)
    queries = photos[EVERY // 2 :: EVERY]
    lines, poses = [], []
    for number, photo in enumerate(queries):
        name = Path("query") / Path(photo.name).with_suffix(".png")
        target = output / "images_upright" / name
        target.parent.mkdir(parents=True, exist_ok=True)
        generator = np.random.default_rng(number)
        cv2.imwrite(str(target), darken(cv2.imread(str(images / photo.name)), generator))
        camera, pose = photo.camera, photo.cam_from_world()
        size_and_params = (camera.width, camera.height, *camera.params.tolist())
        lines.append(f"{name} {camera.model.name} {' '.join(map(repr, size_and_params))}\n")
        x, y, z, w = pose.rotation.quat.tolist()
        numbers = (w, x, y, z, *pose.translation.tolist())
        poses.append(f"{name} {' '.join(map(repr, numbers))}\n")
    for photo in queries:
        reconstruction.deregister_frame(photo.frame_id)
    for photo in photos:
        if photo.has_pose:
            target = output / "images_upright" / "db" / photo.name
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(images / photo.name, target)
            photo.name = f"db/{photo.name}"
    folder = output / "3D-models/aachen_v_1_1"
    folder.mkdir(parents=True, exist_ok=True)
    reconstruction.write_binary(folder)
    (output / "queries").mkdir(exist_ok=True)
    listed = output / "queries/night_time_queries_with_intrinsics.txt"
    listed.write_text("".join(lines))
    (output / "queries/ground_truth_poses.txt").write_text("".join(poses))
    place = Aachen(output)
    print(f"{output}: {len(place.map_names())} map photos, {len(queries)} queries")


def _main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__,
        epilog="example: python benchmarks/darken_place.py --map sceaux/images:sceaux/sparse "
        "--output datasets/sceaux_dark",
        formatter_class=cli.HelpFormatter,
    )
    parser.add_argument("--map", required=True, metavar="IMAGES:MODEL")
    parser.add_argument("--output", type=Path, required=True, help="new folder of the place")
    args = parser.parse_args()
    [(images, model)] = parse_maps([args.map]).values()
    main(images, model, args.output)


if __name__ == "__main__":
    cli.run(_main)
