"""Tables of the documentation about time and size, made from the rows of results/."""

from collections.abc import Callable

from benchmarks.cells import Table, name_of, thousands
from benchmarks.rows import Row, read, select, with_keypoints
from hloc_reduce.confs.features import RECOMMENDED
from hloc_reduce.detectors.dog import FAST, KEYPOINT_SETTINGS
from hloc_reduce.utils.cli import InputError

MANY_IMAGES = 1_000_000  # from which the table of retrieval has them
SECONDS_OF_PAIRS = {
    "early exit, 1 thread": "one core",
    "early exit, 2 pairs at a time": "a pair on each of two cores",
}
ONE_CORE = "1 core"
OLDEST = "pycolmap 3.13"
RUN_PLACES = "herz-jesus", "day-fountain-P11"
# of the rows of runs, in the table
SHOWN_RUNS = "", with_keypoints(KEYPOINT_SETTINGS[0])
FAST_RUN = f"`{RECOMMENDED}`, `{FAST}` keypoints"
STAGES = ("extraction", "matching", "triangulation", "localization")


def lightglue_seconds_table() -> Table:
    """Show the time and the matches of a pair with LightGlue, by keypoints."""
    table = [["feature", "keypoints", *(f"{head} [ms]" for head in SECONDS_OF_PAIRS.values())]]
    rows = read("lightglue_seconds")
    for feature in dict.fromkeys(row["feature"] for row in rows):
        of_feature = select(rows, feature=feature)
        by_number = {int(row["list"].split()[0]): row["list"] for row in of_feature}
        for number, name in sorted(by_number.items())[1:]:
            found = {row["variant"]: row for row in select(of_feature, list=name)}
            cells = [f"{float(found[variant]['ms']):,.0f}" for variant in SECONDS_OF_PAIRS]
            table.append([f"`{feature}`", f"{number:,}", *cells])
    return table


def localizer_table() -> Table:
    """Show what a Localizer takes, from the start of Python to poses."""
    stages = {"extraction": "extraction", "retrieval": "retrieval", "matching": "matching"}
    stages |= {"pose": "pose", "mirror_image": "mirror image", "all": "all"}
    heads = "intrinsics, cores", "map open [s]", "first pose [s]", "memory [MB]"
    table = [["feature", *heads, *(f"{said} [ms]" for said in stages.values())]]
    for row in read("localizer"):
        cells = [name_of(row), row["variant"].replace(" intrinsics", "")]
        cells += [f"{float(row['open_s']):.1f}", f"{float(row['first_s']):.1f}"]
        cells += [thousands(row["resident_mb"])]
        table.append([*cells, *(f"{float(row[f'{stage}_ms']):.0f}" for stage in stages)])
    return table


def tracking_table() -> Table:
    """Compare frames of a video that are tracked with frames that are localized anew."""
    heads = "localized", "within 5 cm", "median [cm]", "by the last pose [%]"
    table = [["feature", "frames", *heads, "beyond extraction [ms]"]]
    for row in read("tracking"):
        if not row["variant"].startswith(("anew, ", "tracked, ")):
            continue  # that nothing is wrong there is said in words
        cells = [name_of(row), row["variant"], f"{row['localized']} of {row['queries']}"]
        cells += [row["within_5cm"], f"{float(row['median_cm']):.2f}"]
        cells += [f"{float(row['near_percent']):.0f}", f"{float(row['ms']):.0f}"]
        table.append(cells)
    return table


def retrieval_table() -> Table:
    """Show how long the search for similar images takes, by their number."""
    table = [["images", "search", "a query [ms]", "index [s]", "right of the first 20"]]
    rows = [row for row in read("retrieval") if int(row["photos"]) >= MANY_IMAGES]
    for row in sorted(rows, key=lambda row: int(row["photos"])):
        measures = (
            f"{float(row['ms']):.3g}",
            f"{float(row['build_s']):.1f}",
            f"{float(row['right']):.1f}",
        )
        table.append([thousands(row["photos"]), row["variant"], *measures])
    return table


