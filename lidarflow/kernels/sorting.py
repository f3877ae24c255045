"""Sorting of a handful of numbers in place, which takes less than to set up anything cleverer."""

from lidarflow.kernels.compiled import njit


@njit()
def sort(few):
    """Sort numbers (N,) in place, ascending, by insertion."""
    for k in range(1, len(few)):
        number, at = few[k], k
        while at > 0 and few[at - 1] > number:
            few[at] = few[at - 1]
            at -= 1
        few[at] = number
