"""Localize photos in a map of your own.

Builds the map once, from photos and a COLMAP model of them, from photos alone, or from a COLMAP
model and its database; later runs localize other photos in it. Without --query_images only the map
is built. A new map has the feature colmap_sift_sv64 and its matcher unless you choose others.
--add_images adds photos to a map. Photos are in a folder, or the frames of a video.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from hloc_reduce import compact, extract_features, localize_sfm, logger, maps
from hloc_reduce.confs import features as features_confs
from hloc_reduce.confs import matchers as matchers_confs
from hloc_reduce.confs import retrieval as retrieval_confs
from hloc_reduce.confs.matchers import NN_LIGHTGLUE
from hloc_reduce.datasets import DAY_THRESHOLDS, true_poses
from hloc_reduce.detectors.dog import KEYPOINT_SETTINGS, KeypointSettings
from hloc_reduce.localization import panoramas as panorama_files
from hloc_reduce.localization import trajectory
from hloc_reduce.localization.gate import DEFAULT_GATE, Gate
from hloc_reduce.maps.map import Map
from hloc_reduce.maps.pairing import PairsOption
from hloc_reduce.match_features import check_features, check_model
from hloc_reduce.runtime import trace
from hloc_reduce.runtime.group_writer import failures
from hloc_reduce.runtime.outputs import RunFolder
from hloc_reduce.runtime.provenance import MADE_FROM
from hloc_reduce.utils import cli, colmap
from hloc_reduce.utils import masks as masks_of
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.codes import STORAGES, Storage
from hloc_reduce.utils.options import ABOVE_0, Option, Parser, taken
from hloc_reduce.utils.paths import strings_as_paths
from hloc_reduce.utils.videos import is_video

from .common import changes, command, map_photos, metres, other_views, videos
from .common.options import Matcher, Positive, Retrieval, Rigs
from .common.queries import LISTED, Photos, find_queries, identity, results_folder
from .common.retrieval import check_retrieval, retrieval_name, retrieve, retrieve_in_map
from .common.run import Run, readable


@strings_as_paths
def open_map(
    outputs: Path,
    map_images: Path | None = None,
    model_or_map: Annotated[Path, Option(flags=("--map",), metavar="MODEL|MAP")] | None = None,
    feature: str | None = None,
    projection: Path | None = None,
    matcher: Matcher | None = None,
    num_covis: Positive = 20,
    overwrite: bool = False,
    storage: Storage | None = None,
    keypoints: KeypointSettings | None = None,
    accept_partial: bool = False,
    camera_mode: Annotated[str, colmap.CAMERA_MODE] | None = None,
    camera_model: Annotated[str, colmap.CAMERA_MODEL] | None = None,
    camera_params: str | None = None,
    database: Path | None = None,
    retrieval: Retrieval | None = None,
    exif_gps: bool = True,
    masks: Path | None = None,
    pairs: PairsOption | None = None,
    rigs: Rigs | None = None,
    panoramas: bool = False,
) -> Map:
    """Build a map, or open one that was built before.

    None stands for the default of a new map, and for whatever an old map was built with.

    Args:
        outputs: results folder: the map goes to OUTPUTS/map, poses to OUTPUTS/queries-<name of
            `queries` or `query_images`>.
        map_images: photos of the map, a folder or (command line) a video, whose sharp frames are
            written to OUTPUTS/map_images; without `map` they are reconstructed.
        model_or_map: COLMAP model of `map_images` or `database`, or a folder with one model in it;
            or a map of an earlier run: its folder or .hlm file, which is unpacked.
        feature: local feature, see `list_features`, or a YAML file with its configuration; default:
            colmap_sift_sv64.
        projection: projection file to use with the base descriptor of `feature`.
        matcher: matcher of a new map and of queries; with NN+lightglue, queries that nearest
            neighbours do not localize are matched by LightGlue; default: the feature's, see
            `list_features`, or that of a map that was built.
        num_covis: other images that each map image is matched with.
        overwrite: recompute existing results.
        storage: storage of the descriptors of map images (those of queries stay floats); default:
            float16.
        keypoints: settings of the DoG detector; default: adaptive.
        accept_partial: build the map without photos that are missing, unreadable or, in a map of
            photos alone, not reconstructed; and use a map whose focal lengths, positions or matches
            show that it may be wrong.
        camera_mode: which photos share a camera; default: auto.
        camera_model: the model of the cameras, of fisheyes for example OPENCV_FISHEYE; default:
            SIMPLE_RADIAL.
        camera_params: approximate parameters of `camera_model`, in COLMAP's order, such as
            fx,fy,cx,cy,k1,k2,k3,k4, which the map refines; default: from EXIF data or guessed.
        database: COLMAP database that `map` was made from: its keypoints and descriptors make the
            map, without photos. Photos, if given, only tell more about the cameras.
        retrieval: a name (those of networks need an installed hloc); or, for the queries only,
            hloc's text file of pairs or h5 file of global descriptors; default: vlad.
        exif_gps: align a new map of photos alone with the GPS in their EXIF data.
        masks: folder of masks of photos, as COLMAP's: keypoints of a/photo.jpg in black pixels of
            `masks`/a/photo.jpg.png are dropped, in photos of the map, queries, and photos that are
            added; or one mask for all photos of its size; default: none.
        pairs: which photos are matched with each other in a map of photos alone; default:
            sequential for a video, else exhaustive for up to 100 photos and retrieval for more.
        rigs: COLMAP's file of cameras that are fixed to each other. Photos of one moment have the
            same name in the folders of their cameras. A map of photos alone is in the units of the
            file; queries of one moment get one pose of the rig.
        panoramas: photos that are twice as wide as high are panoramas of all directions; default:
            those whose XMP data say so.

    Raises:
        InputError: when an old map was built with other options, or something is missing or wrong.
    """
    lens = {"camera_model": camera_model, "camera_params": camera_params}
    seen = {"camera_mode": camera_mode, "rigs": rigs, "panoramas": panoramas}
    seen["pairs"] = pairs
    map_photos.check(map_images, model_or_map, **lens, **seen)
    if camera_params is not None and camera_model is None:
        raise InputError("Give --camera_model, whose parameters --camera_params are.")
    mode = colmap.camera_mode(camera_mode or "auto")
    named = retrieval if retrieval in retrieval_confs.confs else None
    is_built = model_or_map and (maps.is_map(model_or_map) or maps.is_compact(model_or_map))
    if is_built and (database or map_images):
        option = "--database" if database else "--map_images"
        raise InputError(
            f"--map {model_or_map} is a map that was built: leave out {option} to localize in it, "
            "or give the COLMAP model that it was built from."
        )
    new: dict[str, Any] = {
        "feature": feature or features_confs.RECOMMENDED,
        "projection": projection,
        "matcher": None if matcher == NN_LIGHTGLUE else matcher,
        "overwrite": overwrite,
        "storage": storage or STORAGES[0],
        "keypoints": keypoints or KEYPOINT_SETTINGS[0],
        "retrieval": named or retrieval_confs.VLAD,
    }
    if matcher == NN_LIGHTGLUE and not is_built:  # the map needs only the first of both
        _, conf = features_confs.get(new["feature"], projection)
        check_model(matchers_confs.confs["lightglue"], extract_features.provenance(conf))
    folder = outputs / "map"
    if database is not None:
        if model_or_map is None:
            raise InputError(
                f"Give --map, the COLMAP model that was made from --database {database}."
            )
        return maps.from_database.main(folder, database, model_or_map, image_dir=map_images, **new)
    if map_images is not None:
        masks = masks_of.those_of(masks, map_images)
        if model_or_map is None and (views := map_photos.views(map_images, outputs, panoramas)):
            if masks:
                raise InputError(f"Panoramas are not masked: leave out --masks {masks}.")
            if rigs:
                raise InputError(panorama_files.NO_RIGS.format(rigs))
            if camera_model or camera_mode:
                option = "--camera_model" if camera_model else "--camera_mode"
                raise InputError(f"The lens of panoramas is known: leave out {option}.")
            map_images, rigs = views
        elif rigs:
            map_photos.check_camera_mode(map_images, rigs, camera_mode)
        new |= {"num_covis": num_covis, "accept_partial": accept_partial, "camera_mode": mode}
        new |= {"exif_gps": exif_gps}
        new["masks"] = masks
        new["pairs"] = pairs
        new |= {"rigs": rigs, "camera_params": camera_params}
        new |= {"camera_model": camera_model} if camera_model else {}
        return maps.main(folder, map_images, model_or_map, **new)
    if model_or_map is None:
        raise InputError("Give --map_images, the folder of the photos to build a map of.")
    built = _open(model_or_map, folder, overwrite)
    if feature or projection:
        built.check_feature(feature or features_confs.RECOMMENDED, projection)
    given = {"storage": storage, "keypoints": keypoints, "retrieval": named}
    for option, value in given.items():
        if value not in (None, getattr(built, option)):
            raise InputError(
                f"The map {model_or_map} was built with --{option} {getattr(built, option)}."
            )
    return built


def _open(model_or_map: Path, folder: Path, overwrite: bool) -> Map:
    """Open a map that was built before; unpack a compact one into a folder."""
    models = [*model_or_map.glob("cameras.*"), *model_or_map.glob("*/cameras.*")]
    if models and not maps.is_map(model_or_map):
        raise InputError(
            f"{model_or_map} is a COLMAP model: give its photos, --map_images, or its --database."
        )
    if maps.is_compact(model_or_map):
        return maps.unpack(model_or_map, folder, overwrite)
    return Map(model_or_map)


@strings_as_paths
def main(
    built: Map,
    query_images: Path,
    outputs: Path,
    queries: Path | None = None,
    num_loc: Positive = 50,
    ground_truth: Path | None = None,
    overwrite: bool = False,
    strict: bool = False,
    gate: Gate = DEFAULT_GATE,
    retrieval: Retrieval | None = None,
    matcher: Matcher | None = None,
    rigs: Rigs | None = None,
    masks: Path | None = None,
    panoramas: bool = False,
) -> dict:
    """Localize queries in a map and return the summary, as in summary.json.

    Args:
        built: the map.
        query_images: photos to localize, a folder or (command line) a video, whose frames are
            written to OUTPUTS/query_images.
        outputs: folder for the results.
        queries: query list with intrinsics, or a glob of several; default: all photos of
            `query_images`, with intrinsics from EXIF data or guessed.
        num_loc: retrieved map images per query.
        ground_truth: true poses of the queries; default: none.
        overwrite: recompute existing results.
        strict: fail at an unreadable query photo instead of recording it as not localized.
        gate: what a pose must have for the query to be called localized.
        retrieval: hloc's text file of pairs or h5 file of global descriptors; default: the map's.
        matcher: matcher of queries; default: the map's.
        rigs: COLMAP's file of cameras that are fixed to each other, in the units of the map. Photos
            of one moment, which have the same name in the folders of their cameras, get one pose.
        masks: of the queries, see `open_map`; default: none.
        panoramas: photos that are twice as wide as high are panoramas of all directions; default:
            those whose XMP data say so.

    Raises:
        InputError: when something is missing or wrong.
    """
    wanted = find_queries(query_images, queries, built, strict, rigs, panoramas)
    names = wanted.names
    map_names = built.names()
    built.check_features(map_names)  # a broken map is found before photos are read
    truth = true_poses(wanted.photos, ground_truth, True) if ground_truth else {}

    masks = masks_of.those_of(masks, query_images)
    if masks and wanted.panoramas:
        raise InputError(f"Panoramas are not masked: leave out --masks {masks}.")
    photos = Photos(outputs / MADE_FROM, built, query_images, wanted.photos, masks)
    matcher = matcher or built.matcher
    steps = matchers_confs.steps_in(built.matcher, built.conf, matcher)
    for step in {*steps} - {built.matcher}:
        conf = matchers_confs.confs[step]
        check_model(conf, extract_features.provenance(built.conf))
        check_features(built.features, conf)
    conf = {"map": built.place, **identity(outputs, query_images, queries), "num_loc": num_loc}
    conf |= {"matcher": matcher} if matcher != built.matcher else {}
    conf |= {"panoramas": panorama_files.VIEWS} if wanted.panoramas else {}
    retrieval = built.retrieval if retrieval is None else retrieval
    retrieved = f"{retrieval_name(retrieval)}{num_loc}"
    loc_pairs = outputs / f"pairs-query-{retrieved}.txt"
    inputs = [path for path in (query_images, queries, masks) if path]
    if retrieval != built.retrieval:
        check_retrieval(retrieval, loc_pairs, num_loc, names, map_names)
        conf["retrieval"] = str(Path(retrieval).resolve())
        inputs.append(Path(retrieval))
    remedy = (
        "Choose other --outputs, or replace the results, but not the map: "
        f"--map {built.folder} --overwrite."
    )
    folder = RunFolder(outputs, conf, overwrite, inputs, bool(photos.changed), remedy=remedy)
    with Run(folder, built.feature, matcher, steps) as run:
        photos.write()
        listed = queries or wanted.write(outputs / LISTED)
        wanted.log()
        seen = query_images  # where the queries are
        unreadable: dict[str, str] = {}
        if wanted.panoramas:
            with run.stage("panoramas"):
                seen = outputs / panorama_files.SHOWN
                given = query_images, wanted.panoramas, seen
                unreadable = panorama_files.write_views(*given, strict)
        with run.stage("extract_features"):
            features = extract_features.main(
                built.conf,
                seen,
                outputs,
                image_list=names,
                strict=strict,
                queries=names,
                masks=masks,
            )
        photos.forget(failures(features) | unreadable)
        with run.stage("retrieval"):
            wanted_pairs = loc_pairs, num_loc, readable(features, names), map_names, seen
            if retrieval == built.retrieval:
                retrieve_in_map(built, features, *wanted_pairs)
            else:
                retrieve(retrieval, features, *wanted_pairs)
        matches = run.match("match_queries", loc_pairs, features, built.features)
        poses = outputs / f"poses_hloc_{built.feature}+{matcher}_{retrieved}.txt"
        of_views = panorama_files.results_of_views(poses) if wanted.panoramas else poses
        mirror_images = run.mirror_images(
            built.conf, seen, loc_pairs, features, built.features, masks
        )
        others = other_views.tries(
            run,
            built,
            seen,
            [name for name in names if wanted.sources.get(name) not in ("none", "panorama")],
            features,
            loc_pairs,
            num_loc if retrieval == built.retrieval else None,
            map_names,
            masks,
        )
        with run.stage("localization"):
            records = localize_sfm.main(
                built.sfm,
                listed,
                loc_pairs,
                features,
                matches,
                of_views,
                refinements=wanted.refinements,
                full_names=True,
                gate=gate,
                mirror_images=mirror_images(steps[0]),
                again=run.again(loc_pairs, features, built.features, mirror_images, others),
                rigs=wanted.frames,
                match_rigs=run.match_rigs(loc_pairs, features, built.features),
            )
            if wanted.panoramas:
                records = panorama_files.write_records(wanted.frames, records, poses, unreadable)
        if not trajectory.write(records, outputs):
            folder.delete((trajectory.TUM, trajectory.CSV))
        limits = dict.fromkeys(wanted.lists, DAY_THRESHOLDS)
        summary = {
            "retrieval": retrieval,
            "num_loc": num_loc,
            "intrinsics": Counter(wanted.sources.values()),
            "map": str(built.folder),
            "map_images": built.num_images,
            "map_points3D": built.num_points3D,
            "map_doubts": built.doubts,
            "map_frame": built.frame.to_json(),
        }
        files = {
            "query_images": query_images,
            "pairs": loc_pairs,
            "matches": matches,
            "ground_truth": ground_truth,
            "map_images": built.images,
            "map_features": built.features,
            "map": built.sfm,
        }
        told = summary, wanted.photo_lists, records, truth, limits, features, poses, files
        return run.finish(*told, built.frame, unreadable)


@dataclass(frozen=True, kw_only=True)
class Command(command.Command):
    """The command line of the pipeline.

    Args:
        model_or_map: COLMAP model of `map_images` or `database`, or a folder with one model in it;
            or a map of an earlier run: its folder or .hlm file, which is unpacked; or several .hlm
            files of one place, as one map.
        compact: write the map into one small file, too.
        fps: frames per second that are taken from a video of queries; default: a sharp frame
            whenever the camera has moved.
    """

    model_or_map: (
        Annotated[Sequence[Path], Option(flags=("--map",), metavar="MODEL|MAP")] | None
    ) = None
    compact: Annotated[Path, Option(metavar="FILE.hlm")] | None = None
    fps: Annotated[float, ABOVE_0] | None = None


def _parser() -> Parser:
    """Return the parser of the command line."""
    example = "--map sparse --map_images photos --query_images new --outputs outputs/place"
    parser = Parser(__doc__, example)
    parser.add(Command)
    parser.add(open_map, outputs=None)
    parser.add(main, query_images=None)
    parser.add(changes.main)
    parser.add(metres.main)
    return parser


def _check(given: dict, is_changed: bool) -> None:
    """Raise an InputError for options that contradict each other.

    Args:
        given: the options.
        is_changed: whether a map that was built is changed.
    """
    if is_changed and given["query_images"] is None:
        if given["panoramas"]:
            raise InputError("--panoramas cannot be added to a map: leave out --panoramas.")
        if given["rigs"]:
            raise InputError("Photos are added to a map one by one: leave out --rigs.")
    if given["outputs"] is None and (given["query_images"] is not None or not is_changed):
        raise InputError("Give --outputs, a folder.")
    if given["queries"] is not None and given["query_images"] is None:
        raise InputError("--queries is a list of photos: give their folder, --query_images, too.")
    videos.check(given)
    matcher, is_built = given["matcher"], given["map_images"] is None and given["database"] is None
    if matcher and given["query_images"] is None and (is_built or matcher == NN_LIGHTGLUE):
        what = f"--matcher {matcher} is for queries"
        raise InputError(f"{what}: give --query_images, or leave out --matcher.")
    if (masks := given["masks"]) is not None:
        options = ["query_images", "add_images"]
        options += (
            [] if given["database"] else ["map_images"]
        )  # whose keypoints are in the database
        folders = [given[option] for option in options if given[option] is not None]
        if not folders:
            raise InputError(f"--masks {masks} needs photos to mask, such as --query_images.")
        if not any(map(is_video, folders)):  # whose frames are not there yet
            masks_of.check(masks, folders)
    if given["compact"] is not None:
        compact.check_output(given["compact"])
        if matcher and matcher != NN_LIGHTGLUE and not is_built:
            compact.check_matcher(matcher)
        if (folder := given["model_or_map"]) is not None and maps.is_compact(folder):
            raise InputError(f"--map {folder} is a compact map: leave out --compact.")


def _main() -> None:
    given = command.read(_parser())
    paths = given["model_or_map"] or [None]
    given |= {"model_or_map": paths[0], "joined": paths[1:] and paths}
    if paths[1:] and not maps.is_compact(paths):
        raise InputError(f"--map {' '.join(map(str, paths))}: several maps must be .hlm files.")
    change, outputs, folder = taken(changes.main, given), given["outputs"], given["model_or_map"]
    masks = change.pop("masks")
    gps, scale = given["gps"], given["scale"]
    is_aligned = bool(gps or scale) and folder is not None and maps.is_map(folder)
    _check(given, any(change.values()) or is_aligned)
    metres.check(gps, scale, given["map_images"], folder)
    of_map = taken(open_map, given) | {"outputs": folder, "rigs": None, "panoramas": False}
    with trace.recording(outputs / "trace.json" if given["profile"] and outputs else None):
        if any(change.values()):
            changes.check(folder, given["map_images"] or given["database"], **change)
            built = open_map(**of_map)
            if outputs is None:  # the map is not opened again
                built.warn()
            changes.main(folder, **change, masks=masks)
        if outputs is not None:
            _run(given)
            return
        if is_aligned:
            metres.main(open_map(**of_map), gps, scale)
            print(f"The map {folder} is in metres.")
        if given["compact"] is not None:
            compact.main(given["compact"], folder)


def _run(given: dict) -> None:
    """Build or open the map, and localize the queries in it."""
    photos = "map_images", "query_images"
    has_video = any(given[option] and is_video(given[option]) for option in photos)
    given = videos.as_folders(given)
    if given["masks"] is not None and has_video:  # whose frames are there now
        masks_of.check(given["masks"], [given[option] for option in photos if given[option]])
    where = given["map_images"], given["model_or_map"], given["query_images"]
    special = map_photos.of_map(*where, given["rigs"], given["panoramas"])
    gps, scale = given["gps"], given["scale"]
    if given["joined"]:
        unpacked = maps.unpack(given["joined"], given["outputs"] / "map", given["overwrite"])
        given["model_or_map"] = unpacked.folder
    options = taken(open_map, given | special._asdict())
    built = open_map(**options, exif_gps=not (gps or scale))
    strict = given["map_images"] is None or given["model_or_map"] is not None
    built = metres.main(built, gps, scale, strict)
    if given["map_images"] is None and given["database"] is None:  # others warn as they are built
        built.warn()
    if given["compact"] is not None:
        compact.main(given["compact"], built.folder)
    query_images, queries = given["query_images"], given["queries"]
    if query_images is None:
        print(f"The map {built.folder} is ready. Localize photos in it with --query_images.")
        return
    results = results_folder(given["outputs"], query_images, queries)
    seen = map_photos.of_queries(query_images, given["rigs"], given["panoramas"], special)
    summary = main(built, **taken(main, given | seen._asdict()) | {"outputs": results})
    if built.doubts:
        logger.warning(
            "The map may be wrong, and poses in it may be off by a tenth of the distance or more: "
            "it has %s.",
            " and ".join(built.doubts),
        )
    command.print_result(summary, results, "The poses, camera from world, are in {}.")


if __name__ == "__main__":
    cli.run(_main)
