"""Tables of the documentation about accuracy, made from the rows of results/."""

from collections import Counter
from collections.abc import Callable
from itertools import product
from operator import mul
from pathlib import Path
from statistics import mean, median

from benchmarks import changed_photos
from benchmarks.cells import Table, name_of, percent, thousands, total
from benchmarks.rows import Row, read, select, with_keypoints
from benchmarks.trial_rows import OUTCOMES, RESHAPED, STRANGERS, TRIALS
from benchmarks.trial_rows import read as read_trials
from hloc_reduce.confs import features as features_confs
from hloc_reduce.confs.features import matcher_of
from hloc_reduce.detectors.dog import FAST, KEYPOINT_SETTINGS
from hloc_reduce.evaluation import published
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.codes import FLOATS

# kinds of trials, by what they are called in tables
OWN = "own", "blurred", "dark"
KINDS_OF_TRIALS: dict[str, Callable[[dict], bool]] = {
    "own, with intrinsics": lambda row: row["kind"] in OWN and row["intrinsics"] == "given",
    "own, without": lambda row: row["kind"] in OWN and row["intrinsics"] == "guess",
    "own, altered": lambda row: row["kind"] in RESHAPED,
    "own, wrong focal length": lambda row: row["intrinsics"] == "off",
    "not of the place": lambda row: row["kind"] in STRANGERS,
}
Choice = tuple[str, str]  # feature, storage

FEATURES: list[Choice] = [
    ("colmap_sift", "float16"),
    ("aliked", "float16"),
    ("colmap_sift_sv64", "float16"),
    ("xfeat", "float16"),
    ("edgepoint2_m64", "float16"),
    ("mini64", "float16"),
    ("aliked_sv64", "uint4"),
    ("colmap_sift_sv32", "uint4"),
    ("mini64", "uint2"),
    ("xfeat_sv32", "uint2"),
    ("mini32", "uint2"),
]
README: list[Choice] = [
    ("colmap_sift", "float16"),
    ("colmap_sift_sv64", "float16"),
    ("xfeat", "uint4"),
    ("colmap_sift_sv32", "uint4"),
    ("xfeat_sv32", "uint4"),
    ("mini64", "uint2"),
    ("colmap_sift_sv32", "uint2"),
    ("xfeat_sv32", "uint2"),
    ("mini32", "uint2"),
]
# the features of a family, with 256 bytes of a descriptor to 8
FAMILIES: dict[str, list[Choice]] = {
    **{
        base: [
            (base, "float16"),
            *((f"{base}_sv64", storage) for storage in ("float16", "uint8", "uint4")),
            *((f"{base}_sv32", storage) for storage in ("uint4", "uint2")),
        ]
        for base in ("colmap_sift", "sift", "mkd", "aliked")
    },
    "xfeat": [
        *(("xfeat", storage) for storage in ("float16", "uint8", "uint4")),
        *(("xfeat_sv32", storage) for storage in ("uint4", "uint2")),
    ],
    **{
        base: [
            *((f"{base}64", storage) for storage in ("float16", "uint8", "uint4", "uint2")),
            (f"{base}32", "uint2"),
        ]
        for base in ("edgepoint2_m", "mini")
    },
}
SIZES = (256, 128, 64, 32, 16, 8)
MAPS: list[Choice] = [
    ("colmap_sift_sv32", "uint4"),
    ("xfeat_sv32", "uint2"),
    ("mini32", "uint2"),
]
MAP_SIZES = (0.0075,)
# whose bytes are listed by part: place, and size in MB
MAP_PARTS = [("herz-jesus", "0.0075"), ("demo_town-400", "0.083")]
PARTS = ("descriptors", "coordinates", "visible", "retrieval", "poses", "names", "header")
# of LightGlue: features, and the numbers of keypoints that are matched
LIGHTGLUE: list[tuple[str, str, int]] = [
    ("xfeat", "float16", 1024),
    ("xfeat_sv32", "uint2", 1024),
    ("mini64", "uint2", 1024),
    ("mini32", "uint2", 1024),
    ("mini32", "uint2", 2048),
]
RETRIEVED = 10  # map images of a query there
LIGHTGLUE_PLACES = (
    *("herz-jesus", "dark-fountain-P11", "dark-sceaux"),
    *(f"sparse-{place}" for place in ("herz-jesus", "fountain-P11", "sceaux")),
)
# from what `benchmarks.changed_photos` changes to what tables say
CHANGED_PHOTOS = {
    "map 1, queries 1, turned 0": "unchanged",
    "map 1, queries 0.5, turned 0": "of half the size",
    "map 1, queries 0.25, turned 0": "of a quarter",
    "map 0.5, queries 1, turned 0": "map of half the size",
    "map 0.35 and 1, queries 1, turned 0": "half of the map of 35 %",
    "map 1, queries 1, middle 0.5, turned 0": "their middle, half of each side",
    "map 1, queries 1, turned 90": "turned by 90°",
}
PAPER = ("sift", "mkd", "tfeat")
PAPER_DIMS = (64, 32, 24, 16)
SCHEMES = ("sv", "ss", "us", "pca")


