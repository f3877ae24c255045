"""A queue of numbered tasks that threads of a parallel kernel take from, each task once."""

import numpy as np
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic


def tasks() -> np.ndarray:
    """A queue from which nothing has been taken: the number of the next task."""
    return np.zeros(1, np.int64)


@intrinsic
def take(typing_context, queue):
    """Number of the next task, from 0 on, in compiled code only; no two threads get the same."""

    def generate(context, builder, signature, arguments):
        array = context.make_array(signature.args[0])(context, builder, arguments[0])
        place = cgutils.get_item_pointer(
            context, builder, signature.args[0], array, [context.get_constant(types.intp, 0)])
        return builder.atomic_rmw("add", place, context.get_constant(types.int64, 1), "monotonic")

    return types.int64(queue), generate
