"""Tune LighterGlue to the keypoints and descriptors of a mini.

XFeat's LighterGlue sees XFeat's descriptors at the keypoints of the mini in two clean views, and
labels their matches: those near the epipolar lines of the known poses are right, and keypoints that
it finds no match for have none. The student learns these from the descriptors of the mini, where
the first view may be dark, noisy and blurred, and those of the second are floats or codes of 4 or 2
bits, as in a map. It starts from an adapter of LighterGlue for the mini, or from other weights for
it. An interrupted training resumes.
"""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import pycolmap
import torch
from safetensors.torch import save_file
from torch import nn

from .. import extract_features, extractors, logger
from ..confs import features as features_confs
from ..mapping.epipolar import epipolar_errors
from ..matchers.lightglue import LightGlue
from ..networks import MINI
from ..networks.lightglue import SUFFIX, identity, metadata_of
from ..pairs_from_covisibility import covisible
from ..runtime.versions import versions
from ..utils import cli, colmap, options
from ..utils.cli import InputError
from ..utils.files import file_sha256, replacing
from ..utils.images import read_image
from ..utils.options import Option
from ..utils.paths import strings_as_paths
from ..utils.progress import progress
from . import tracks
from .adapters import STORAGES, TEACHER, at_keypoints, rounded
from .degradation import degrade
from .loop import device, fit

SIDE = 640  # pixels of a view
CROPS = (0.6, 1.0)  # its side, as a share of the shorter side of the photo
NUM_COVISIBLE = 10  # photos that each is paired with
APART = 0.1  # share of pairs of photos of different places, which have no matches
DARK = 0.7  # share of first views that are degraded
NUM_KEYPOINTS = 512  # as dense as 2,048 in a photo of 1,600 pixels
RIGHT_PIXELS = 2.0  # from its epipolar lines, in both views
UNMATCHED = 0.1  # probability of any match, below which the teacher says that there is none
RECIPE = {"weight_decay": 0.0, "final_lr": 0.0}


@dataclass(frozen=True)
class Photo:
    """A photo of a map, RGB, with its intrinsics and pose."""

    pixels: np.ndarray
    camera: pycolmap.Camera
    cam_from_world: pycolmap.Rigid3d


@dataclass(frozen=True)
class View:
    """A square part of a photo, RGB uint8, and how to return to pixels of the photo."""

    pixels: np.ndarray
    corner: np.ndarray
    scale: float

    def in_photo(self, keypoints: np.ndarray) -> np.ndarray:
        """Return keypoints (N, 2) of the view in COLMAP's pixels of the photo."""
        return (keypoints + 0.5) * self.scale + self.corner


def read(
    maps: dict[str, tuple[Path, Path]],
) -> tuple[list[Photo], list[tuple[int, int]], np.ndarray]:
    """Read the photos of maps.

    Returns:
        The photos, the pairs of those that share points, and the number of the place of each.
    """
    photos: list[Photo] = []
    pairs: list[tuple[int, int]] = []
    places: list[int] = []
    for place, (images, model) in enumerate(maps.values()):
        reconstruction = colmap.read_model(model)
        numbers = {}
        for image in progress(
            reconstruction.images.values(), "Reading photos", "photo", len(reconstruction.images)
        ):
            numbers[image.name] = len(photos)
            pixels, camera = read_image(images / image.name), pycolmap.Camera(image.camera.todict())
            photos.append(Photo(pixels, camera, image.cam_from_world()))
            places.append(place)
        for name, others in covisible(reconstruction, NUM_COVISIBLE):
            pairs += [(numbers[name], numbers[other]) for other in others]
    return photos, pairs, np.array(places)


def cut(photo: Photo, rng: np.random.Generator) -> View:
    """Draw a square part of a photo, and resize it to SIDE."""
    height, width = photo.pixels.shape[:2]
    side = int(min(height, width) * rng.uniform(*CROPS))
    left, top = (int(rng.integers(size - side + 1)) for size in (width, height))
    part = photo.pixels[top : top + side, left : left + side]
    method = cv2.INTER_AREA if side > SIDE else cv2.INTER_LINEAR
    return View(
        cv2.resize(part, (SIDE, SIDE), interpolation=method), np.array([left, top]), side / SIDE
    )


