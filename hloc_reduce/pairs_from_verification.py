"""Add pairs of images that the verified matches of a list of pairs connect poorly."""

from collections import Counter, defaultdict
from collections.abc import Iterable
from itertools import islice
from pathlib import Path
from typing import Annotated

import numpy as np
import pycolmap

from . import logger
from .mapping import database as databases
from .mapping.checks.overlays import drop_overlays
from .mapping.database import verified_by
from .retrieval.ranking import rank, read_global, similarity
from .triangulation import Pair, read_matches
from .utils import cli, colmap, options
from .utils.cli import InputError
from .utils.files import replacing
from .utils.h5 import list_h5_names
from .utils.images import list_images
from .utils.options import Option
from .utils.parsers import parse_pairs, write_pairs
from .utils.paths import strings_as_paths

MIN_INLIERS = 15  # verified matches of a connected pair, COLMAP's min_num_matches
MIN_PAIRS = 3  # connected pairs of a well connected image
IMAGES_PER_BLOCK = 256  # whose similarity to all others is in memory at once


@strings_as_paths
def main(
    output: Path,
    image_dir: Path,
    pairs: Path,
    features: Path,
    matches: Path,
    descriptors: Path,
    num_matched: int,
    num_covis: int = 0,
    camera_mode: colmap.CameraMode = pycolmap.CameraMode.AUTO,
    image_list: Path | str | Iterable[str] | None = None,
    rigs: Annotated[Path, Option(metavar="rig_config.json")] | None = None,
    image_options: dict | None = None,
) -> Path:
    """Write a list of pairs, and more pairs of poorly connected images.

    COLMAP verifies the matches by two-view geometry. Images outside the largest connected component
    are paired with the most similar images of other components, and images with few verified pairs
    with any similar ones. Images with common verified neighbours probably see the same points, so
    they are paired too.
    `<matches>_verified.db` keeps the results, so that neither a second call nor `reconstruction`
    verifies a pair again.

    Args:
        output: text file of pairs: those of `pairs`, then the new ones.
        image_dir: folder of the images.
        pairs: text file of matched pairs.
        features: feature file.
        matches: match file, with all of `pairs`.
        descriptors: h5 file of global descriptors.
        num_matched: maximum number of new pairs of a poorly connected image with similar images,
            and again with neighbours of its neighbours.
        num_covis: maximum number of new pairs of any other image with neighbours of its neighbours.
        camera_mode: which photos share a camera.
        image_list: text file of names, one per line (in Python, also the names); default: the
            images of `features`.
        rigs: COLMAP's file of cameras that are fixed to each other, which may tell intrinsics.
        image_options: of pycolmap's ImageReaderOptions.

    Returns:
        `output`.

    Raises:
        InputError: when an input is missing or wrong.
    """
    if num_matched < 1:
        raise InputError(f"num_matched is {num_matched}: at least 1.")
    if num_covis < 0:
        raise InputError(f"num_covis is {num_covis}: at least 0.")
    for path in (pairs, features, matches):
        if not path.is_file():
            raise InputError(f"There is no file {path}.")
    names = list_images(image_dir, list_h5_names(features) if image_list is None else image_list)
    listed = list(dict.fromkeys(_unordered(*pair) for pair in parse_pairs(pairs)))
    if unknown := {name for pair in listed for name in pair}.difference(names):
        raise InputError(f"{pairs}: {min(unknown)} is not in the list of images.")
    keypoints, _, found = read_matches(names, pairs, features, matches, None)
    database = verified_by(matches)
    with replacing(database) as temporary:
        databases.write(
            temporary,
            image_dir,
            keypoints,
            drop_overlays(keypoints, found),
            camera_mode,
            known=database,
            image_options=image_options,
            rigs=rigs,
        )
    verified = colmap.count_verified(database)
    connected = {_unordered(*pair): n for pair, n in verified.items() if n >= MIN_INLIERS}
    global_descriptors = read_global(descriptors, names)
    new = more_pairs(names, set(listed), connected, global_descriptors, num_matched, num_covis)
    write_pairs([*listed, *new], output)
    logger.info("Added %d pairs to %d.", len(new), len(listed))
    return output


def more_pairs(
    names: list[str],
    listed: set[Pair],
    connected: dict[Pair, int],
    descriptors: np.ndarray,
    num_matched: int,
    num_covis: int = 0,
) -> list[Pair]:
    """Find pairs that may connect images better.

    Args:
        names: the images.
        listed: known pairs, each sorted.
        connected: from connected pair to its number of verified matches.
        descriptors: (N, G) global descriptors of the images.
        num_matched: maximum number of new pairs of a poorly connected image with similar images,
            and again with neighbours of its neighbours.
        num_covis: maximum number of new pairs of any other image with neighbours of its neighbours.

    Returns:
        New pairs, each sorted.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    index = {name: i for i, name in enumerate(names)}
    rows, columns = np.array([(index[a], index[b]) for a, b in connected]).reshape(-1, 2).T
    graph = coo_array((np.ones(len(rows)), (rows, columns)), (len(names),) * 2)
    _, component = connected_components(graph, directed=False)
    sizes, degrees = np.bincount(component), Counter(rows.tolist() + columns.tolist())
    apart = component != sizes.argmax()
    weak = [i for i in range(len(names)) if apart[i] or degrees[i] < MIN_PAIRS]
    logger.info(
        "%d components of verified pairs, the largest of %d of %d images; %d images have fewer "
        "than %d verified pairs.",
        len(sizes),
        sizes.max(),
        len(names),
        sum(degrees[i] < MIN_PAIRS for i in weak),
        MIN_PAIRS,
    )
    limits = dict.fromkeys(names, num_covis) | {names[i]: num_matched for i in weak}
    found = dict.fromkeys(_by_neighbours(limits, listed, connected))
    for start in range(0, len(weak), IMAGES_PER_BLOCK):
        block = weak[start : start + IMAGES_PER_BLOCK]
        ranking = rank(similarity(descriptors[block], descriptors), len(names))
        for i, row in zip(block, ranking, strict=True):
            others = (
                _unordered(names[i], names[j])
                for j in row
                if i != j and not (apart[i] and component[i] == component[j])
            )
            new = (pair for pair in others if pair not in listed)
            found |= dict.fromkeys(islice(new, num_matched))
    return list(found)


def _by_neighbours(
    limits: dict[str, int], listed: set[Pair], connected: dict[Pair, int]
) -> list[Pair]:
    """Pair images with neighbours of their neighbours, most verified matches first."""
    neighbours: dict[str, dict[str, int]] = defaultdict(dict)
    for (a, b), number in connected.items():
        neighbours[a][b] = neighbours[b][a] = number
    found: list[Pair] = []
    for name, limit in limits.items():
        scores: Counter[Pair] = Counter()
        for between, number in neighbours[name].items():
            for other, other_number in neighbours[between].items():
                pair = _unordered(name, other)
                if other != name and pair not in listed:
                    scores[pair] += min(number, other_number)
        best = sorted(scores, key=lambda pair: (-scores[pair], pair))
        found += best[:limit]
    return found


def _unordered(name0: str, name1: str) -> Pair:
    """Return a pair in the order of the names."""
    return (name0, name1) if name0 < name1 else (name1, name0)


def _main() -> None:
    example = (
        "--output more.txt --image_dir photos --pairs pairs.txt --features features.h5 "
        "--matches matches.h5 --descriptors global.h5"
    )
    options.call(main, __doc__, example, num_matched=20)


if __name__ == "__main__":
    cli.run(_main)
