"""MAVLink's checksum over many frames at once.

CRC-16/MCRF4XX over all behind the magic byte and one byte that each message has of its own
(https://mavlink.io/en/guide/serialization.html#checksum). Frames of one length are taken together, column by column,
two bytes a step: the table of 65536 is the polynomial applied sixteen times.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from magmav.link.frames import SIGNED, V1

Ints = NDArray[np.int64]
Bytes = NDArray[np.uint8]
_POLYNOMIAL = 0x8408
_ROWS = 1 << 14  # frames in one go: what they take stays in the cache


def good(data: Bytes, begin: Ints, end: Ints, seed: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """(N,) whether the checksums of data[begin:end] are right. Whole frames; seed : (N,) each message's own byte."""
    version1 = data[begin] == V1
    signed = ~version1 & (data[np.minimum(begin + 2, len(data) - 1)] == SIGNED)
    body = end - begin - np.where(signed, 15, 2)
    at = begin + body
    said = data[at].astype(np.uint16) | data[at + 1].astype(np.uint16) << 8
    out = np.zeros(len(begin), dtype=bool)
    order = np.argsort(body, kind="stable")
    edges = np.flatnonzero(np.diff(body[order])) + 1
    for group in np.split(order, edges) if len(order) else ():
        length = int(body[group[0]])
        for part in range(0, len(group), _ROWS):
            some = group[part : part + _ROWS]
            out[some] = _checksums(rows(data, begin[some] + 1, length - 1), seed[some]) == said[some]
    return out


def rows(data: Bytes, at: Ints, length: int) -> Bytes:
    """(N, length) bytes from each place on; every row must lie within the data."""
    if length == 0:
        return np.zeros((len(at), 0), dtype=np.uint8)
    windows = np.ndarray((len(data) - length + 1,), dtype=f"V{length}", buffer=data.data, strides=(1,))
    return windows[at].view(np.uint8).reshape(len(at), length)


def _checksums(body: Bytes, seed: NDArray[np.uint8]) -> NDArray[np.uint16]:
    table = _table()
    count, length = body.shape
    out = np.full(count, 0xFFFF, dtype=np.uint16)
    odd = (length + 1) % 2
    if odd:
        # One byte alone: the table's step over it and a zero byte would shift twice, so shift it by hand.
        out = _eight(out ^ (body[:, 0] if length else seed))
    pairs = np.empty((count, length + 1 - odd), dtype=np.uint8)
    if pairs.shape[1]:
        pairs[:, :-1], pairs[:, -1] = body[:, odd:], seed
    for column in np.ascontiguousarray(pairs.view("<u2").T):
        out = table[out ^ column]
    return out


def _eight(crc: NDArray[np.uint16]) -> NDArray[np.uint16]:
    for _ in range(8):
        crc = ((crc >> 1) ^ np.where(crc & 1, _POLYNOMIAL, 0)).astype(np.uint16)
    return crc


@cache
def _table() -> NDArray[np.uint16]:
    return _eight(_eight(np.arange(65536, dtype=np.uint16)))
