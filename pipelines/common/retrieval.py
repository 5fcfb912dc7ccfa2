"""Which map images each query is matched with: by VLAD, or by a file of pairs or descriptors."""

from pathlib import Path

from hloc_reduce import aggregate_features, pairs_from_retrieval
from hloc_reduce.maps.map import RETRIEVAL, Map
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.h5 import list_h5_names
from hloc_reduce.utils.parsers import parse_retrieval, write_pairs

GLOBAL_SUFFIXES = (".h5", ".hdf5")  # of global descriptors; other retrieval files are text


def check_retrieval(
    retrieval: str, output: Path, num_loc: int, query_names: list[str], map_names: list[str]
) -> list[str]:
    """Check a retrieval file before any work is done.

    Returns:
        The map images that can be retrieved: those of a list of pairs, else all.

    Raises:
        InputError: for a broken file, one of other images, or `output` itself.
    """
    if retrieval == "vlad":
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
) -> None:
    """Write pairs of queries and map images, from a file or by VLAD of `features`."""
    if not query_names:
        write_pairs([], output)
        return
    source = Path(retrieval)
    if retrieval == "vlad":
        source = aggregate_features.main(RETRIEVAL, features, map_names)
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
) -> None:
    """Write pairs of queries and the images of a map, by VLAD with the map's vocabulary.

    The global descriptors of the queries are written into the folder of `output`.
    """
    if not query_names:
        write_pairs([], output)
        return
    descriptors = aggregate_features.main(
        RETRIEVAL,
        features,
        export_dir=output.parent,
        vocabulary=built.vocabulary,
        image_list=query_names,
    )
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
    return Path(retrieval).stem.removeprefix("pairs-query-").rstrip("0123456789")
