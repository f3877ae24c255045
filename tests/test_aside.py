"""Work beside the main thread is done in order, reports its failures, and is over when it is left."""

import os
import subprocess
import sys
import threading
import time

import numba
import pytest

from lidarflow.aside import Aside, ahead, done, one_by_one, there

needs_two_threads = pytest.mark.skipif(
    numba.config.NUMBA_NUM_THREADS < 2, reason="kernels have one thread here: nothing is done beside it")


@needs_two_threads
def test_work_is_done_in_order_in_another_thread_and_is_over_at_the_end():
    seen = []

    def work(number: int) -> str:
        time.sleep(0.02 * (3 - number))
        seen.append(number)
        return threading.current_thread().name

    with Aside() as beside:
        begun = [beside.begin(work, number) for number in range(3)]
    assert seen == [0, 1, 2]
    assert all(one.done() for one in begun)
    assert {one.result() for one in begun}.isdisjoint({threading.current_thread().name})


def test_a_failure_is_raised_where_the_result_is_asked_for():
    with Aside() as beside:
        begun = beside.begin(int, "no number")
        with pytest.raises(ValueError, match="no number"):
            begun.result()
        assert beside.begin(int, "7").result() == 7


def test_with_one_thread_everything_is_done_at_once():
    before = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        with Aside() as beside:
            begun = beside.begin(threading.current_thread)
            assert begun.done() and begun.result() is threading.current_thread()
    finally:
        numba.set_num_threads(before)


@pytest.mark.parametrize("layer", ["workqueue", "of some later numba"])
def test_everything_is_done_at_once_where_two_threads_may_not_run_kernels(monkeypatch, layer):
    monkeypatch.setattr(numba, "threading_layer", lambda: layer)
    with Aside() as beside:
        assert beside.begin(threading.get_ident).result() == threading.get_ident()
        assert set(beside.each(lambda _: threading.get_ident(), range(9))) == {threading.get_ident()}
    made: list[int] = []
    with ahead(failing_after(4, made)) as items:
        assert next(items) == 0 and made == [0]


@needs_two_threads
def test_a_pair_is_estimated_by_numbas_workqueue():
    program = """
import numba, numpy as np
from lidarflow import estimate_flow, synthetic
scene = synthetic.one_car(8.0, np.random.default_rng(2))
(source, truth), (target, _) = synthetic.scan_sequence(
    scene, synthetic.hdl64e(columns=450), 2, np.random.default_rng(3))
result = estimate_flow((source, target))
assert numba.threading_layer() == "workqueue"
off_m = np.linalg.norm(result.flow - truth.flow, axis=1)
assert len(result.objects) == 1 and np.median(off_m[truth.is_dynamic]) < 0.02
"""
    environment = {**os.environ, "NUMBA_THREADING_LAYER": "workqueue"}
    ended = subprocess.run([sys.executable, "-c", program], env=environment, timeout=300, check=False,
                           capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr


@needs_two_threads
def test_items_are_shared_between_threads_and_answers_come_in_order():
    both = threading.Barrier(2, timeout=5.0)
    done_by: dict[int, int] = {}

    def work(number: int) -> int:
        if number in (0, 1):
            both.wait()      # neither goes on before the other thread has taken one as well
        done_by[number] = threading.get_ident()
        return number * number

    with Aside() as beside:
        assert beside.each(work, range(20)) == [number * number for number in range(20)]
        assert beside.each(work, []) == []
    assert len(set(done_by.values())) == 2 and threading.get_ident() in done_by.values()


@needs_two_threads
def test_a_thread_that_is_busy_is_not_waited_for():
    go_on = threading.Event()
    with Aside() as beside:
        busy = beside.begin(go_on.wait, 5.0)
        try:
            assert beside.each(abs, [-1, 2, -3]) == [1, 2, 3] == one_by_one(abs, [-1, 2, -3])
            assert not busy.done()
        finally:
            go_on.set()
        assert busy.result()
        assert beside.begin(int, "7").result() == 7


def test_what_fails_for_an_item_is_raised_and_nothing_is_left_under_way():
    seen = []

    def work(number: int) -> None:
        seen.append(number)
        if number == 3:
            raise ValueError("not this one")

    with Aside() as beside:
        for _ in range(20):
            with pytest.raises(ValueError, match="not this one"):
                beside.each(work, range(8))
            count = len(seen)
            time.sleep(0.001)
            assert len(seen) == count


def test_what_is_done_or_there_needs_no_waiting():
    assert done(divmod, 7, 2).result() == (3, 1)
    assert there(None).done() and there(None).result() is None


def failing_after(count: int, made: list[int]):
    for number in range(count):
        made.append(number)
        yield number
    raise ValueError("no more")


@needs_two_threads
def test_the_next_item_is_made_while_the_last_is_used():
    made, used = [], []
    with pytest.raises(ValueError, match="no more"), ahead(failing_after(4, made)) as items:
        for item in items:
            for _ in range(200):
                if len(made) > min(item + 1, 3):
                    break
                time.sleep(0.01)
            assert made == list(range(min(item + 2, 4)))
            used.append(item)
    assert used == [0, 1, 2, 3]
    with ahead(iter("abc")) as items:
        assert list(items) == ["a", "b", "c"]


def test_items_are_made_one_by_one_where_kernels_have_one_thread():
    made, before = [], numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        with ahead(failing_after(4, made)) as items:
            assert next(items) == 0
            assert made == [0]
    finally:
        numba.set_num_threads(before)


@needs_two_threads
def test_whoever_stops_early_leaves_a_thread_that_the_next_one_uses():
    used, made = set(), []

    def idents():
        while True:
            made.append(threading.get_ident())
            yield made[-1]

    with Aside() as beside:
        used.add(beside.begin(threading.get_ident).result())
    begun = threading.active_count()
    for _ in range(5):
        with pytest.raises(ValueError, match="the disk is full"), ahead(idents()) as items:
            used.add(next(items))
            raise ValueError("the disk is full")
        so_far = len(made)
        time.sleep(0.01)
        assert len(made) == so_far
    assert threading.active_count() == begun and len(used) == 1


@needs_two_threads
def test_work_within_work_has_threads_of_its_own():
    def inner() -> int:
        with Aside() as beside:
            return beside.begin(threading.get_ident).result()

    with Aside() as beside:
        outer = beside.begin(threading.get_ident).result()
        assert len({outer, beside.begin(inner).result(), threading.get_ident()}) == 3


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork here")
@needs_two_threads
def test_a_forked_child_begins_threads_of_its_own():
    program = """
import os, sys
from lidarflow.aside import Aside
with Aside() as beside:
    beside.begin(int, "1").result()
child = os.fork()
with Aside() as beside:
    found = beside.begin(int, "7").result()
if child == 0:
    os._exit(found)
sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""
    assert subprocess.run([sys.executable, "-c", program], timeout=60, check=False).returncode == 7
