"""Compiled kernels: arrays in, arrays out, nothing of ours imported but each other."""

import numba

# TBB where it is too old makes numba warn on every start; OpenMP is as fast here.
numba.config.THREADING_LAYER_PRIORITY = ["omp", "tbb", "workqueue"]