def runs_table() -> Table:
    """Compare whole runs with hloc's, stage by stage."""
    table = [["seconds", *STAGES, "all", "hloc / this", "fountain-P11", "features [MB]"]]
    table[0] += ["matches [MB]"]
    runs, others = (select(read("runs"), place=place) for place in RUN_PLACES)
    for row in sorted(runs, key=lambda row: -float(row["seconds"])):
        if row["variant"] not in SHOWN_RUNS and run_name(row) != FAST_RUN:
            continue
        [other] = select(others, **{key: row[key] for key in ("feature", "storage", "variant")})
        cells = [f"{float(row[f'{stage}_s']):.1f}" for stage in STAGES]
        cells += [f"{float(row['seconds']):.1f}"]
        for of_place, one in ((runs, row), (others, other)):
            [reference] = select(of_place, feature="hloc")
            cells += [f"{float(reference['seconds']) / float(one['seconds']):.1f}"]
        cells += [f"{float(row['feature_mb']):.1f}", f"{float(row['match_mb']):.2f}"]
        table.append([run_name(row), *cells])
    return table


def run_name(row: Row) -> str:
    """Name the feature of a run, and its keypoints unless they are found as by default."""
    keypoints = row["variant"].removesuffix(" keypoints")
    usual = keypoints in ("", KEYPOINT_SETTINGS[0])
    return name_of(row) + ("" if usual else f", `{keypoints}` keypoints")


def runs_cpu_table() -> Table:
    """Show the CPU seconds of whole runs, and those that no run of the same photos is without."""
    table = [["CPU seconds", *STAGES, "all", "of one pass of the detector", "of the products"]]
    runs = select(read("runs"), place=RUN_PLACES[0])
    usual = "", with_keypoints(KEYPOINT_SETTINGS[0])
    runs = [row for row in runs if row["variant"] in usual]
    for row in sorted(runs, key=lambda row: -cpu_of(row)):
        cells = [f"{float(row[f'{stage}_cpu_s']):.1f}" for stage in STAGES]
        limits = [row["extraction_limit_s"], row["matching_limit_s"]]
        cells += [f"{cpu_of(row):.1f}", *(f"{float(one):.1f}" if one else "" for one in limits)]
        table.append([run_name(row), *cells])
    return table


def cpu_of(row: Row) -> float:
    """Return the CPU seconds of a whole run."""
    return sum(float(row[f"{stage}_cpu_s"]) for stage in STAGES)


def extraction_table() -> Table:
    """Show how long features of a photo take on a core of a CPU."""
    table = [["feature", "keypoints", "CPU [s]"]]
    for row in select(read("extraction"), variant=ONE_CORE):
        seconds = f"{float(row['cpu_s']):.2f}"
        table.append([f"`{row['feature']}`", thousands(row["keypoints"]), seconds])
    return table


def scale_table() -> Table:
    """Show what all pairs of Aachen Day-Night cost, extrapolated."""
    rows = select(read("scale"), list="whole", variant="8000 keypoints")
    rows.sort(key=lambda row: -float(row["feature_mb"]))
    heads = [f"{row['feature']}, `{row['storage']}`" for row in rows]
    [triangulated] = select(read("scale"), list="whole", variant="triangulation")
    minutes = float(triangulated["triangulation_cpu_s"]) / 60
    gigabytes = float(triangulated["peak_mib"]) * 2**20 / 1e9
    return [
        ["", *heads],
        ["feature file [MB]", *(thousands(row["feature_mb"]) for row in rows)],
        ["match file [MB]", *(thousands(row["match_mb"]) for row in rows)],
        ["matching [minutes]", *(f"{float(row['matching_s']) / 60:.0f}" for row in rows)],
        ["triangulation, one core [minutes]", *(f"{minutes:.0f}" for _ in rows)],
        ["memory of the triangulation [GB]", *(f"{gigabytes:.1f}" for _ in rows)],
    ]


