"""Pair each query with the database images of the most similar global descriptors."""

from collections.abc import Iterable, Iterator
from pathlib import Path

from . import logger
from .retrieval.ranking import block, rank_file, read_global
from .utils import cli, colmap, options
from .utils.cli import InputError
from .utils.h5 import list_h5_names
from .utils.parsers import check_names, image_names, parse_retrieval, write_pairs
from .utils.paths import strings_as_paths
from .utils.progress import progress


@strings_as_paths
def main(
    descriptors: Path,
    output: Path,
    num_matched: int,
    query_prefix: str | tuple[str, ...] | None = None,
    query_list: Path | Iterable[str] | None = None,
    db_prefix: str | tuple[str, ...] | None = None,
    db_list: Path | Iterable[str] | None = None,
    db_model: Path | None = None,
    db_descriptors: Path | None = None,
) -> Path:
    """Write the `num_matched` most similar database images of every query, best first.

    Args:
        descriptors: h5 file with a global_descriptor (G,) of every image.
        output: text file of pairs.
        num_matched: maximum number of pairs per query.
        query_prefix: the queries are the names with this prefix, or one of several.
        query_list: text file of the queries' names (in Python, also the names); default: all.
        db_prefix: as `query_prefix`, for the database.
        db_list: as `query_list`, for the database.
        db_model: COLMAP model whose images are the database.
        db_descriptors: h5 file of global descriptors of the database; default: `descriptors`.

    Returns:
        `output`.

    Raises:
        InputError: for an image without a global descriptor, or no images.
    """
    if num_matched < 1:
        raise InputError(f"num_matched is {num_matched}: at least 1.")
    # in two files equal names are different images
    same_file = db_descriptors in (None, descriptors)
    db_descriptors = db_descriptors or descriptors
    if db_model is not None:
        db_list = [image.name for image in colmap.read_model(db_model).images.values()]
    query_names = _select(descriptors, query_prefix, query_list)
    db_names = _select(db_descriptors, db_prefix, db_list)
    size = block(descriptors, query_names[0])

    def retrieve() -> Iterator[tuple[str, str]]:
        with progress(None, "Retrieving", "image", len(query_names)) as shown:
            for start in range(0, len(query_names), size):
                names = query_names[start : start + size]
                queries = read_global(descriptors, names)
                ranking = rank_file(queries, db_descriptors, db_names, num_matched + 1, size)
                for name, row in zip(names, ranking, strict=True):
                    others = [db_names[j] for j in row if not same_file or db_names[j] != name]
                    yield from ((name, other) for other in others[:num_matched])
                shown.update(len(names))

    number = write_pairs(retrieve(), output)
    logger.info("Retrieved %d pairs for %d images.", number, len(query_names))
    return output


@strings_as_paths
def select(
    pairs: Path,
    output: Path,
    num_matched: int,
    query_list: Iterable[str],
    db_list: Iterable[str],
) -> Path:
    """Take the first `num_matched` pairs of every query from an existing list.

    Args:
        pairs: text file of pairs, best first.
        output: text file of the selected pairs.
        num_matched: maximum number of pairs per query.
        query_list: the queries.
        db_list: the database images; pairs with other images are dropped.

    Returns:
        `output`.

    Raises:
        InputError: when no pair is left.
    """
    retrieved, database = parse_retrieval(pairs), set(db_list)
    selected: list[tuple[str, str]] = []
    without, absent = [], 0
    for query in query_list:
        listed = retrieved.get(query, [])
        names = [name for name in listed if name in database]
        selected += [(query, name) for name in names[:num_matched]]
        absent += len(listed) - len(names)
        if not names:
            without.append(query)
    if absent:
        logger.warning("%d pairs of %s are with images that are not in the map.", absent, pairs)
    if without:
        logger.warning("%s has no pair for %d queries: %s.", pairs, len(without), cli.some(without))
    if not selected:
        raise InputError(f"{pairs} has no pair of a query and a map image.")
    write_pairs(selected, output)
    return output


def _select(
    path: Path,
    prefix: str | tuple[str, ...] | None,
    names: Path | Iterable[str] | None,
) -> list[str]:
    if prefix is not None:
        prefix = prefix if isinstance(prefix, str) else tuple(prefix)
        selected = [name for name in list_h5_names(path) if name.startswith(prefix)]
    elif names is not None:
        selected = image_names(names)
    else:
        selected = list_h5_names(path)
    if not selected:
        raise InputError(f"No image is selected from the global descriptors {path}.")
    return check_names(selected, path)


def _main() -> None:
    example = "--descriptors global.h5 --output pairs.txt --query_prefix query/ --db_prefix db/"
    options.call(main, __doc__, example, num_matched=50)


if __name__ == "__main__":
    cli.run(_main)
