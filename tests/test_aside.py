"""Work beside the main thread is done in order, reports its failures, and is over when it is left."""

import threading
import time

import numba
import pytest

from lidarflow.aside import Aside, ahead, done, there

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
    with pytest.raises(ValueError, match="no more"):
        for item in ahead(failing_after(4, made)):
            for _ in range(200):
                if len(made) > min(item + 1, 3):
                    break
                time.sleep(0.01)
            assert made == list(range(min(item + 2, 4)))
            used.append(item)
    assert used == [0, 1, 2, 3]
    assert list(ahead(iter("abc"))) == ["a", "b", "c"]


def test_items_are_made_one_by_one_where_kernels_have_one_thread():
    made, before = [], numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        assert next(ahead(failing_after(4, made))) == 0
        assert made == [0]
    finally:
        numba.set_num_threads(before)


@needs_two_threads
def test_whoever_stops_early_leaves_no_thread_behind():
    begun = threading.active_count()
    items = ahead(iter(range(10)))
    assert next(items) == 0
    items.close()
    assert threading.active_count() == begun
