import json
import os
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import BrokenExecutor

import cv2
import pytest
import torch
from threadpoolctl import threadpool_info, threadpool_limits

from hloc_reduce.runtime import parallel, processes, trace


def test_in_order_whoever_is_faster():
    def slow_first(i):
        time.sleep(0.05 * (i == 0))
        return i, threading.get_ident()

    results = list(parallel.ordered("test", slow_first, range(20), 4))
    assert [i for i, _ in results] == list(range(20))
    assert len({thread for _, thread in results}) > 1
    assert threading.get_ident() not in {thread for _, thread in results}


def test_items_are_drawn_as_workers_get_free():
    """Not all are in memory at once, however slow the work and the reader are."""
    drawn = []
    items = (drawn.append(i) or i for i in range(1000))
    results = parallel.ordered("test", lambda i: i, items, 2)
    assert next(results) == 0
    assert len(drawn) <= 1 + 2 * parallel.BACKLOG_RESULTS + 1
    results.close()


def test_one_thread_of_torch_in_each_worker():
    before = torch.get_num_threads()
    threads = list(parallel.ordered("test", lambda _: torch.get_num_threads(), range(4), 2))
    assert threads == [1] * 4 and torch.get_num_threads() == before


def test_one_thread_of_opencv_in_each_worker():
    before = cv2.getNumThreads()
    cv2.setNumThreads(3)
    try:
        found = parallel.ordered("count", lambda _: cv2.getNumThreads(), range(4), workers=2)
        assert list(found) == [1] * 4 and cv2.getNumThreads() == 3
    finally:
        cv2.setNumThreads(before)


def test_threads_are_as_before_whoever_ends_first():
    """Blocks of two threads overlap; the first one to begin is the first to end."""
    begun, ended = threading.Event(), threading.Event()

    def second():
        torch.set_num_threads(2)
        with parallel.one_thread():
            begun.set()
            ended.wait(10)
            numbers.append(torch.get_num_threads())
        numbers.append(torch.get_num_threads())

    before, numbers = torch.get_num_threads(), []
    torch.set_num_threads(3)
    try:
        with pytest.raises(ZeroDivisionError), parallel.one_thread():
            thread = threading.Thread(target=second)
            thread.start()
            begun.wait(10)
            raise ZeroDivisionError
        assert torch.get_num_threads() == 3
        ended.set()
        thread.join()
        assert numbers[0] == 1 and numbers[1] > 1
        assert parallel.cores() == torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(before)


def test_torch_is_imported_within_a_block():
    """As by a network's first photo."""
    code = (
        "from hloc_reduce.runtime import parallel\n"
        "with parallel.one_thread():\n"
        "    import torch\n"
        "    torch.set_num_threads(3)\n"
        "    with parallel.one_thread():\n"
        "        print(torch.get_num_threads())\n"
        "print(torch.get_num_threads())\n"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.split() == ["1", "3"]


def test_one_thread_of_numpy_in_each_worker():
    def threads(_=None):
        return {library["num_threads"] for library in threadpool_info() if is_blas(library)}

    def is_blas(library):
        return library["user_api"] == "blas"

    with threadpool_limits(3, "blas"):
        first = parallel.ordered("one", threads, range(4), 2)
        assert next(first) == {1}
        assert list(parallel.ordered("two", threads, range(4), 2)) == [{1}] * 4
        assert threads() == {1}  # the first goes on
        first.close()
        assert threads() == {3}


def test_libraries_are_found_again_after_an_import(monkeypatch):
    """It takes 4 ms, of the 300 that a photo is localized in."""
    found, find = [], parallel.ThreadpoolController
    monkeypatch.setattr(parallel, "ThreadpoolController", lambda: found.append(1) or find())
    monkeypatch.setattr(parallel, "_libraries", None)
    for _ in range(3):
        with parallel.one_thread():
            pass
    assert len(found) == 1
    monkeypatch.setitem(sys.modules, "imported_meanwhile", sys)
    with parallel.one_thread():
        pass
    assert len(found) == 2


def test_an_error_ends_it():
    done = []

    def fail(i):
        if i == 3:
            raise ValueError("the third")
        done.append(i)
        return i

    results = parallel.ordered("test", fail, range(1000), 2)
    with pytest.raises(ValueError, match="the third"):
        list(results)
    assert len(done) < 30


def test_what_was_drawn_before_drawing_fails_is_done(monkeypatch):
    def items():
        yield from range(8)
        time.sleep(0.1)
        raise ValueError("broken")

    done = []
    with pytest.raises(ValueError, match="broken"):
        for result in parallel.ordered("work", lambda item: item, items(), 2):
            done.append(result)
    assert done == list(range(8))


def test_overlapping_work_leaves_as_many_threads_as_before():
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        first = parallel.ordered("one", lambda item: item, range(3), 1)
        next(first)
        second = parallel.ordered("two", lambda item: item, range(3), 1)
        next(second)
        assert parallel.cores() == 3 and torch.get_num_threads() == 1
        first.close()
        assert parallel.cores() == 3 and torch.get_num_threads() == 1
        second.close()
        assert parallel.cores() == torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(before)


def test_trace_shows_what_ran_where(tmp_path):
    with trace.recording(tmp_path / "new/trace.json"), trace.span("stage"):
        list(parallel.ordered("work", time.sleep, [0.01] * 3, 2))
    assert trace._events is None
    events = json.loads((tmp_path / "new/trace.json").read_text())["traceEvents"]
    assert sorted({event["name"] for event in events}) == ["read to work", "stage", "work"]
    (stage,) = [event for event in events if event["name"] == "stage"]
    work = [event for event in events if event["name"] == "work"]
    assert len(work) == 3 and all(event["dur"] >= 1e4 for event in work)
    assert all(stage["tid"] != event["tid"] for event in work)
    assert all(stage["ts"] <= e["ts"] <= stage["ts"] + stage["dur"] for e in work)


def test_nothing_is_recorded_unasked(tmp_path):
    with trace.recording(None), trace.span("stage"):
        assert trace._events is None


def test_a_run_that_was_refused_leaves_an_earlier_trace(tmp_path):
    with trace.recording(tmp_path / "trace.json"):
        pass
    assert list(tmp_path.iterdir()) == []


def test_processes_work_and_end_with_a_script(tmp_path):
    """Of any kind: without a main guard, which multiprocessing would ask for, and killed."""
    script = tmp_path / "script.py"
    script.write_text(
        "import os, time\n"
        "from hloc_reduce.runtime import processes\n"
        "with processes.pool(2) as pool:\n"
        "    print(pool.submit(os.getpid).result(), flush=True)\n"
        "    pool.submit(time.sleep, 100).result()\n"
    )
    with subprocess.Popen([sys.executable, script], stdout=subprocess.PIPE, text=True) as running:
        worker = int(running.stdout.readline())
        assert worker != running.pid
        running.kill()
    for _ in range(100):
        try:
            os.kill(worker, 0)
        except ProcessLookupError:
            return
        time.sleep(0.2)
    pytest.fail("the worker is still there")


def test_a_killed_process_is_an_error():
    with processes.pool(2) as pool:
        worker = pool.submit(os.getpid).result()
        os.kill(worker, signal.SIGKILL)
        with pytest.raises(BrokenExecutor):
            for _ in range(50):
                pool.submit(time.sleep, 0.1).result()
