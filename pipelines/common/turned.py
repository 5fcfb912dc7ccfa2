"""Try queries that are not localized as they look when they are turned by 90 degrees or more."""

from pathlib import Path

from hloc_reduce import extract_features
from hloc_reduce.confs import matchers as matchers_confs
from hloc_reduce.localization import views
from hloc_reduce.localization.stage import Matched, Try
from hloc_reduce.maps.map import Map
from hloc_reduce.utils.parsers import write_pairs_of

from .retrieval import retrieve_in_map
from .run import Run, readable


def tries(
    run: Run,
    built: Map,
    image_dir: Path,
    names: list[str],
    features: Path,
    pairs: Path,
    num_loc: int | None,
) -> list[Try]:
    """Return the tries of photos whose EXIF data do not tell how they are turned.

    Args:
        run: the run, whose folder the files go to.
        built: the map.
        image_dir: folder of the queries.
        names: the queries.
        features: feature file of the queries as they are.
        pairs: pairs of all queries, as they are, and map images.
        num_loc: map images that the map's retrieval finds for a turned query; None: those of
            `pairs`.
    """
    conf, map_names = built.conf, built.names()

    def of_turns(turns: int, of_turn: list[str], matcher: str) -> Try:
        shown = views.shown(conf, turns=turns)
        suffix = f"turned{90 * turns}" + ("-again" if matcher != run.steps[0] else "")
        turned = run.folder.path / f"{features.stem}-turned{90 * turns}.h5"
        listed = pairs.with_name(f"{pairs.stem}-{suffix}.txt")

        def match(names: list[str]) -> Matched:
            extract_features.main(
                shown, image_dir, feature_path=turned, image_list=names, strict=False, queries=names
            )
            if num_loc is None:
                write_pairs_of(names, pairs, suffix)
            else:
                queries = readable(turned, names)
                retrieve_in_map(
                    built, turned, listed, num_loc, queries, map_names, image_dir, turns
                )
            matches = run.match_pairs(matcher, listed, turned, built.features)
            return Matched(turned, matches, listed)

        mirror_images = run.mirror_images(shown, image_dir, listed, turned, built.features)
        return Try(
            match,
            {"turns": turns, "matcher": matchers_confs.confs[matcher]["model"]},
            mirror_images(matcher),
            frozenset(of_turn),
            {"again": matcher != run.steps[0], "turned": 90 * turns},
        )

    found = views.of_folder(image_dir, names, built.cameras, conf["preprocessing"])
    return [of_turns(*item, matcher) for item in found.items() for matcher in run.steps]