def inliers(rows: list[Row], place: str, part: str) -> str:
    """Format the mean inliers of a query list."""
    return f"{total(select(rows, place=place, list=part), 'inliers'):,.0f}"


def chosen(feature: str, storage: str) -> list[Row]:
    """Return the accuracy of a feature, matched by its own matcher, on all places."""
    rows = select(read("accuracy"), feature=feature, storage=storage, variant="")
    rows = select(rows, matcher=matcher_of(features_confs.confs[feature]))
    if not rows:
        raise InputError(f"results/accuracy.csv has no rows of {feature}, {storage}.")
    return rows


def features_table() -> Table:
    """Compare features on all places."""
    table = [["feature", "storage", "bytes", "localized", "within 1 cm [%]", "5 cm [%]"]]
    table[0] += ["median [cm]", "inliers, day", "night", "town, night"]
    for feature, storage in FEATURES:
        rows = chosen(feature, storage)
        day, town = (
            select(rows, place=place, list=part)[0]
            for place, part in (("herz-jesus", "day"), ("demo_town", "night"))
        )
        table.append(
            [
                f"`{feature}`",
                f"`{storage}`",
                day["bytes"],
                f"{total(rows, 'localized'):.0f} of {total(rows, 'queries'):.0f}",
                *(f"{percent(rows, f'within_{limit}cm'):.0f}" for limit in (1, 5)),
                f"{float(day['median_cm']):.2f}" if day["median_cm"] else "",
                *(inliers(rows, "herz-jesus", part) for part in ("day", "night")),
                f"{town['localized']} of {town['queries']}",
            ]
        )
    return table


def readme_table() -> Table:
    """Show how few bytes suffice."""
    table = [["bytes", "`--feature`", "`--storage`", "within 1 cm", "within 5 cm"]]
    table[0] += ["town at night", "inliers, day", "inliers, night"]
    for feature, storage in README:
        rows = chosen(feature, storage)
        town = select(rows, place="demo_town", list="night")[0]
        table.append(
            [
                rows[0]["bytes"],
                f"`{feature}`",
                f"`{storage}`",
                *(
                    f"{total(rows, f'within_{limit}cm'):.0f} of {total(rows, 'queries'):.0f}"
                    for limit in (1, 5)
                ),
                f"{town['localized']} of {town['queries']}",
                *(inliers(rows, "herz-jesus", part) for part in ("day", "night")),
            ]
        )
    return table


