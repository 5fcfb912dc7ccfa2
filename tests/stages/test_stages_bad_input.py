"""Features and matches of other tools: stages read them, or name the file and the image."""

import shutil
from types import SimpleNamespace

import h5py
import numpy as np
import pytest

from hloc_reduce import aggregate_features, localize_sfm, match_features, storage, triangulation
from hloc_reduce.utils import parsers
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.match_files import names_to_pair

OURS = ("db/0.jpg", "query/6.jpg")  # the images of the scene that are changed


def put(group, key, value):
    if key in group:
        del group[key]
    if value is not None:
        group[key] = value


def into(key, change):
    """What changes a data set of an image."""
    return lambda group: put(group, key, change(group[key][()]))


def as_data_set(group):
    """Put a data set in the place of an image's group."""
    file, name = group.file, group.name
    del file[name]
    file[name] = np.zeros(3)


def as_group(key):
    def change(group):
        del group[key]
        group[f"{key}/numbers"] = np.zeros(3)

    return change


def with_uncertainty(value):
    def change(group):
        group["keypoints"].attrs["uncertainty"] = value

    return change


def with_nan(numbers):
    numbers[1, 5] = np.nan
    return numbers


LOCATED = ("map", "localize")  # the stages that need keypoints
DESCRIBED = ("match", "aggregate", "store")  # and those that need descriptors
# a change of two images of a feature file -> the stages that need what is wrong
FEATURES = {
    "as hloc's are": (lambda group: put(group, "image_size", np.array([640, 480])), ()),
    "no keypoints": (into("keypoints", lambda _: None), LOCATED),
    "no descriptors": (into("descriptors", lambda _: None), DESCRIBED),
    "keypoints (N,)": (into("keypoints", lambda k: k[:, 0]), LOCATED),
    "keypoints (N, 1)": (into("keypoints", lambda k: k[:, :1]), LOCATED),
    "keypoints (N, 5)": (into("keypoints", lambda k: np.pad(k, ((0, 0), (0, 3)))), ()),
    "keypoints of one number": (into("keypoints", lambda _: 3.0), LOCATED),
    "keypoints of text": (into("keypoints", lambda _: "none"), LOCATED),
    "keypoints of integers": (into("keypoints", lambda k: k.round().astype(np.int16)), ()),
    "keypoints of NaN": (into("keypoints", lambda k: with_nan(k.T).T), LOCATED),
    # which looks like one more image
    "keypoints in a group": (as_group("keypoints"), (*LOCATED, "aggregate", "store")),
    "no uncertainty": (with_uncertainty("much"), LOCATED),
    "negative uncertainty": (with_uncertainty(-1.0), LOCATED),
    "descriptors (N, D)": (into("descriptors", np.transpose), DESCRIBED),
    "descriptors (N,)": (into("descriptors", lambda d: d[0]), DESCRIBED),
    "descriptors of one number": (into("descriptors", lambda _: 3.0), DESCRIBED),
    "descriptors of NaN": (into("descriptors", with_nan), DESCRIBED),
    "descriptors of 32 numbers": (into("descriptors", lambda d: d[:32]), ("match", "aggregate")),
    "descriptors of integers": (into("descriptors", lambda d: np.round(d * 128).astype("i1")), ()),
    "descriptors in a group": (as_group("descriptors"), DESCRIBED),
    "image_size of one number": (lambda group: put(group, "image_size", 640), ("localize",)),
    "image_size of text": (lambda group: put(group, "image_size", "640x480"), ("localize",)),
    "image_size of NaN": (lambda group: put(group, "image_size", [np.nan] * 2), ("localize",)),
    "image_size of zeros": (lambda group: put(group, "image_size", np.zeros(2)), ("localize",)),
    "more data": (lambda group: put(group, "note", "from elsewhere"), ()),
    "empty data": (lambda group: put(group, "note", h5py.Empty("f4")), ()),
    "a data set": (as_data_set, (*LOCATED, *DESCRIBED)),
    "no image": (
        lambda group: put(group.file, group.name, None),
        ("match", "map", "localize", "aggregate"),
    ),
}


