"""Compare the features of other projects, extracted by their own code, with this project's.

Clone the other projects first: https://github.com/HITCSC/EdgePoint2 or
https://github.com/SJTU-ViSYS/FeatureBooster. EdgePoint2 runs at the image size and the keypoint
limit of this project's `edgepoint2_m32`, which also reduces the noise of noisy photos.
FeatureBooster's SIFT+Boost-B describes the keypoints of `colmap_sift` by 256 bits, stored as floats
of +-1/16, whose distances rank as Hamming distances do. Maps the places of --dataset with each
feature and localizes their queries, all with NN-mutual. Prints a Markdown table. The seconds of
extraction are the median of some photos, including reading the file.
"""

import contextlib
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import torch
from summaries import COLUMNS, rows
from torch.nn.functional import normalize

from hloc_reduce import extractors
from hloc_reduce.confs import features
from hloc_reduce.detectors import dog
from hloc_reduce.extractors import Detect, Extractor
from hloc_reduce.extractors.edgepoint2 import EdgePoint2
from hloc_reduce.utils import cli
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.codes import STORAGES
from hloc_reduce.utils.parsers import read_yaml
from hloc_reduce.utils.tables import joined
from pipelines.layouts import pipeline_of

# the repository, and the code and the weights in a clone
EDGEPOINT2 = "HITCSC/EdgePoint2", "edgepoint2.py", "weights/*.pth"
FEATUREBOOSTER = "SJTU-ViSYS/FeatureBooster", "featurebooster.py", "models/*.pth"
CONFIG = "config.yaml"  # of FeatureBooster
BOOSTED = "SIFT+Boost-B"
BYTES = {BOOSTED: "32"}  # of packed bits
MATCHER = "NN-mutual"
CENTIMETRES = [1.0, 2.0, 5.0, 25.0]
SHOWN = (
    *("feature", "bytes", "list", "keypoints", "points", "mean inliers", "localized"),
    *("recall [%]", "median error", "extraction [s]"),
)


class Peer(Extractor):
    """The features of a clone of another project.

    `weights` names those of EdgePoint2, or is `BOOSTED`.
    """

    default_conf = {"folder": "", "weights": ""}

    def _init(self, conf: dict) -> None:
        folder, weights = conf["folder"], conf["weights"]
        self.is_boosted = weights == BOOSTED
        if self.is_boosted:
            self.detect: Detect = dog.detector(dog.CONF)
        sys.path.insert(0, folder)
        try:
            with contextlib.chdir(folder):
                self.network = (_featurebooster if self.is_boosted else _edgepoint2)(weights)
        except InputError:
            raise
        except Exception as error:  # whatever the code of others raises
            said = str(error).strip().partition("\n")[0]
            reason = f"{type(error).__name__}: {said}"
            raise InputError(f"{folder}: {weights} cannot be loaded ({reason})") from None
        finally:
            sys.path.remove(folder)

    def _forward(self, data: dict) -> dict:
        if self.is_boosted:
            return self._boosted(data["image"], *data["detected"])
        found = self.network(data["image"])[0]
        found["descriptors"] = found["descriptors"].T
        return {key: value[None] for key, value in found.items()}

    def _boosted(self, image: torch.Tensor, *detected: np.ndarray) -> dict:
        height, width = image.shape[2:]
        keypoints, described = (torch.from_numpy(array).to(image.device) for array in detected)
        x_y, scales, oris = keypoints.split([2, 1, 1], dim=1)
        centred = (x_y - x_y.new_tensor([width, height]) / 2) / (0.7 * max(width, height))
        where = torch.cat([centred, scales, oris.deg2rad()], dim=1)
        sift = normalize(described.square(), dim=1)  # from RootSIFT
        signs = torch.where(self.network(sift, where) >= 0, 1.0, -1.0)
        return {
            "keypoints": x_y[None],
            "scores": scales.T,
            "scales": scales.T,
            "oris": oris.T,
            "descriptors": normalize(signs, dim=1).T[None],
        }


def _edgepoint2(weights: str) -> torch.nn.Module:
    from edgepoint2 import EdgePoint2Wrapper

    return EdgePoint2Wrapper(weights, EdgePoint2.default_conf["max_keypoints"])


def _featurebooster(weights: str) -> torch.nn.Module:
    from featurebooster import FeatureBooster

    network = FeatureBooster(read_yaml(Path(CONFIG))[weights])
    network.load_state_dict(torch.load(f"models/{weights}.pth", "cpu"))
    return network


