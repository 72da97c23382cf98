"""A scene cut into the leaves of a kd-tree, in memory or on the disk.

A node is cut at its median across the axis of its largest spread, in halves that differ by one Gaussian at most.
Equal coordinates are told apart by their order in the scene, which both ways of cutting keep: their leaves are the
same.
"""

from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from clsplat.errors import InputError
from clsplat.formats.ply_parts import CHUNK, PlyParts
from clsplat.gaussians import Gaussians

Array = NDArray[Any]

INNER = (0.05, 0.95)
"""Quantiles between which the spread of a node is measured: single Gaussians lie far from the others."""

HALF_KEY = 1 << 16
"""Number of values of half a float32's bits."""


def leaves(gaussians: Gaussians, depth: int) -> Iterator[Gaussians]:
    """Yield the 2**depth leaves of a scene in memory."""
    if depth == 0:
        yield gaussians
        return
    for rows in _leaf_rows(gaussians.means, np.arange(len(gaussians)), depth):
        yield gaussians.take(rows)


def _leaf_rows(means: Array, rows: Array, depth: int) -> Iterator[Array]:
    if depth == 0:
        yield rows
        return
    places = means[rows]
    ranks = _ranks(len(rows))
    low, high = np.partition(places, ranks[:2], axis=0)[ranks[:2]]
    axis = int((high - low).argmax())
    order = rows[np.argsort(places[:, axis], kind="stable")]
    for part in (order[: ranks[2]], order[ranks[2] :]):
        yield from _leaf_rows(means, np.sort(part), depth - 1)


