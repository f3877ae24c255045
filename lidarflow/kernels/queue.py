"""A queue of numbered tasks that threads of a parallel kernel take from, each task once."""

import numpy as np
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, overload, register_jitable

# Kernels loop over places, as numba cannot cache one that asks for the number of threads. Each thread has
# some of them, and takes tasks at the first until none is left.
PLACES = 256


@register_jitable
def tasks() -> np.ndarray:
    """A queue from which nothing has been taken: the number of the next task."""
    return np.zeros(1, np.int64)


def take(queue: np.ndarray) -> int:
    """Number of the next task, from 0 on; in compiled code no two threads get the same."""
    task = queue[0]
    queue[0] += 1
    return task


@intrinsic
def _take(typing_context, queue):
    """As `take`: counting on and looking at the number is one step."""

    def generate(context, builder, signature, arguments):
        array = context.make_array(signature.args[0])(context, builder, arguments[0])
        place = cgutils.get_item_pointer(
            context, builder, signature.args[0], array, [context.get_constant(types.intp, 0)])
        return builder.atomic_rmw("add", place, context.get_constant(types.int64, 1), "monotonic")

    return types.int64(queue), generate


@overload(take, inline="always")
def _compiled_take(queue):
    return lambda queue: _take(queue)
