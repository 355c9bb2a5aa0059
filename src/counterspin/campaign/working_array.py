"""Working arrays for passes over many samples.

- `aligned`: an array whose rows begin where a cache line does
"""

from __future__ import annotations

import math

import numpy as np

#: Values of 8 bytes in a cache line.
_LINE = 8


def aligned(*shape: int) -> np.ndarray:
    """Return an uninitialised float array whose rows begin where a cache line does.

    Results written across the ends of cache lines take the processor up to twice as long.
    """
    *rows, length = shape
    stride = -(-length // _LINE) * _LINE
    store = np.empty(math.prod(rows) * stride + _LINE)
    start = -(store.ctypes.data // store.itemsize) % _LINE
    array: np.ndarray = store[start : len(store) - _LINE + start].reshape(*rows, stride)
    return array[..., :length]
