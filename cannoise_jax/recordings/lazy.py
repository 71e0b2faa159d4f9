"""Arrays that stay in their file: every index reads that part and lets go of the file again."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

import numpy as np


@dataclass(frozen=True)
class LazyArray:
    """An array of `shape` and `dtype` that `read(index)` fetches part by part.

    Holds no open file and no pixels, so it is cheap to keep, to send to another process and to hold by the
    thousand. Index the first axis in chunks; `np.asarray` reads everything. Indexing raises BadInput when
    the file has become unreadable.
    """

    read: Callable[[Any], np.ndarray]
    shape: tuple[int, ...]
    dtype: np.dtype

    @property
    def ndim(self) -> int:
        """Number of axes."""
        return len(self.shape)

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, index: Any) -> np.ndarray:
        return self.read(index)

    def __array__(self, dtype=None, copy=None) -> np.ndarray:
        return np.asarray(self.read(slice(None)), dtype)


def read_stack(read_one: Callable[[int], np.ndarray], shape: tuple[int, ...], index: Any) -> np.ndarray:
    """Indexes a stack of `shape` whose images can only be read whole, by `read_one(number)`."""
    first, *rest = index if isinstance(index, tuple) else (index,)
    chosen = np.arange(shape[0])[first]
    if chosen.ndim == 0:
        return read_one(int(chosen))[tuple(rest)]
    if chosen.size == 0:
        return read_one(0)[tuple(rest)][None][:0]
    return np.stack([read_one(int(number))[tuple(rest)] for number in chosen])


def chosen(array: Any, numbers: tuple[int, ...]) -> LazyArray:
    """The images of these numbers, in that order, of an array or a view of one."""
    shape = (len(numbers), *array.shape[1:])
    return LazyArray(partial(_read_chosen, array, numbers, shape), shape, np.dtype(array.dtype))


def _read_chosen(array: Any, numbers: tuple[int, ...], shape: tuple[int, ...], index: Any) -> np.ndarray:
    def image(at: int) -> np.ndarray:
        # As a slice of one, which is what `kept` arrays keep.
        return np.asarray(array[numbers[at] : numbers[at] + 1])[0]

    return read_stack(image, shape, index)


def kept(array: LazyArray, most: int) -> LazyArray:
    """The same array, of whose images the last `most` that were asked for one by one stay in memory: to fetch
    one may mean to open and to inflate a file."""

    @lru_cache(most)
    def image(number: int) -> np.ndarray:
        out = np.array(array[number : number + 1])
        out.setflags(write=False)
        return out

    def read(index: Any) -> np.ndarray:
        if isinstance(index, slice) and index.step in (None, 1):
            start, stop, _ = index.indices(len(array))
            if stop == start + 1:
                return image(start)
        return array[index]

    return LazyArray(read, array.shape, array.dtype)
