"""Training takes strings for paths, as hloc does."""

import numpy as np
import pytest

from hloc_reduce.training import __main__ as training
from hloc_reduce.training import patch_tracks, tracks
from hloc_reduce.utils.cli import InputError


def test_training_takes_strings_for_paths(plane, tmp_path):
    place = plane / "images", plane / "model"
    strings = tuple(map(str, place))
    out = str(tmp_path / "weights"), str(tmp_path / "cache")
    (path,) = training.main({"plane": strings}, [], "sift", "pca", [16], *out)
    assert path == tmp_path / "weights/sift_pca16.safetensors" and path.is_file()
    of_strings = tracks.load(tracks.main(*strings, str(tmp_path / "cache/plane")))  # made already
    of_paths = tracks.load(tracks.main(*place, plane / "a"))
    assert np.array_equal(of_strings.track, of_paths.track)
    with pytest.raises(InputError, match="not a PhotoTour sequence"):
        patch_tracks.main(str(tmp_path), str(tmp_path / "cache"))
    with pytest.raises(InputError, match="not a PhotoTour sequence"):
        training.main({}, [str(tmp_path)], "sift", "pca", [16], *out)
