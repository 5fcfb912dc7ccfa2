"""A batch on a Ray cluster of several nodes: the same results, also when one is removed."""

import errno
import json
import os
import signal
import subprocess
import sys
import threading
import time
from functools import partial

import pytest
import survival
from command import contents, results

from hloc_reduce import demo, extract_features, match_features
from hloc_reduce.runtime.executors import SERIAL, processes_of_this_machine, ray_cluster
from hloc_reduce.utils import interrupts
from hloc_reduce.utils.cli import InputError
from pipelines import aachen, batch

pytestmark = pytest.mark.check


@pytest.fixture(scope="module", autouse=True)
def ray():
    return pytest.importorskip("ray")


@pytest.fixture(scope="module")
def cluster(ray):
    from ray.cluster_utils import Cluster

    # no node can import this module
    ray.cloudpickle.register_pickle_by_value(sys.modules[__name__])
    cluster = Cluster()
    for _ in range(2):
        cluster.add_node(num_cpus=1, object_store_memory=80 * 2**20)
    yield cluster
    cluster.shutdown()


def slow_squares(items):
    import ray

    for i in items:
        time.sleep(0.2)
        yield i, i * i, os.environ["OMP_NUM_THREADS"], ray.get_runtime_context().get_node_id()


def torch_home(items):
    yield os.environ["TORCH_HOME"]


def failing(error, items):
    raise error(*items)
    yield


def test_a_node_is_removed(cluster):
    node = cluster.add_node(num_cpus=1, object_store_memory=80 * 2**20)
    with ray_cluster(cluster.address) as executor:
        assert executor.workers() == 3
        found, nodes = [], set()
        for i, square, threads, node_id in executor.map(slow_squares, range(40), 2):
            assert threads == "1"
            found.append((i, square))
            nodes.add(node_id)
            if node is not None and node.node_id in nodes:
                cluster.remove_node(node, allow_graceful=False)
                node = None
        assert node is None and len(nodes) == 3
        assert sorted(found) == [(i, i * i) for i in range(40)]


@pytest.mark.long
def test_work_that_uses_a_gpu_is_done_where_one_is(cluster, monkeypatch):
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES")  # a node must not hide the GPU that it pretends

    def nodes_of(executor, gpu):
        found = list(executor.map(slow_squares, range(8), 1, gpu))
        assert len(found) == 8
        return {node for *_, node in found}

    with ray_cluster(cluster.address) as executor:
        assert nodes_of(executor, True)  # there is none yet
        joined = cluster.add_node(num_cpus=1, num_gpus=1, object_store_memory=80 * 2**20)
        try:
            assert nodes_of(executor, True) == {joined.node_id}
            results = executor.map(slow_squares, range(60), 2, True)
            found = [next(results)]
        finally:
            cluster.remove_node(joined)
        found += results  # by the cores of others
        assert sorted(item[:2] for item in found) == [(i, i * i) for i in range(60)]
        assert {node for *_, node in found} > {joined.node_id}


