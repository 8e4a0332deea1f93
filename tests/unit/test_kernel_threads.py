"""Ranges of images and the threads that work on them: the same answers for any number, errors in order, one context."""

import threading
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfm_audit.audit.kernels.threads import num_threads, over_ranges, ranges, threads, together


@given(weights=st.lists(st.integers(0, 90), max_size=40), size=st.sampled_from([1.0, 7.0, 50.0, 1e9]))
def test_ranges_follow_each_other_and_hold_every_image_once(weights, size):
    found = ranges(len(weights), np.array(weights, dtype=np.int64), size)
    assert [i for part in found for i in part] == list(range(len(weights)))
    assert all(found)
    for part in found:  # all but the first image fit into what a range may weigh
        assert sum(weights[part.start + 1 : part.stop]) <= size


def test_ranges_without_weights_count_images():
    assert ranges(0) == []
    assert ranges(7, range_weight=3.0) == [range(3), range(3, 6), range(6, 7)]


@pytest.mark.parametrize("weights", [[1.0], [1.0, np.nan, 1.0], [1.0, np.inf, 1.0], [1.0, -1.0, 1.0]])
def test_weights_must_be_weights(weights):
    with pytest.raises(ValueError, match="weights"):
        ranges(3, np.array(weights))


@pytest.mark.parametrize("number", [1, 2, 3, 16])
def test_answers_come_in_order_and_do_not_depend_on_the_number(number):
    values = np.random.default_rng(1).normal(size=1000)

    def work(start, stop):
        time.sleep(0.001 * (start % 3))  # they do not end in the order in which they began
        return start, stop, values[start:stop].sum()

    expected = [work(start, min(start + 90, 1000)) for start in range(0, 1000, 90)]
    with threads(number):
        assert over_ranges(work, 1000, range_weight=90.0) == expected


def test_two_ranges_run_at_the_same_time():
    both = threading.Barrier(2, timeout=30.0)  # one thread alone would wait for ever

    def work(start, stop):
        del start, stop
        both.wait()
        return threading.get_ident()

    with threads(2):
        assert len(set(over_ranges(work, 2, range_weight=1.0))) == 2
    assert num_threads() == 1


def test_the_first_range_that_fails_is_the_error_and_the_rest_is_left():
    begun = []

    def work(start, stop):
        del stop
        begun.append(start)
        if start > 1:
            time.sleep(0.05)  # of all ranges 12 s: the caller has the time to say stop on a busy machine, too
        if start:
            raise ValueError(f"range {start}")

    with threads(2), pytest.raises(ValueError, match=r"range 1$"):
        over_ranges(work, 500, range_weight=1.0)
    assert len(begun) < 500


@pytest.mark.parametrize("number", [1, 2])
def test_two_are_done_together_and_an_error_of_either_is_raised(number):
    done = []
    with threads(number):
        together(lambda: done.append(1), lambda: done.append(2))
        assert sorted(done) == [1, 2]
        for calls in ((lambda: done.append(3), lambda: 1 / 0), (lambda: 1 / 0, lambda: done.append(4))):
            with pytest.raises(ZeroDivisionError):
                together(*calls)
    assert 3 in done
    assert (4 in done) == (number > 1)


def test_two_at_the_same_time_wait_for_each_other_and_nobody_waits_after_an_interrupt():
    both, hold = threading.Barrier(2, timeout=30.0), threading.Event()
    with threads(2):
        together(both.wait, both.wait)  # one after the other would wait for ever

        def interrupted():
            raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            together(interrupted, hold.wait)
    hold.set()


def test_the_caller_s_context_holds_in_the_threads_but_for_their_number():
    def work(start, stop):
        del start, stop
        np.array([1.0]) / 0.0  # a warning is an error in tests
        return np.geterr()["divide"], num_threads()

    with np.errstate(divide="ignore"), threads(3):
        assert over_ranges(work, 4, range_weight=1.0) == [("ignore", 1)] * 4
        assert num_threads() == 3
