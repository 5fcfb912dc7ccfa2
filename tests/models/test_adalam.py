"""AdaLAM: of nearest neighbours, those stay that move as others around them do."""

import cv2
import numpy as np
import pytest
import torch
from command import outcome

from hloc_reduce import Localizer, compact
from hloc_reduce.matchers.adalam import AdaLAM
from hloc_reduce.utils.cli import InputError
from pipelines import localize

PIPELINE = localize
KEYS = ("keypoints", "descriptors", "scales", "oris", "image_size")


@pytest.fixture
def turned() -> tuple[dict, dict, int]:
    """Two photos, the second one turned by 20 degrees and 1.2 times as large.

    Keypoint i has the descriptor of keypoint i, but only the first 200 of 300 are at the same place
    of the scene.
    """
    generator = np.random.default_rng(0)
    first = generator.uniform(0, [640, 480], (300, 2))
    matrix = cv2.getRotationMatrix2D((0, 0), -20, 1.2)[:, :2]
    second = first @ matrix.T + generator.normal(0, 0.3, first.shape)
    second -= second.min(axis=0)
    second[200:] = generator.permutation(second[200:])
    descriptors = generator.standard_normal((32, 300))
    descriptors /= np.linalg.norm(descriptors, axis=0)
    scales, oris = np.geomspace(2, 20, 300), generator.uniform(0, 340, 300)
    generator.shuffle(scales)
    photos = (
        (first, descriptors, scales, oris, np.array([640, 480])),
        (second, descriptors, 1.2 * scales, oris + 20, second.max(axis=0)),
    )
    features = (
        {
            key: torch.from_numpy(value.astype(np.float32))
            for key, value in zip(KEYS, one, strict=True)
        }
        for one in photos
    )
    return *features, 200


def test_keypoints_that_move_elsewhere_do_not_match(turned):
    *pair, number = turned
    ((matches, scores),) = AdaLAM({}).match([pair])
    assert (matches[:number] == torch.arange(number)).all()
    assert (matches[number:] == -1).float().mean() > 0.9
    torch.testing.assert_close(scores, (matches >= 0).float())  # equal descriptors


@pytest.mark.parametrize("key", ["oris", "scales"])
def test_turns_and_scales_have_to_agree(turned, key):
    first, second, number = turned
    mixed = torch.from_numpy(np.random.default_rng(1).permutation(second[key]))
    ((matches, _),) = AdaLAM({}).match([(first, second | {key: mixed})])
    assert (matches[:number] >= 0).float().mean() < 0.5


@pytest.mark.parametrize("number0, number1", [(0, 5), (5, 0), (1, 5), (5, 1), (0, 0)])
def test_few_keypoints(turned, number0, number1):
    pair = [
        {key: value if key == "image_size" else value[..., :number] for key, value in one.items()}
        | {"keypoints": one["keypoints"][:number]}
        for one, number in zip(turned, (number0, number1), strict=False)
    ]
    ((matches, scores),) = AdaLAM({}).match([pair])
    assert matches.tolist() == [-1] * number0 and scores.tolist() == [0] * number0


def test_photos_are_localized_by_it(place, run, refused, tmp_path):
    """In files and in memory alike; not in compact maps, and not by features of networks."""
    build, images, outputs = place
    photos = images / "query/day"
    given = ("--matcher", "adalam", "--query_images", photos)
    run(*build, *given, "--feature", "colmap_sift_sv32")
    _, rows = outcome(outputs / "queries-day")
    row = rows["a.png"]
    assert row["status"] == "localized" and int(row["num_inliers"]) > 100
    pose, info = Localizer(outputs / "map").localize(photos / "a.png")
    assert pose is not None and info["num_matches"] == int(row["num_matches"])
    with pytest.raises(InputError, match="adalam, which needs scales and oris of keypoints"):
        compact.main(tmp_path / "place.hlm", outputs / "map")
    message = refused(*build[:-1], tmp_path / "o", "--matcher", "adalam", "--feature", "mini32")
    assert message.startswith("The matcher adalam needs scales and oris, which the features in ")