def keypoints_table() -> Table:
    """Compare settings of DoG keypoints on all places."""
    feature = features_confs.RECOMMENDED
    rows = select(read("accuracy"), feature=feature, storage=FLOATS[0], matcher="NN-ratio")
    table = [["`--keypoints`", "localized", "within 1 cm", "within 5 cm", "inliers, day", "night"]]
    table[0] += ["town at night"]
    for name in (KEYPOINT_SETTINGS[0], FAST):
        variant = "" if name == KEYPOINT_SETTINGS[0] else with_keypoints(name)
        of_name = select(rows, variant=variant)
        counts = (
            f"{total(of_name, measure):.0f} of {total(of_name, 'queries'):.0f}"
            for measure in ("localized", "within_1cm", "within_5cm")
        )
        town = select(of_name, place="demo_town", list="night")[0]
        day_and_night = (inliers(of_name, "herz-jesus", part) for part in ("day", "night"))
        localized = f"{town['localized']} of {town['queries']}"
        table.append([f"`{name}`", *counts, *day_and_night, localized])
    return table


def bytes_table() -> Table:
    """Show what a byte of a descriptor buys, for each family of features."""
    table = [["feature", *(f"{size} bytes" for size in SIZES)]]
    for family, choices in FAMILIES.items():
        cells = dict.fromkeys(SIZES, "")
        for choice in choices:
            rows = chosen(*choice)
            localized, recall = total(rows, "localized"), percent(rows, "within_5cm")
            cells[int(rows[0]["bytes"])] = f"{localized:.0f}, {recall:.0f} %"
        table.append([f"`{family}`", *cells.values()])
    return table


def schemes_table() -> Table:
    """Compare the paper's descriptors, schemes and dimensions by their matching AP."""
    rows = select(read("matching_ap"), list="photo pairs", storage="float16")
    found = {row["feature"]: f"{float(row['ap']):.1f}" for row in rows}
    dims = PAPER_DIMS[0], PAPER_DIMS[-1]
    table = [["descriptor", "scheme", "128", *map(str, dims)]]
    for base in PAPER:
        for scheme in SCHEMES:
            cells = [found[f"{base}_{scheme}{dim}"] for dim in dims]
            table.append([f"`{base}`", f"`{scheme}`", found[base], *cells])
    return table


def maps_table() -> Table:
    """Compare compact maps with the whole map of each feature."""
    table = [["feature", "map", "KB", "points", "day", "cm", "inliers", "night", "cm", "inliers"]]
    for feature, storage in (MAPS[0], MAPS[-1]):
        rows = select(read("maps"), place="herz-jesus", feature=feature, matcher="")
        for variant in ("whole map", "all points", *(f"at most {size} MB" for size in MAP_SIZES)):
            found = select(rows, variant=variant)
            label = variant
            if variant != "whole map":
                found, label = select(found, storage=storage), f"`{storage}`, {variant}"
            day, night = (select(found, list=part)[0] for part in ("day", "night"))
            kilobytes = f"{1000 * float(day['mb']):,.0f}"
            cells = [f"`{feature}`", label, kilobytes, thousands(day["points"])]
            for row in (day, night):
                cells.append(f"{row['within_25cm']} of {row['queries']}")
                cells.append(f"{float(row['median_cm']):.2f} / {float(row['largest_cm']):.1f}")
                cells.append(thousands(row["inliers"]))
            table.append(cells)
    return table


def small_maps_table() -> Table:
    """Compare maps of Aachen by others with this project's, and say what is counted."""
    table = [["map", "counted", "photos", "MB", "within 25 cm, 2°"]]
    for one in published.small_maps():
        recall = one["night_0.25m_2deg"]
        name = one["method"] + (f" ({one['published']})" if one["published"] else "")
        photos, size = (thousands(one[key]) for key in ("photos", "mb"))
        table.append([name, one["counted"], photos, size, f"{recall} %" if recall else ""])
    feature, storage = MAPS[0]
    for row in select(read("compact_scale"), feature=feature, list="share 1"):
        cells = ["the file", thousands(row["photos"]), thousands(row["mb"]), "unknown"]
        table.append(["ours, synthetic descriptors", *cells])
    rows = select(read("maps"), place="herz-jesus", list="night", feature=feature, matcher="")
    [row] = select(rows, storage=storage, variant="all points")
    cells = ["the file", row["photos"], f"{float(row['mb']):.2f}"]
    table.append(["ours, Herz-Jesus", *cells, f"{row['within_25cm']} of {row['queries']}"])
    return table


