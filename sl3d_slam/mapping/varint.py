"""Integers in few bytes: differences between rows, zigzag for the sign, seven bits a byte.

Decoding trusts nothing: a count that the bytes do not bear out raises ``ValueError`` before
anything of that size is allocated.
"""

import numpy as np
from jaxtyping import Int64, UInt8

MAX_BYTES = 6  # 42 bits: nanometres over 4,000 km are enough


def pack_table(table: Int64[np.ndarray, "N C"]) -> UInt8[np.ndarray, "S"]:
    """Code a table of integers as differences between successive rows, below 2**40 in size."""
    steps = np.diff(table, axis=0, prepend=np.zeros((1, table.shape[1]), np.int64)).ravel()
    return pack(np.where(steps < 0, -2 * steps - 1, 2 * steps))


def unpack_table(packed: UInt8[np.ndarray, "S"], columns: int) -> Int64[np.ndarray, "N C"]:
    """Return the table that :func:`pack_table` coded; its rows follow from the bytes."""
    codes = unpack(packed)
    if len(codes) % columns:
        raise ValueError(f"{len(codes)} integers are not whole rows of {columns}")
    steps = np.where(codes % 2, -(codes // 2) - 1, codes // 2)
    return np.cumsum(steps.reshape(-1, columns), axis=0)


def pack(values: Int64[np.ndarray, "N"]) -> UInt8[np.ndarray, "S"]:
    """Code integers from 0 to 2**42 - 1, low seven bits first; the last byte has no high bit."""
    if len(values) and (values.min() < 0 or values.max() >> (7 * MAX_BYTES)):
        raise ValueError("an integer is too large for the map file")
    sizes = np.ones(len(values), np.int64)
    for k in range(1, MAX_BYTES):
        sizes += values >> (7 * k) > 0
    starts = np.cumsum(sizes) - sizes
    packed = np.zeros(int(sizes.sum()), np.uint8)
    for k in range(MAX_BYTES):
        has = sizes > k
        more = (sizes[has] > k + 1) * 128
        packed[starts[has] + k] = ((values[has] >> (7 * k)) & 127) + more
    return packed


def unpack(packed: UInt8[np.ndarray, "S"]) -> Int64[np.ndarray, "N"]:
    """Return the integers that :func:`pack` coded."""
    if len(packed) == 0:
        return np.zeros(0, np.int64)
    ends = np.flatnonzero(packed < 128)
    starts = np.concatenate([[0], ends[:-1] + 1])
    if len(ends) == 0 or ends[-1] != len(packed) - 1:
        raise ValueError("the last integer is cut off")
    sizes = ends - starts + 1
    if sizes.max() > MAX_BYTES:
        raise ValueError("an integer is too long")
    values = (packed[starts] & 127).astype(np.int64)
    for k in range(1, int(sizes.max())):
        longer = np.flatnonzero(sizes > k)
        values[longer] += (packed[starts[longer] + k] & 127).astype(np.int64) << (7 * k)
    return values
