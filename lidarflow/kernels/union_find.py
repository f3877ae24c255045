"""Disjoint sets: which of N things hang together, told pair by pair."""

import numpy as np

from lidarflow.kernels.compiled import njit


@njit()
def join(parent, a, b):
    """Put a and b into one set; `parent` (N,) begins as 0 .. N-1."""
    if parent[a] == parent[b]:   # most pairs tell what is known
        return
    a_root, b_root = _root(parent, a), _root(parent, b)
    root = min(a_root, b_root)
    parent[a_root] = parent[b_root] = parent[a] = parent[b] = root


@njit()
def labels(parent):
    """Label (N,) of each thing's set, numbered in the order of their first members."""
    label, count = np.empty(len(parent), np.int64), 0
    for i in range(len(parent)):   # a parent comes before its children, and the root is the first of its set
        if parent[i] == i:
            label[i] = count
            count += 1
        else:
            label[i] = label[parent[i]]
    return label


@njit()
def _root(parent, i):
    """The lowest member known of i's set; the way there is halved for the next time."""
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i