def darkened(pixels: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return a view, RGB uint8, as a bad camera takes it, in grey."""
    grey = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY).astype(np.float32) / 255
    found = degrade(torch.from_numpy(grey)[None, None], rng)[0, 0].clamp(0, 1).numpy()
    return np.repeat(np.round(255 * found).astype(np.uint8)[..., None], 3, axis=2)


class Labels(nn.Module):
    """Draws pairs of views, and labels the matches of their keypoints.

    Args:
        feature: the mini.
        photos: of all maps.
        pairs: those that share points.
        places: the number of the place of each photo.
    """

    def __init__(
        self, feature: str, photos: list[Photo], pairs: list[tuple[int, int]], places: np.ndarray
    ):
        super().__init__()
        self.photos, self.pairs, self.places = photos, pairs, places
        self.conf = features_confs.confs[feature]
        model = {**self.conf["model"], "max_keypoints": NUM_KEYPOINTS}
        self.extractor = extractors.load(model).eval()
        self.sampled = extractors.load(features_confs.confs[TEACHER]["model"]).eval()
        self.teacher = LightGlue({"features": TEACHER, **WHOLE})

    def draw(self, rng: np.random.Generator) -> tuple[dict, dict, torch.Tensor, list[torch.Tensor]]:
        """Draw a pair.

        Returns:
            The inputs of the student, from `of_view`, of both views; the right matches (M, 2); and
            the keypoints of both without a match.
        """
        if rng.random() < APART and len(set(self.places.tolist())) > 1:
            first = int(rng.integers(len(self.photos)))
            second = int(rng.choice(np.flatnonzero(self.places != self.places[first])))
        else:
            first, second = self.pairs[rng.integers(len(self.pairs))]
        photos = self.photos[first], self.photos[second]
        views = [cut(photo, rng) for photo in photos]
        seen = [views[0].pixels, views[1].pixels]
        if rng.random() < DARK:
            seen[0] = darkened(seen[0], rng)
        preprocessing = self.conf["preprocessing"]
        found = [extractors.extract(self.extractor, pixels, preprocessing) for pixels in seen]
        clean = [
            at_keypoints(self.sampled, view.pixels, self.conf, one)
            for view, one in zip(views, found, strict=True)
        ]
        storage = str(rng.choice(STORAGES))
        own = [one["descriptors"].T.astype(np.float32) for one in found]
        own[1] = rounded(own[1], self.conf, storage)
        keypoints = [one["keypoints"] for one in found]
        student, teacher = (
            [of_view(*both) for both in zip(keypoints, described, strict=True)]
            for described in (own, clean)
        )
        matches, unmatched = self.label(teacher)
        if self.places[first] != self.places[second]:
            matches = matches[:0]
            unmatched = [torch.arange(len(part)) for part in keypoints]
        right = torch.from_numpy(self.are_right(photos, views, keypoints, matches.numpy()))
        return student[0], student[1], matches[right], unmatched

    @torch.no_grad()
    def label(self, views: Sequence[dict]) -> tuple[torch.Tensor, list[torch.Tensor]]:
        """Return the teacher's matches (M, 2), and the keypoints of both views without one."""
        if min(one["keypoints"].shape[1] for one in views) == 0:
            return torch.zeros(0, 2, dtype=torch.int64), [torch.zeros(0, dtype=torch.int64)] * 2
        found = self.teacher.net({"image0": views[0], "image1": views[1]})
        matched = found["matches0"][0] >= 0
        matches = torch.stack([matched.nonzero()[:, 0], found["matches0"][0][matched]], dim=1)
        probability = found["log_assignment"][0, :-1, :-1].exp()
        return matches, [(probability.sum(1 - i) < UNMATCHED).nonzero()[:, 0] for i in (0, 1)]

    def are_right(
        self,
        photos: Sequence[Photo],
        views: Sequence[View],
        keypoints: Sequence[np.ndarray],
        matches: np.ndarray,
    ) -> np.ndarray:
        """Return which matches (M, 2) are near the epipolar lines of the poses of both photos."""
        relative = photos[1].cam_from_world * photos[0].cam_from_world.inverse()
        rays, limits = [], []
        for i, (photo, view) in enumerate(zip(photos, views, strict=True)):
            rays.append(
                colmap.cam_from_img(photo.camera, view.in_photo(keypoints[i][matches[:, i]]))
            )
            limits.append(photo.camera.cam_from_img_threshold(RIGHT_PIXELS * view.scale))
        errors = epipolar_errors(relative, *rays)
        return (errors[0] <= limits[0]) & (errors[1] <= limits[1])


WHOLE = {"depth_confidence": -1, "width_confidence": -1}  # all layers, all keypoints


def of_view(keypoints: np.ndarray, descriptors: np.ndarray) -> dict[str, torch.Tensor]:
    """Return what LightGlue takes of a view: keypoints (N, 2) and descriptors (N, D)."""
    return {
        "keypoints": torch.from_numpy(keypoints).float().clamp(0, SIDE)[None],
        "descriptors": torch.from_numpy(np.ascontiguousarray(descriptors)).float()[None],
        "image_size": torch.full((1, 2), float(SIDE)),
    }


def loss(student: nn.Module, labels: Labels, batch: int, seed: int, step: int) -> torch.Tensor:
    """Compute the loss of a step: the mean negative log likelihood of the labels of some pairs."""
    rng, found = np.random.default_rng((seed, step)), []
    for _ in range(batch):
        *views, matches, unmatched = labels.draw(rng)
        if min(one["keypoints"].shape[1] for one in views) == 0:
            continue
        on_device = [{key: part.to(device()) for key, part in one.items()} for one in views]
        assignment = student({"image0": on_device[0], "image1": on_device[1]})["log_assignment"][0]
        terms = [assignment[matches[:, 0], matches[:, 1]]] if len(matches) else []
        alone = torch.cat([assignment[unmatched[0], -1], assignment[-1, unmatched[1]]])
        terms += [alone] if len(alone) else []
        if terms:
            found.append(-sum(term.mean() for term in terms) / len(terms))
    if not found:  # the gradient of nothing
        return 0 * torch.stack([part.sum() for part in student.parameters()]).sum()
    return torch.stack(found).mean()


@strings_as_paths
def main(
    output: Path,
    map: Annotated[Sequence[str], tracks.MAP_OPTION],
    feature: Annotated[str, Option("feature", MINI)] = MINI[0],
    start: Path | None = None,
    steps: int = 4000,
    batch: Annotated[int, Option(least=1)] = 1,
    lr: float = 1e-4,
    seed: int = 0,
) -> Path:
    """Tune LighterGlue.

    Args:
        output: file of the weights, .safetensors.
        map: maps to learn from.
        feature: the mini.
        start: file of hloc_reduce.training.adapters, or of this module, that the training starts
            from; default: what ships for the mini.
        steps: number of training steps.
        batch: pairs of views of a step.
        lr: learning rate of Adam, which falls linearly to 0.
        seed: seed of everything random.

    Returns:
        The file.

    Raises:
        InputError: when a map, the output or the start cannot be used, no photos share points, or
            the learning rate is not above 0.
    """
    if output.suffix != SUFFIX:
        raise InputError(f"--output {output}: it must end in {SUFFIX}.")
    if not 0 < lr < math.inf:
        raise InputError(f"--lr {lr:g}: it must be a number above 0.")
    maps = tracks.parse_maps(map)
    made_from = identity(extract_features.provenance(features_confs.confs[feature]))
    if start:
        if start.suffix != SUFFIX or not start.is_file():
            raise InputError(f"--start {start}: there is no such {SUFFIX} file.")
        if metadata_of(str(start))["made_from"] != made_from:
            raise InputError(f"--start {start}: these are not weights for {feature}.")
    photos, pairs, places = read(maps)
    if not pairs:
        raise InputError("No photos of the maps share points.")
    torch.manual_seed(seed)
    labels = Labels(feature, photos, pairs, places)
    student = LightGlue({"features": str(start or feature), **WHOLE}).net
    student = student.requires_grad_(True).to(device())
    recipe = {"lr": lr, **RECIPE}
    metadata: dict[str, Any] = {
        "maps": {name: len(np.flatnonzero(places == i)) for i, name in enumerate(maps)},
        "steps": steps,
        "batch": batch,
        "recipe": recipe,
        "seed": seed,
        "start": start and file_sha256(start),
    }
    checkpoint = output.with_suffix(".checkpoint")
    step_loss = partial(loss, student, labels, batch, seed)
    fit(student, step_loss, steps, recipe, checkpoint, json.dumps({**metadata, "of": feature}))
    header = {
        "network": TEACHER,
        "made_from": json.dumps(made_from),
        "training": json.dumps({**metadata, "versions": versions()}),
    }
    weights = {
        key: value.half().contiguous().cpu()
        for key, value in student.state_dict().items()
        if value.dtype.is_floating_point
    }
    with replacing(output) as temporary:
        save_file(weights, temporary, header)
    checkpoint.unlink(missing_ok=True)
    logger.info("The weights are in %s.", output)
    return output


def _main() -> None:
    example = "--map fox/images:fox/sparse --output weights/mini32.safetensors"
    options.call(main, __doc__, example)


if __name__ == "__main__":
    cli.run(_main)