@pytest.fixture
def stages(scene, written_once):
    """The stages of a localization by name, each as a function of its features and matches."""
    root, names = scene.root, list(scene.poses)
    pairs, retrieval, every = (root / f"{name}.txt" for name in ("pairs", "retrieval", "every"))
    sound, matches, model = root / "sound.h5", root / "matches.h5", root / "sfm"
    conf = match_features.confs["NN-mutual"]

    def localize(features, matches):
        return localize_sfm.main(
            model, scene.queries, retrieval, features, matches, root / "results.txt"
        )

    def write() -> None:
        parsers.write_pairs([(a, b) for a in names[:6] for b in names[:6] if a < b], pairs)
        parsers.write_pairs([(a, b) for a in names[6:] for b in names[:6]], retrieval)
        every.write_text(pairs.read_text() + retrieval.read_text())
        shutil.copy(scene.features, sound)
        match_features.main(conf, every, sound, matches=matches)
        triangulation.main(model, scene.model, scene.images, pairs, sound, matches)
        assert all(record["localized"] for record in localize(sound, matches).values())

    written_once(root, write, "stages_bad_input")
    by_name = {
        "match": lambda features, _: match_features.main(
            conf, every, features, matches=root / "m.h5", overwrite=True
        ),
        "map": lambda features, matches, **options: triangulation.main(
            root / "other",
            scene.model,
            scene.images,
            pairs,
            features,
            matches,
            overwrite=True,
            **options,
        ),
        "localize": localize,
        "aggregate": lambda features, _: aggregate_features.main(
            aggregate_features.confs["vlad"], features, names[:6], overwrite=True
        ),
        "store": lambda features, _: storage.main(features, root / "s.h5", "uint8", overwrite=True),
    }
    return SimpleNamespace(by_name=by_name, sound=sound, matches=matches, retrieval=retrieval)


@pytest.mark.parametrize("kind", FEATURES)
def test_features_of_other_tools(kind, scene, stages):
    """A stage that needs what is wrong names the file and the image; others work."""
    change, refusing = FEATURES[kind]
    with h5py.File(scene.features, "r+") as file:
        for name in OURS:
            change(file[name])
    for stage, run in stages.by_name.items():
        if stage not in refusing:
            run(scene.features, stages.matches)
            continue
        with pytest.raises(InputError) as error:
            run(scene.features, stages.matches)
        message = str(error.value)
        assert str(scene.features) in message, (stage, message)
        # of a root group "db" with a data set it is not clear which image it is
        assert any(name in message for name in OURS) or kind == "a data set", (stage, message)


def first_match(value):
    def change(matches0):
        matches0[np.flatnonzero(matches0 >= 0)[0]] = value
        return matches0

    return change


def without_scores(change):
    def changes(group):
        change(group)
        del group["matching_scores0"]

    return changes


# changes of the matches of a pair: stages read those of the first, and refuse the others
READ = {
    "floats, no longer than needed": without_scores(  # as of hloc's match_dense
        into("matches0", lambda m: m[: np.flatnonzero(m >= 0)[-1] + 1].astype(float))
    ),
    "no scores": into("matching_scores0", lambda _: None),
}
REFUSED = {
    "no matches0": into("matches0", lambda _: None),
    "scores of another length": into("matching_scores0", lambda s: s[:-1]),
    "scores of NaN": into("matching_scores0", lambda s: s * np.nan),
    "too long": without_scores(into("matches0", lambda m: np.append(m, 0))),
    "too large": into("matches0", first_match(300)),
    "negative": into("matches0", first_match(-2)),
    "two columns": into("matches0", lambda m: np.stack([m, m], 1)),
    "one number": into("matches0", lambda _: 7),
    "text": into("matches0", lambda _: "none"),
    "in a group": as_group("matches0"),
    "a data set": as_data_set,
}


@pytest.mark.parametrize("kind", [*READ, *REFUSED])
def test_matches_of_other_tools(kind, stages):
    with h5py.File(stages.matches, "r+") as file:
        for name0, name1 in (("db/0.jpg", "db/1.jpg"), ("query/6.jpg", "db/0.jpg")):
            (READ | REFUSED)[kind](file[names_to_pair(name0, name1)])
    for stage in LOCATED:
        if kind in READ:
            stages.by_name[stage](stages.sound, stages.matches)
            continue
        with pytest.raises(InputError) as error:
            stages.by_name[stage](stages.sound, stages.matches)
        message = str(error.value)
        assert str(stages.matches) in message, message
        assert "db/0.jpg" in message.replace("-", "/"), message


def test_scores_are_needed_for_a_least_score_only(stages):
    with h5py.File(stages.matches, "r+") as file:
        del file[f"{names_to_pair('db/0.jpg', 'db/1.jpg')}/matching_scores0"]
    with pytest.raises(InputError, match="matches.h5: the pair db/0.jpg, db/1.jpg has no scores"):
        stages.by_name["map"](stages.sound, stages.matches, min_match_score=0.5)


def test_a_retrieved_image_that_is_not_in_the_map_is_left_out(scene, stages):
    stages.retrieval.write_text("query/6.jpg db/9.jpg\n" + stages.retrieval.read_text())
    records = stages.by_name["localize"](scene.features, stages.matches)
    assert records["query/6.jpg"]["localized"] and records["query/6.jpg"]["db"] == "db/0.jpg"