def add(folder: Path, weights: str) -> str:
    """Add the feature of a clone to this project's features, and return its name.

    Raises:
        InputError: when the folder is not a clone, or has no such weights.
    """
    is_boosted = weights == BOOSTED
    repository, code, files = FEATUREBOOSTER if is_boosted else EDGEPOINT2
    if not folder.is_dir():
        raise cli.no_folder(folder)
    for part in (code, files, *([CONFIG] if is_boosted else [])):
        if not any(folder.glob(part)):
            raise InputError(f"{folder} has no {part}: clone github.com/{repository}.")
    cli.choose("weights", weights, sorted(path.stem for path in folder.glob(files)))
    name = weights if is_boosted else f"EdgePoint2-{weights}"
    # an extractor is named by its module
    model = {"name": Path(__file__).stem, "folder": str(folder.resolve()), "weights": weights}
    preprocessing = features.PREPROCESSING if is_boosted else features.IN_COLOUR
    conf = {"output": f"feats-{name}", "model": model, "preprocessing": preprocessing}
    features.confs[name] = conf
    return name


def configuration(feature: str, storage: str) -> dict:
    """Return the configuration of a feature after a check that it works.

    Raises:
        InputError: when it does not.
    """
    _, conf = features.get(feature, storage=storage)
    features.levels(conf)  # which some storages need
    extractors.load(conf["model"])
    return conf


def seconds(conf: dict, photos: list[Path]) -> float:
    """Measure the median seconds of the extraction of a photo, after one for warming up."""
    model, taken = extractors.load(conf["model"]).eval(), []
    for photo in photos[:1] + photos:
        start = time.perf_counter()
        extractors.extract(model, photo, conf["preprocessing"])
        taken.append(time.perf_counter() - start)
    return float(np.median(taken[1:]))


def _main() -> None:
    parser = cli.Parser(__doc__, "--dataset herz-jesus --edgepoint2 EdgePoint2")
    option = parser.add_argument
    option("--dataset", type=Path, nargs="+", required=True, help="in Aachen's or InLoc's layout")
    option("--edgepoint2", type=Path, help="clone of EdgePoint2")
    option("--weights", nargs="+", default=["M32", "M64"], help="of EdgePoint2")
    option("--featurebooster", type=Path, help="clone of FeatureBooster")
    option("--feature", nargs="+", default=[], help="of this project; with a storage: mini64:uint2")
    option("--photos", type=int, default=10, help="photos at most whose extraction is timed")
    option("--threads", type=int, default=2, help="threads of torch and OpenCV")
    option("--outputs", type=Path, default=Path("outputs/peers"), help="folder for the results")
    option("--overwrite", action="store_true", help="recompute existing results")
    args = parser.parse_args()
    cli.check_positive(args, "photos", "threads")
    places = {place: pipeline_of(place).Place(place) for place in args.dataset}
    extractors.__path__.append(str(Path(__file__).parent))
    names = list(args.feature)
    if args.edgepoint2:
        names += [add(args.edgepoint2, weights) for weights in args.weights]
    if args.featurebooster:
        names.append(add(args.featurebooster, BOOSTED))
    if not names:
        raise InputError("Nothing to compare: give --edgepoint2, --featurebooster or --feature.")
    parts = {name: name.partition(":")[::2] for name in names}
    given = {name: (feature, storage or STORAGES[0]) for name, (feature, storage) in parts.items()}
    confs = {name: configuration(*given[name]) for name in names}
    cli.check_folder(args.outputs)
    torch.set_num_threads(args.threads)
    cv2.setNumThreads(args.threads)
    heading = " | ".join(SHOWN).replace("[%]", f"[%] at {joined(CENTIMETRES, 'g')} cm")
    print(f"| {heading} |\n| {' | '.join(COLUMNS[key] for key in SHOWN)} |", flush=True)
    for dataset, place in places.items():
        listed = [*place.map_names(), *place.query_names()]
        photos = [place.images / name for name in listed[:: -(-len(listed) // args.photos)]]
        for name, conf in confs.items():
            feature, storage = given[name]
            folder = f"{Path(feature).stem}+{storage}"
            outputs = args.outputs / Path(*dataset.resolve().parts[-2:], folder)
            settings = {"matcher": MATCHER, "storage": storage, "overwrite": args.overwrite}
            pipeline_of(dataset).main(dataset, outputs, feature, **settings)
            taken = f"{seconds(conf, photos):.2f}"
            for row in rows(outputs, CENTIMETRES):
                row |= {
                    "feature": "`" + name.replace(":", "`, `") + "`",
                    "bytes": BYTES.get(name, row["bytes"]),
                    "list": f"{dataset}, {row['list']}",
                    "extraction [s]": taken,
                }
                print(f"| {' | '.join(row[key] for key in SHOWN)} |", flush=True)


if __name__ == "__main__":
    cli.run(_main)