def map_parts_table() -> Table:
    """List the bytes of the parts of small maps."""
    table = [["bytes"], ["images"], ["points"], *([part] for part in PARTS)]
    for place, size in MAP_PARTS:
        found = select(read("maps"), place=place, feature=MAPS[0][0], variant=f"at most {size} MB")
        row = select(found, matcher="")[0]
        numbers = [row["images"], row["points"], *(row[f"{part}_bytes"] for part in PARTS)]
        cells = [f"{place}, {size} MB", *map(thousands, numbers)]
        for line, cell in zip(table, cells, strict=True):
            line.append(cell)
    return table


def false_accepts_table() -> Table:
    """Count the poses of labelled trials that the gate accepts, by feature and kind of photo."""
    table = [["feature", *KINDS_OF_TRIALS]]
    files: dict[str, list[Path]] = {}
    for file in sorted(TRIALS.glob("*.csv")):
        files.setdefault(file.stem.rpartition("-")[0], []).append(file)
    for feature, of_feature in files.items():
        trials, cells = read_trials(of_feature), []
        for is_of in KINDS_OF_TRIALS.values():
            rows = [row for row in trials if is_of(row)]
            accepted = Counter(row["outcome"] for row in rows if row["accepted"])
            found = " / ".join(str(accepted[outcome]) for outcome in OUTCOMES)
            cells.append(f"{found} of {len(rows):,}")
        table.append([f"`{feature}`", *cells])
    return table


def lightglue_table() -> Table:
    """Compare maps and queries that are matched by nearest neighbours and by LightGlue."""
    columns = {f"{a} map, {b} queries": (a, b) for a in ("NN", "LG") for b in ("NN", "LG")}
    table = [["feature", "bytes", "keypoints", *columns]]
    for feature, storage, number in LIGHTGLUE:
        fast = matcher_of(features_confs.confs[feature])
        names = {"NN": fast, "LG": "lightglue"}
        of_feature = select(read("lightglue"), feature=feature, storage=storage)
        cells = []
        for of_map, matcher in columns.values():
            variant = f"map by {names[of_map]}, {number} keypoints, {RETRIEVED} images"
            rows = select(of_feature, matcher=names[matcher], variant=variant)
            rows = [row for row in rows if row["place"] in LIGHTGLUE_PLACES]
            cells.append(accuracy(rows))
        cells = [rows[0]["bytes"], f"{number:,}", *cells]
        table.append([f"`{feature}`, `{storage}`", *cells])
    return table


def lightglue_bytes_table() -> Table:
    """Compare raw descriptors with their codes, matched by LightGlue in maps and queries."""
    lists = [("herz-jesus", "day"), *((place, "night") for place in LIGHTGLUE_PLACES[:3])]
    lists += [("sparse-herz-jesus", "day")]
    heads = [f"{place.removesuffix('-P11')}, {part}" for place, part in lists]
    table = [["feature", "bytes", *heads]]
    for base in ("aliked", "xfeat", "disk"):
        codes = ((f"{base}_sv32", storage) for storage in ("uint4", "uint2", "uint1"))
        for feature, storage in [(base, FLOATS[0]), *codes]:
            variant = f"map by lightglue, 1024 keypoints, {RETRIEVED} images"
            given = {"feature": feature, "storage": storage, "variant": variant}
            rows = select(read("lightglue"), matcher="lightglue", **given)
            if not rows:
                continue
            cells = []
            for place, part in lists:
                found = select(rows, place=place, list=part)
                cells += [inliers_and_median(row) for row in found] or [""]
            table.append([f"`{feature}`, `{storage}`", rows[0]["bytes"], *cells])
    return table


def inliers_and_median(row: Row) -> str:
    """Format the mean inliers of a query list and its median error in cm."""
    median = f"; {float(row['median_cm']):.2f}" if row["median_cm"] else ""
    return f"{float(row['inliers']):,.0f}{median}"


