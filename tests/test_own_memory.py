"""What comes from NumPy lies in Dr.Jit's own memory, so that kernels and recordings fit whatever comes next."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from reslrb_cli.backend.memory import own_memory
from reslrb_cli.optimization.state import like
from reslrb_cli.optimization.views import to_tensor
from reslrb_cli.transport.guide import even_table, make_grid

pytestmark = pytest.mark.usefixtures("llvm")
ALIGNMENT = 64  # bytes; what Dr.Jit's own memory has


def address(array):
    """Where the memory of a Dr.Jit array lies."""
    return np.array(array, copy=False).ctypes.data


def lying_at(offset, values):
    """A NumPy array that begins so many bytes after a multiple of ALIGNMENT."""
    values = np.asarray(values)
    room = np.empty(values.nbytes + 2 * ALIGNMENT, np.uint8)
    begin = -room.ctypes.data % ALIGNMENT + offset
    array = room[begin : begin + values.nbytes].view(values.dtype)
    array[:] = values
    return array


@pytest.mark.parametrize("offset", [0, 4, 16, 32])
@pytest.mark.parametrize(
    ("kind", "values"),
    [
        ("Float", np.float32([-0.0, np.nan, np.inf, 1e-45, 3.0])),
        ("UInt32", np.uint32([0, 1, 2**32 - 1])),
        ("Float", np.float32([7.0])),
    ],
)
def test_bits_are_kept_and_memory_is_not_numpy_s(kind, values, offset):
    given = lying_at(offset, values)
    copy = own_memory(getattr(mi, kind), given)
    assert address(copy) % ALIGNMENT == 0
    assert address(copy) != given.ctypes.data
    given[:] = 5  # whoever shared its memory would see that
    assert np.array(copy).tobytes() == values.tobytes()


def test_whatever_is_taken_up_again_and_again_lies_so():
    image = lying_at(16, np.arange(12, dtype=np.float32)).reshape(2, 2, 3)
    assert address(to_tensor(image).array) % ALIGNMENT == 0
    value = dr.ones(mi.TensorXf, (2, 2, 3))
    assert address(like(value, image).array) % ALIGNMENT == 0
    for _ in range(8):  # NumPy's own memory lies otherwise every time
        table = even_table(make_grid([True] * 4, [1.0, 2.0], 14))
        assert [address(part) % ALIGNMENT for part in (table.slots, table.weights, table.edges)] == [0, 0, 0]
