"""Small arrays on the stack of a compiled function: many a query is over before memory is allocated.

They are gone when the function that asks for them returns, and must not be returned by it.
"""

from functools import partial

import numpy as np
from numba import config, types
from numba.core import cgutils
from numba.extending import intrinsic

SIZE = 64


def _array_of(number: types.Type):
    """What makes an array (SIZE,) of such numbers in compiled code; its values are not set."""

    @intrinsic
    def array(typing_context):
        kind = types.Array(number, 1, "C")

        def generate(context, builder, signature, arguments):
            made = context.make_array(kind)(context, builder)
            item = context.get_abi_sizeof(context.get_data_type(number))
            data = cgutils.alloca_once(builder, context.get_data_type(number), size=SIZE)
            constants = [context.get_constant(types.intp, value) for value in (SIZE, item)]
            context.populate_array(
                made, data=builder.bitcast(data, made.data.type), shape=constants[:1], strides=constants[1:],
                itemsize=constants[1], meminfo=None)
            return made._getvalue()

        return kind(), generate

    return array


# No function may stand between these and who calls them: the array would be gone when that one returns.
if config.DISABLE_JIT:
    integers, reals = partial(np.empty, SIZE, np.int64), partial(np.empty, SIZE)
else:
    integers, reals = _array_of(types.int64), _array_of(types.float64)
