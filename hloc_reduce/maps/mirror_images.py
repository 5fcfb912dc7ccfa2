"""Features and matches of the mirror images of queries, by which mirrored photos are told."""

from collections.abc import Callable
from pathlib import Path

from .. import extract_features
from ..localization.mirrored import MirrorImages
from ..localization.views import shown
from ..runtime.executors import SERIAL, Executor
from ..utils.parsers import write_pairs_of


def mirror_images(
    conf: dict,
    image_dir: Path,
    pairs: Path,
    features: Path,
    match: Callable[[Path, Path], Path],
    executor: Executor = SERIAL,
    masks: Path | None = None,
) -> MirrorImages:
    """Return what extracts and matches mirror images of queries, for a localization stage.

    Args:
        conf: configuration of the feature.
        image_dir: folder of the queries.
        pairs: pairs of all queries and map images; those of mirror images go beside it.
        features: the feature file of mirror images.
        match: matches a list of pairs by the feature file of their first images, with those of the
            map, and returns the match file.
        executor: runs the extraction.
        masks: of the queries, see `extract_features.main`.
    """

    def main(names: list[str]) -> tuple[Path, Path]:
        listed = write_pairs_of(names, pairs, "mirrored")
        mirrored = extract(conf, image_dir, names, features, executor, masks)
        return mirrored, match(listed, mirrored)

    return main


def extract(
    conf: dict,
    image_dir: Path,
    names: list[str],
    features: Path,
    executor: Executor = SERIAL,
    masks: Path | None = None,
) -> Path:
    """Extract the features of the mirror images of some photos.

    Args:
        conf: configuration of the features.
        image_dir: folder of the photos.
        names: the photos.
        features: the feature file.
        executor: runs the extraction.
        masks: of the photos, see `extract_features.main`.

    Returns:
        The feature file.
    """
    return extract_features.main(
        of_mirror_images(conf),
        image_dir,
        feature_path=features,
        image_list=names,
        executor=executor,
        strict=False,
        queries=names,
        masks=masks,
    )


def of_mirror_images(conf: dict) -> dict:
    """Return the configuration of features, or of global descriptors, of mirror images."""
    return shown(conf, mirrored=True)
