"""Work in this process, and in others: the results are the same."""

import os
import signal
from concurrent.futures import Future
from functools import partial

import numpy as np
import pytest
from command import contents, results

from hloc_reduce import extract_features, localize_inloc, match_features
from hloc_reduce.runtime import executors
from hloc_reduce.runtime.executors import SERIAL, Pool, processes_of_this_machine
from hloc_reduce.runtime.group_writer import GroupWriter, fill
from hloc_reduce.utils.cli import InputError
from pipelines import aachen, inloc

pytestmark = pytest.mark.check


@pytest.fixture(scope="module")
def pool():
    with processes_of_this_machine(2) as pool:
        yield pool


def squares(items):
    for i in items:
        yield i, i * i


def failing(items):
    for i in items:
        if i == 7:
            raise InputError("seven")
        yield i


def killed(items):
    for i in items:
        if i == 7:
            os.kill(os.getpid(), signal.SIGKILL)
        yield i


def test_each_item_once(pool):
    for executor in (SERIAL, pool):
        assert sorted(executor.map(squares, iter(range(100)), 3)) == [
            (i, i * i) for i in range(100)
        ]
        assert list(executor.map(squares, [], 3)) == []


def test_items_are_drawn_as_workers_get_free():
    drawn, handed = [], []

    def submit(work, items):
        handed.append(items)
        future = Future()
        future.set_result(list(work(items)))
        return future

    results = Pool(submit, lambda: 2).map(squares, (drawn.append(i) or i for i in range(1000)), 5)
    assert next(results) in [(i, i * i) for i in range(20)]
    assert len(drawn) == 5 * 2 * executors.BACKLOG_CHUNKS


@pytest.mark.parametrize("work, message", [(failing, "seven"), (killed, "A process was killed")])
def test_what_fails_is_one_clear_error(work, message):
    with processes_of_this_machine(2) as pool, pytest.raises(InputError, match=message):
        list(pool.map(work, range(100), 2))


def test_a_killed_process_concerns_its_own_work():
    with processes_of_this_machine(2) as pool:
        with pytest.raises(InputError, match="A process was killed"):
            list(pool.map(killed, range(100), 2))
        assert sorted(pool.map(squares, range(20), 3)) == [(i, i * i) for i in range(20)]


def groups(fail_at, items):
    for i in items:
        if i == fail_at:
            raise InputError("an image")
        yield 0, (f"{i % 3}/{i}", {"a": np.full(3, i)}, {"a": {"x": i}})


def test_groups_are_the_same_and_a_failure_loses_none_that_is_done(pool, tmp_path):
    for executor in (SERIAL, pool):
        path = tmp_path / f"{type(executor).__name__}.h5"
        with pytest.raises(InputError, match="an image"), GroupWriter(path, {}) as writer:
            list(fill({0: writer}, partial(groups, 30), range(50), executor, 4))
        with GroupWriter(path, {}) as writer:
            todo = [i for i in range(50) if f"{i % 3}/{i}" not in writer]
            assert 30 in todo and len(todo) < 50 - 12
            found = fill({0: writer}, partial(groups, None), todo, executor, 4)
            assert sorted(found) == sorted((0, f"{i % 3}/{i}") for i in todo)
    assert contents(tmp_path / "Serial.h5") == contents(tmp_path / "Pool.h5")
    assert len(contents(path)) == 51


@pytest.mark.parametrize("layout, pipeline", [("aachen_layout", aachen), ("inloc_layout", inloc)])
def test_a_pipeline_is_the_same(layout, pipeline, pool, request, tmp_path, monkeypatch):
    place = request.getfixturevalue(layout)
    for module in (extract_features, match_features, localize_inloc):
        monkeypatch.setattr(module, "CHUNK", 2)
    for name, executor in (("serial", SERIAL), ("pool", pool)):
        outputs = tmp_path / name / "run"
        pipeline.main(place, outputs, "sift_sv32", executor=executor)
    assert results(tmp_path / "serial/run") == results(tmp_path / "pool/run")