def test_weights_are_where_the_command_finds_them(cluster, tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    for given in (str(tmp_path), "~"):
        monkeypatch.setenv("TORCH_HOME", given)
        with ray_cluster(cluster.address) as executor:
            assert list(executor.map(torch_home, [0], 1)) == [str(tmp_path)]


def test_handlers_of_signals_are_as_before(cluster):
    handler = signal.signal(signal.SIGTERM, lambda *_: None)
    try:
        mine = signal.getsignal(signal.SIGTERM)
        with ray_cluster(cluster.address):
            assert signal.getsignal(signal.SIGTERM) is mine
        with pytest.raises(InputError), ray_cluster("nowhere"):
            pass
        assert signal.getsignal(signal.SIGTERM) is mine
    finally:
        signal.signal(signal.SIGTERM, handler)


@pytest.mark.long
def test_a_cluster_is_used_in_a_thread(cluster):
    def use():
        with ray_cluster(cluster.address) as executor:
            found.extend(item[1] for item in executor.map(slow_squares, range(4), 1))

    found = []
    thread = threading.Thread(target=use)
    thread.start()
    thread.join()
    assert sorted(found) == [0, 1, 4, 9]


def test_an_error_is_as_in_this_process(cluster):
    with ray_cluster(cluster.address) as executor, pytest.raises(InputError, match="^item 0$"):
        list(executor.map(partial(failing, InputError), ["item 0"], 5))
    with ray_cluster(cluster.address) as executor:
        with pytest.raises(OSError, match="No space left") as error:
            full = [errno.ENOSPC, os.strerror(errno.ENOSPC)]
            list(executor.map(partial(failing, OSError), full, 5))
        assert type(error.value) is OSError
        with pytest.raises(ZeroDivisionError, match="a bug"):
            list(executor.map(partial(failing, ZeroDivisionError), ["a bug"], 5))


@pytest.mark.parametrize("address", ["127.0.0.1:9", "ray://127.0.0.1:9", "nowhere", "a:99999"])
def test_a_cluster_that_does_not_answer(address):
    with pytest.raises(InputError, match=f"{address} does not answer"), ray_cluster(address):
        pass


def test_a_pipeline_is_the_same(cluster, aachen_layout, tmp_path, monkeypatch):
    for module in (extract_features, match_features):
        monkeypatch.setattr(module, "CHUNK", 1)
    aachen.main(aachen_layout, tmp_path / "serial/run", "sift_sv32", executor=SERIAL)
    node = cluster.add_node(num_cpus=1, object_store_memory=80 * 2**20)
    removed = threading.Timer(1, cluster.remove_node, (node,), {"allow_graceful": False})
    with ray_cluster(cluster.address) as executor:
        removed.start()
        aachen.main(aachen_layout, tmp_path / "ray/run", "sift_sv32", executor=executor)
    removed.join()
    assert results(tmp_path / "serial/run") == results(tmp_path / "ray/run")


BEGINNING = """
import time
from hloc_reduce.runtime.executors import ray_cluster
from hloc_reduce.utils import cli

def main():
    print("begins", flush=True)
    with ray_cluster("local"):
        time.sleep(60)

cli.run(main)
"""


@pytest.mark.parametrize(
    "kind, delay",
    [
        (signal.SIGTERM, 1.5),
        *(
            pytest.param(kind, delay, marks=pytest.mark.long)
            for kind in (signal.SIGINT, signal.SIGTERM)
            for delay in (0, 0.5, 1, 2, 3, 4, 6)
        ),
    ],
)
def test_nothing_of_a_cluster_that_began_is_left(kind, delay):
    run = subprocess.Popen(
        [sys.executable, "-c", BEGINNING], stdout=-1, stderr=-1, text=True, start_new_session=True
    )
    assert run.stdout.readline() == "begins\n"
    time.sleep(delay)
    run.send_signal(kind)
    said = run.communicate(timeout=60)[1]
    assert run.returncode == 128 + kind, said
    assert said.splitlines()[-1].endswith(interrupts.INTERRUPTED)
    end = time.monotonic() + 5
    while left := survival.processes_of_session(run.pid):
        assert time.monotonic() < end, left
        time.sleep(0.1)


@pytest.mark.long
def test_a_grid_of_real_photos_and_the_demo_is_the_same(
    cluster, herz_jesus, base_weights, tmp_path, monkeypatch
):
    base_weights("mkd")
    demo.main(tmp_path / "demo_town")
    grid = {
        "dataset": [str(herz_jesus), str(tmp_path / "demo_town")],
        "feature": {"descriptor": ["sift", "mkd"], "scheme": "sv", "dim": [64, 16]},
    }
    job_file = tmp_path / "grid.yaml"
    job_file.write_text(json.dumps({"jobs": [grid]}))
    with processes_of_this_machine() as executor:
        rows = batch.main(job_file, tmp_path / "processes", executor=executor)
    with ray_cluster(cluster.address) as executor:
        on_ray = batch.main(job_file, tmp_path / "ray", executor=executor)
    recall = [
        [(row["job"], row["list"], row["recall_percent"]) for row in r] for r in (rows, on_ray)
    ]
    assert recall[0] == recall[1] and len(recall[0]) == 2 * 4 * 2 * 3
    for place in (herz_jesus.name, "demo_town"):
        for path in (tmp_path / "ray" / place).glob("*/queries.csv"):
            other = tmp_path / "processes" / path.relative_to(tmp_path / "ray")
            assert path.read_text() == other.read_text()
        for path in (tmp_path / "ray" / place / "shared").glob("feats*.h5"):
            assert contents(path) == contents(tmp_path / "processes" / place / "shared" / path.name)
