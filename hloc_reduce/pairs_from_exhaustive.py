"""Pair all images of a list or a feature file with each other, or with reference images."""

from collections.abc import Iterable
from itertools import combinations, product
from pathlib import Path

from . import logger
from .utils import cli, options
from .utils.cli import InputError
from .utils.h5 import list_h5_names
from .utils.parsers import check_names, image_names, write_pairs
from .utils.paths import strings_as_paths


@strings_as_paths
def main(
    output: Path,
    image_list: Path | str | Iterable[str] | None = None,
    features: Path | None = None,
    ref_list: Path | str | Iterable[str] | None = None,
    ref_features: Path | None = None,
) -> Path:
    """Write all pairs of images, each unordered pair once, or of images and reference images.

    Takes the arguments of hloc's `pairs_from_exhaustive.main`.

    Args:
        output: text file of pairs.
        image_list: text file of the images' names; in Python, also the names.
        features: feature file of the images, instead of `image_list`.
        ref_list: text file of the reference images' names (in Python, also the names); default:
            pair the images with each other.
        ref_features: feature file of the reference images, instead of `ref_list`.

    Returns:
        `output`.

    Raises:
        InputError: when neither a list nor a feature file is given, one of them is empty, or there
            is only one image.
    """
    names = _names(image_list, features)
    if names is None:
        raise InputError("There is nothing to pair: give a list of images or a feature file.")
    references = _names(ref_list, ref_features)
    pairs: Iterable[tuple[str, str]]
    if references is None or set(references) == set(names):
        if len(names) == 1:
            raise InputError(f"{names[0]} is the only image: there is no other to pair it with.")
        pairs = combinations(names, 2)
    else:
        pairs = (pair for pair in product(names, references) if pair[0] != pair[1])
    number = write_pairs(pairs, output)
    logger.info("Wrote %d pairs of %d images.", number, len({*names, *(references or ())}))
    return output


def _names(images: Path | str | Iterable[str] | None, features: Path | None) -> list[str] | None:
    """Return the unique names of a list, or else of a feature file; None without either."""
    if images is not None:
        return list(dict.fromkeys(image_names(images)))
    if features is None:
        return None
    names = check_names(list_h5_names(features), features)
    if not names:
        raise InputError(f"{features} has no image.")
    return names


def _main() -> None:
    example = "--output pairs.txt --features outputs/feats-dog-colmap_sift_sv64.h5"
    exclusive = ("image_list", "features"), ("ref_list", "ref_features")
    options.call(main, __doc__, example, exclusive=exclusive)


if __name__ == "__main__":
    cli.run(_main)
