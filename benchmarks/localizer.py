"""Time a Localizer on photos, one at a time, stage by stage."""

from pathlib import Path

import numpy as np
import torch

from hloc_reduce import Localizer
from hloc_reduce.utils import cli
from hloc_reduce.utils.images import list_images
from hloc_reduce.utils.progress import progress

STAGES = ("extraction", "retrieval", "matching", "pose")


def _main() -> None:
    parser = cli.Parser(__doc__, "--map outputs/place/map --query_images photos")
    parser.add_argument("--map", type=Path, required=True, help="map of pipelines.localize")
    parser.add_argument("--query_images", type=Path, required=True, help="folder of photos")
    args = parser.parse_args()
    localizer = Localizer(args.map)
    photos = [args.query_images / name for name in list_images(args.query_images)]
    localizer.localize(photos[0])  # warm up
    seconds = []
    for photo in progress(photos, "Localizing", "photo"):
        _, info = localizer.localize(photo)
        seconds.append([info["seconds"][stage] for stage in STAGES])
    seconds = np.array(seconds)
    keypoints = np.mean([len(descriptors) for descriptors in localizer.descriptors.values()])
    print(
        f"{len(photos)} photos, map of {len(localizer.names)} with {keypoints:.0f} keypoints each, "
        f"{torch.get_num_threads()} threads"
    )
    print("| seconds | " + " | ".join(STAGES) + " | all but extraction |")
    print("| --- |" + " ---: |" * (len(STAGES) + 1))
    for name, reduce in (("mean", np.mean), ("median", np.median), ("max", np.max)):
        cells = [*reduce(seconds, axis=0), reduce(seconds[:, 1:].sum(axis=1))]
        print(f"| {name} | " + " | ".join(f"{cell:.3f}" for cell in cells) + " |")


if __name__ == "__main__":
    cli.run(_main)