def ransacs_table() -> Table:
    """Show how long RANSACs take and what they localize, by the share of right matches."""
    rows = [row for row in read("ransacs") if not row["variant"].startswith(OLDEST)]
    parts = sorted({row["list"] for row in rows}, key=lambda part: int(part.split()[0]))
    table = [["CPU [ms], queries within 5 cm"]]
    for part in parts:
        queries = select(rows, list=part)[0]["queries"]
        table[0].append(f"{part} ({queries})")
    for variant in dict.fromkeys(row["variant"] for row in rows):
        of_variant = [select(rows, list=part, variant=variant) for part in parts]
        cells = [f"{float(row['ms']):.3g}, {row['within_5cm']}" for [row] in of_variant]
        table.append([variant, *cells])
    return table


def adding_table() -> Table:
    """Show what adding photos to a map costs, and building maps of the same photos."""
    variants = {"at once": "all at once", "others": "the others", "alone": "the 20 alone"}
    variants |= {"added": "the 20 added"}
    errors = ["median error, all at once [%]", "20 added [%]"]
    table = [["photos", *(f"{text} [s]" for text in variants.values()), *errors]]
    rows = read("adding")
    for place, part in dict.fromkeys((row["place"], row["list"]) for row in rows):
        found = {row["variant"]: row for row in select(rows, place=place, list=part)}
        cells = [f"{float(found[key]['cpu_s']):.0f}" for key in variants]
        cells += [f"{float(found[key]['median_percent']):.2g}" for key in ("at once", "added")]
        table.append([f"`{place}`, {part.split()[0]}", *cells])
    return table


def compact_scale_table() -> Table:
    """Show what compact maps of parts and of multiples of Aachen's size cost."""
    columns = {"mb": "file [MB]", "build_cpu_s": "build [s]", "build_mb": "build [MB]"}
    columns |= {"open_cpu_s": "open [s]", "resident_mb": "resident [MB]"}
    columns |= {"first_query_file_mb": "first query, touched [MB]"}
    columns |= {"query_file_mb": "a query, touched [MB]", "query_cpu_s": "a query [s]"}
    table = [["images", "points", *columns.values(), "localized"]]
    for row in sorted(read("compact_scale"), key=lambda row: float(row["mb"])):
        cells = [f"{float(f'{float(row[key]):.3g}'):,}".removesuffix(".0") for key in columns]
        counts = thousands(row["photos"]), thousands(row["points"])
        table.append([*counts, *cells, f"{row['localized']} of {row['queries']}"])
    return table


def matching_table() -> Table:
    """Show how long a pair of images takes to match, by dimensions and storage."""
    rows, storages = read("matching"), ("float32", "uint4")
    table = [["numbers", "hloc", "torch, floats", *(f"`{storage}`" for storage in storages)]]
    for dim in (128, 64, 32, 24, 16):
        found = select(rows, feature=f"{dim} numbers")
        cells = select(found, variant="hloc") or select(found, variant="torch")
        cells += select(found, variant="ours, run")
        for storage in storages:
            by_integers = select(found, storage=storage, commit=cells[0]["commit"])
            cells += [row for row in by_integers if row["variant"].startswith(f"{storage} by ")]
        if len(cells) != 2 + len(storages):
            raise InputError(f"results/matching.csv lacks rows of {dim} numbers.")
        table.append([str(dim), *(f"{float(row['ms']):.0f}" for row in cells)])
    return table


TABLES: dict[str, Callable[[], Table]] = {
    "lightglue_seconds": lightglue_seconds_table,
    "localizer": localizer_table,
    "tracking": tracking_table,
    "retrieval": retrieval_table,
    "runs": runs_table,
    "runs_cpu": runs_cpu_table,
    "extraction": extraction_table,
    "scale": scale_table,
    "ransacs": ransacs_table,
    "adding": adding_table,
    "compact_scale": compact_scale_table,
    "matching": matching_table,
}
