"""Which map images each query is matched with: by global descriptors, or by a file of pairs."""

from pathlib import Path

from hloc_reduce import aggregate_features, pairs_from_retrieval
from hloc_reduce.confs.retrieval import VLAD, confs
from hloc_reduce.maps.map import Map
from hloc_reduce.retrieval import load
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.h5 import list_h5_names
from hloc_reduce.utils.parsers import parse_retrieval, write_pairs

GLOBAL_SUFFIXES = (".h5", ".hdf5")  # of global descriptors; other retrieval files are text


def check_name(retrieval: str) -> None:
    """Raise an InputError unless a retrieval is a key of `confs.retrieval` or a file."""
    if retrieval not in confs and not Path(retrieval).is_file():
        others = ", ".join(name for name in confs if name != VLAD)
        raise InputError(
            f"--retrieval {retrieval}: neither vlad nor an existing file, nor one of {others}."
        )


def check_model(retrieval: str) -> None:
    """Fail before deleting anything if a retrieval cannot be made."""
    if retrieval in confs:
        load(confs[retrieval]["model"])


def check_retrieval(
    retrieval: str, output: Path, num_loc: int, query_names: list[str], map_names: list[str]
) -> list[str]:
    """Check a retrieval file before any work is done.

    Returns:
        The map images that can be retrieved: those of a list of pairs, else all.

    Raises:
        InputError: for a broken file, one of other images, or `output` itself.
    """
    check_name(retrieval)
    if retrieval in confs:
        return map_names
    if Path(retrieval).resolve() == output.resolve():
        raise InputError(f"--retrieval {retrieval} would be overwritten: move it elsewhere.")
    if Path(retrieval).suffix in GLOBAL_SUFFIXES:
        list_h5_names(Path(retrieval))
        return map_names
    pairs, names = parse_retrieval(Path(retrieval)), set(map_names)
    found = [[other for other in pairs.get(name, ()) if other in names] for name in query_names]
    if not any(found):
        raise InputError(f"{retrieval} has no pair of a query and a map image.")
    return sorted({other for others in found for other in others[:num_loc]})


def retrieve(
    retrieval: str,
    features: Path,
    output: Path,
    num_loc: int,
    query_names: list[str],
    map_names: list[str],
    image_dir: Path,
) -> None:
    """Write pairs of queries and map images, from a file or by their global descriptors.

    Args:
        retrieval: a key of `confs.retrieval`, or a file.
        features: feature file of all images.
        output: the pairs.
        num_loc: retrieved map images per query.
        query_names: the queries.
        map_names: the map images.
        image_dir: folder of all images.
    """
    if not query_names:
        write_pairs([], output)
        return
    source = Path(retrieval)
    if retrieval in confs:
        source = aggregate_features.main(confs[retrieval], features, map_names, image_dir=image_dir)
    of_descriptors = source.suffix in GLOBAL_SUFFIXES
    select = pairs_from_retrieval.main if of_descriptors else pairs_from_retrieval.select
    select(source, output, num_loc, query_list=query_names, db_list=map_names)


def retrieve_in_map(
    built: Map,
    features: Path,
    output: Path,
    num_loc: int,
    query_names: list[str],
    map_names: list[str],
    image_dir: Path | None = None,
    turns: int = 0,
) -> None:
    """Write pairs of queries and the images of a map, by the map's retrieval.

    The global descriptors of the queries are written into the folder of `output`.

    Args:
        built: the map.
        features: feature file of the queries.
        output: the pairs.
        num_loc: retrieved map images per query.
        query_names: the queries.
        map_names: the map images.
        image_dir: folder of the queries, which only some retrievals need.
        turns: of the queries, see `localization.views.View`.
    """
    if not query_names:
        write_pairs([], output)
        return
    descriptors = built.aggregate(features, query_names, image_dir, output.parent, turns)
    pairs_from_retrieval.main(
        descriptors,
        output,
        num_loc,
        query_list=query_names,
        db_list=map_names,
        db_descriptors=built.descriptors,
    )


def retrieval_name(retrieval: str) -> str:
    """Return what result files are named after: `netvlad` for `pairs-query-netvlad50.txt`."""
    if retrieval in confs:
        return retrieval
    return Path(retrieval).stem.removeprefix("pairs-query-").rstrip("0123456789")