def changed_photos_table() -> Table:
    """Show what networks localize of changed queries, and in a map of small photos."""
    rows = read("changed_photos")
    networks = [row for row in rows if not row["feature"].startswith("colmap_sift")]
    names = dict.fromkeys(map(name_of, networks))
    table = [["photos", *(f"{name}: {how}" for name in names for how in changed_photos.SHOWN)]]
    for change, said in CHANGED_PHOTOS.items():
        cells = []
        for name, how in product(names, changed_photos.SHOWN):
            found = select(rows, variant=f"{change}, {how}")
            of_name = [one for one in found if name_of(one) == name]
            cells.append(
                "".join(f"{row['localized']}; {inliers_and_median(row)}" for row in of_name)
            )
        table.append([said, *cells])
    return table


def rigs_table() -> Table:
    """Compare rigs of cameras with the best of their photos alone."""
    table = [["feature", "map photos", "cameras", "localized", "within 5 cm", "median [cm]"]]
    table[0] += ["best alone: localized", "within 5 cm", "median [cm]"]
    rows = [row for row in read("rigs") if row["photos"]]  # of the demo town
    for name, photos in dict.fromkeys((name_of(row), row["photos"]) for row in rows):
        of_map = [row for row in rows if (name_of(row), row["photos"]) == (name, photos)]
        of_name = {row["variant"]: row for row in of_map}
        for number in (2, 4):
            if f"best of {number}" not in of_name:  # only rigs of strangers
                continue
            cells = []
            for variant in (f"{number} cameras", f"best of {number}"):
                row = of_name[variant]
                localized = f"{row['localized']} of {row['queries']}"
                cells += [localized, row["within_5cm"], f"{float(row['median_cm']):.2f}"]
            table.append([name, photos, str(number), *cells])
    return table


def own_maps_table() -> Table:
    """Compare maps of photos alone, and queries in them, of places with known poses."""
    heads = "photos in the maps", "localized", "far", "median [%]", "inliers"
    table = [["feature", *heads, "a map [s]", "a query [s]"]]
    rows = [row for row in read("own_maps") if row["map_s"]]
    for name, variant in dict.fromkeys((name_of(row), row["variant"]) for row in rows):
        of_name = [row for row in rows if (name_of(row), row["variant"]) == (name, variant)]
        queries = total(of_name, "queries")
        inliers = sum(float(row["inliers"]) * float(row["queries"]) for row in of_name) / queries
        registered, photos = total(of_name, "registered"), total(of_name, "photos")
        median_percent = median(float(row["median_percent"]) for row in of_name)
        table.append(
            [
                name + (f", {variant}" if variant else ""),
                f"{registered:.0f} of {photos:.0f}",
                f"{total(of_name, 'localized'):.0f} of {queries:.0f}",
                f"{total(of_name, 'far'):.0f}",
                f"{median_percent:.2f}",
                thousands(inliers),
                f"{mean(float(row['map_s']) for row in of_name):.0f}",
                f"{mean(float(row['query_s']) for row in of_name):.1f}",
            ]
        )
    return table


def accuracy(rows: list[Row]) -> str:
    """Format the queries within 1 and 5 cm, and the mean inliers, of query lists."""
    near = (f"{total(rows, f'within_{limit}cm'):.0f}" for limit in (1, 5))
    queries = [float(row["queries"]) for row in rows]
    inliers_of = [float(row["inliers"]) for row in rows]
    mean = sum(map(mul, queries, inliers_of)) / sum(queries)
    return f"{' / '.join(near)} of {sum(queries):.0f}; {mean:,.0f}"


TABLES: dict[str, Callable[[], Table]] = {
    "features": features_table,
    "readme": readme_table,
    "keypoints": keypoints_table,
    "bytes": bytes_table,
    "schemes": schemes_table,
    "maps": maps_table,
    "small_maps": small_maps_table,
    "map_parts": map_parts_table,
    "false_accepts": false_accepts_table,
    "lightglue": lightglue_table,
    "lightglue_bytes": lightglue_bytes_table,
    "changed_photos": changed_photos_table,
    "rigs": rigs_table,
    "own_maps": own_maps_table,
}
