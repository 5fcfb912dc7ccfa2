"""Download photos of places that no map of ours shows, from public repositories.

They are the photos of strangers that `benchmarks.trials --strangers` tries on each map: tourists'
photos of landmarks, rooms, a desk by a depth camera, a church by a phone, a tower by a drone.
Needs git. Repositories whose photos are there are skipped.
"""

import subprocess
import tempfile
from pathlib import Path

from hloc_reduce.utils import cli
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.progress import progress

HOST = "https://github.com"
# of each repository, its photos or folders of them
PHOTOS = {
    "cvg/Hierarchical-Localization": ("datasets/sacre_coeur/mapping",),
    "cvg/LightGlue": ("assets/DSC_0410.JPG", "assets/DSC_0411.JPG"),
    "magicleap/SuperGluePretrainedNetwork": (
        "assets/freiburg_sequence",
        "assets/phototourism_sample_images",
        "assets/scannet_sample_images",
    ),
    "mapillary/OpenSfM": ("data/berlin/images", "data/lund/images"),
    "mihaidusmanu/d2-net": ("qualitative/images",),
    "naver/mast3r": ("assets/NLE_tower",),
    "verlab/accelerated_features": ("assets/ref.png", "assets/tgt.png"),
}
ENDINGS = ".jpg", ".jpeg", ".png"
# only the chosen photos are downloaded
CLONE = "--quiet", "--depth=1", "--filter=blob:none", "--no-checkout"


def main(output: Path) -> None:
    """Download all photos into `output/<owner>+<name>/`.

    Raises:
        InputError: if git fails, as without a network.
    """
    output.mkdir(parents=True, exist_ok=True)
    for repository, paths in progress(list(PHOTOS.items()), "strangers", "repository"):
        folder = output / repository.replace("/", "+")
        if folder.exists():
            continue
        with tempfile.TemporaryDirectory(dir=output) as temporary:
            clone, chosen = Path(temporary) / "clone", Path(temporary) / "photos"
            url = f"{HOST}/{repository}.git"
            _git("clone", *CLONE, url, str(clone))
            _git("-C", str(clone), "checkout", "--quiet", "HEAD", "--", *paths)
            chosen.mkdir()
            for path in sorted(clone.rglob("*")):
                if path.suffix.lower() in ENDINGS:
                    path.rename(chosen / "-".join(path.relative_to(clone).parts))
            chosen.rename(folder)
        print(f"{folder}: {len(list(folder.iterdir()))} photos")


def _git(*arguments: str) -> None:
    try:
        subprocess.run(["git", *arguments], check=True, capture_output=True, text=True)
    except subprocess.CalledProcessError as error:
        raise InputError(f"git {arguments[0]} failed: {error.stderr.strip()}") from error
    except FileNotFoundError as error:
        raise InputError("git was not found: install it.") from error


def _main() -> None:
    parser = cli.Parser(__doc__, "--output datasets/strangers")
    parser.add_argument("--output", type=Path, default=Path("datasets/strangers"))
    main(parser.parse_args().output)


if __name__ == "__main__":
    cli.run(_main)
