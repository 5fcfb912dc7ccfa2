"""Show queries that are not localized in other ways, see `localization.views`."""

from pathlib import Path

from hloc_reduce import extract_features
from hloc_reduce.confs import matchers as matchers_confs
from hloc_reduce.localization import views
from hloc_reduce.localization.stage import Matched, Try
from hloc_reduce.localization.views import View
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
    map_names: list[str],
    masks: Path | None = None,
) -> list[Try]:
    """Return how queries are tried in other views, if the feature of the map needs that.

    Args:
        run: the run, whose folder the files go to.
        built: the map.
        image_dir: folder of the queries.
        names: the queries that may be tried.
        features: feature file of the queries as they are.
        pairs: pairs of all queries, as they are, and map images.
        num_loc: map images that the map's retrieval finds for a query in another view; None: those
            of `pairs`.
        map_names: images of the map.
        masks: of the queries.
    """
    if built.is_rotation_invariant:
        return []

    def of_view(view: View, of_this: list[str], matcher: str) -> Try:
        again = matcher != run.steps[0]
        conf = views.shown(built.conf, **view.how)
        suffix = f"{view.name}-again" if again else view.name
        seen = run.folder.path / f"{features.stem}-{view.name}.h5"
        listed = pairs.with_name(f"{pairs.stem}-{suffix}.txt")

        def match(names: list[str]) -> Matched:
            extract_features.main(
                conf,
                image_dir,
                feature_path=seen,
                image_list=names,
                strict=False,
                queries=names,
                masks=masks,
            )
            if num_loc is None:
                write_pairs_of(names, pairs, suffix)
            else:
                queries = readable(seen, names)
                given = listed, num_loc, queries, map_names, image_dir, view.turns
                retrieve_in_map(built, seen, *given)
            return Matched(seen, run.match_pairs(matcher, listed, seen, built.features), listed)

        mirror_images = run.mirror_images(conf, image_dir, listed, seen, built.features, masks)
        return Try(
            match,
            {"view": view.how, "matcher": matchers_confs.confs[matcher]["model"]},
            mirror_images(matcher),
            frozenset(of_this),
            {"again": again, "turned": 90 * view.turns},
        )

    found = views.of_folder(image_dir, names, built.cameras, built.conf["preprocessing"])
    return [of_view(*item, matcher) for item in found.items() for matcher in run.steps]