def _ranks(count: int) -> list[int]:
    """Ranks of the values that determine a cut: those of `INNER`, and that of the first in the upper half."""
    return [*(int(share * (count - 1)) for share in INNER), count // 2]


class _Cut:
    """A cut of a node whose Gaussians come in their order: those below `value`, and the first `ties` equal to it, are
    in the lower half."""

    def __init__(self, axis: int, value: float, ties: int):
        self._axis, self._value, self._ties = axis, value, ties

    def below(self, means: Array) -> NDArray[np.bool_]:
        """Whether the next Gaussians of the node are in the lower half."""
        x = means[:, self._axis]
        equal = x == self._value
        early = equal & (np.cumsum(equal) <= self._ties)
        self._ties -= int(early.sum())
        return np.asarray((x < self._value) | early)

    def again(self) -> "_Cut":
        """A copy, for another pass over the node; to be made before the first one."""
        return _Cut(self._axis, self._value, self._ties)


def cut_on_disk(rows: PlyParts, folder: Path, depth: int) -> Iterator[Gaussians]:
    """Yield the 2**depth parts of a scene on the disk, each of which fits the memory.

    Means alone are cut first, from one temporary file to another. The cuts that this finds send each row of the scene
    to its part, in one pass.

    Parameters
    ----------
    rows : PlyParts
    folder : Path
        Where temporary files without a name are made, which vanish with the process.
    depth : int

    Raises
    ------
    InputError
        If the scene cannot be read, a value is not finite, or the folder cannot hold the temporary files.
    """
    if depth == 0:
        yield Gaussians.concatenate([gaussians for _, gaussians in rows.chunks()])
        return
    try:
        with TemporaryFile(dir=folder) as first, TemporaryFile(dir=folder) as second:
            for _, gaussians in rows.chunks():
                first.write((gaussians.means + np.float32(0)).tobytes())  # turns -0 to 0, to which it is equal
            cuts: dict[int, _Cut] = {}
            counts = _cut_means(first, second, (0, rows.count), depth, cuts)
        with TemporaryFile(dir=folder) as sorted_rows:
            ends = np.cumsum([0, *counts])
            filled = ends[:-1].copy()
            for stored, gaussians in rows.chunks():
                for part, chosen in _sent(gaussians.means, cuts, depth):
                    sorted_rows.seek(int(filled[part]) * rows.dtype.itemsize)
                    sorted_rows.write(stored[chosen].tobytes())
                    filled[part] += len(chosen)
            for begin, count in zip(ends[:-1], counts, strict=True):
                sorted_rows.seek(int(begin) * rows.dtype.itemsize)
                yield rows.gaussians(np.frombuffer(sorted_rows.read(count * rows.dtype.itemsize), rows.dtype))
    except OSError as error:
        raise InputError(f"cannot write to {folder}: {error.strerror or error}") from error


def _cut_means(
    source: IO[bytes], target: IO[bytes], span: tuple[int, int], depth: int, cuts: dict[int, _Cut], node: int = 1
) -> list[int]:
    """Cut the means in a span of a file; put the cuts into `cuts` by the number of their node, whose halves are
    2 node and 2 node + 1. Returns the sizes of the parts. The means move to the same span of `target`."""
    begin, count = span
    if depth == 0:
        return [count]
    cut = _find_cut(source, span)
    cuts[node] = cut.again()
    half = count // 2
    at = [begin, begin + half]
    for means in _means(source, span):
        below = cut.below(means)
        for side, part in enumerate((means[below], means[~below])):
            target.seek(12 * at[side])
            target.write(part.tobytes())
            at[side] += len(part)
    target.flush()
    return [
        *_cut_means(target, source, (begin, half), depth - 1, cuts, 2 * node),
        *_cut_means(target, source, (begin + half, count - half), depth - 1, cuts, 2 * node + 1),
    ]


def _means(file: IO[bytes], span: tuple[int, int]) -> Iterator[Array]:
    """Yield the means (n, 3) in a span of a file."""
    begin, count = span
    for first in range(begin, begin + count, CHUNK):
        file.seek(12 * first)
        data = file.read(12 * min(CHUNK, begin + count - first))
        yield np.frombuffer(data, np.float32).reshape(-1, 3)


def _find_cut(file: IO[bytes], span: tuple[int, int]) -> _Cut:
    """Find the cut of a node by counting, in two passes over its means: first the upper halves of the values' bits,
    then the lower halves of those that are near the wanted ranks."""
    ranks = _ranks(span[1])
    upper = np.zeros((3, HALF_KEY), np.int64)
    for means in _means(file, span):
        for axis, keys in enumerate(_keys(means).T):
            upper[axis] += np.bincount(keys >> 16, minlength=HALF_KEY)
    reached = np.cumsum(upper, axis=1)
    bins = [[int(np.searchsorted(reached[axis], rank, "right")) for rank in ranks] for axis in range(3)]
    lower = np.zeros((3, 3, HALF_KEY), np.int64)
    for means in _means(file, span):
        for axis, keys in enumerate(_keys(means).T):
            for k, high in enumerate(bins[axis]):
                lower[axis, k] += np.bincount(keys[keys >> 16 == high] & (HALF_KEY - 1), minlength=HALF_KEY)
    values, less = np.empty((3, 3), np.float32), np.empty((3, 3), np.int64)
    for axis in range(3):
        for k, (high, rank) in enumerate(zip(bins[axis], ranks, strict=True)):
            before = int(reached[axis, high - 1]) if high else 0
            within = np.cumsum(lower[axis, k])
            low = int(np.searchsorted(within, rank - before, "right"))
            values[axis, k] = _value((high << 16) | low)
            less[axis, k] = before + (int(within[low - 1]) if low else 0)
    axis = int((values[:, 1] - values[:, 0]).argmax())
    return _Cut(axis, float(values[axis, 2]), ranks[2] - int(less[axis, 2]))


def _keys(values: Array) -> Array:
    """Integers in the order of float32 values, which have no negative zero."""
    bits = np.ascontiguousarray(values).view(np.uint32)
    return np.asarray(np.where(bits >> 31, ~bits, bits | 0x80000000).astype(np.int64))


def _value(key: int) -> np.float32:
    """The value of a key."""
    bits = key ^ 0x80000000 if key >> 31 else key ^ 0xFFFFFFFF
    return np.array([bits], np.uint32).view(np.float32)[0]


def _sent(means: Array, cuts: dict[int, _Cut], depth: int) -> Iterator[tuple[int, Array]]:
    """Yield the parts of the next Gaussians of the scene, and which of them belong to each."""
    waiting = [(1, np.arange(len(means)))]
    while waiting:
        node, chosen = waiting.pop()
        if node >> depth:
            yield node - (1 << depth), chosen
        elif len(chosen):
            below = cuts[node].below(means[chosen])
            waiting += [(2 * node, chosen[below]), (2 * node + 1, chosen[~below])]
