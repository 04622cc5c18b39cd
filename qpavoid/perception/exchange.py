"""Three slots of shared memory between two processes: one writes, the other reads the newest; neither ever waits.

One slot belongs to the writer, one to the reader, and the third is complete. The writer fills its slot and exchanges it
for the third, the reader does the same once there is a newer one, so that what is read is whole. The exchange of two
numbers is done under a lock of the file, which is tried and never waited for, and which the system takes back from a
process that dies.
"""

from __future__ import annotations

import fcntl
import mmap
from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np

_ALIGNMENT = 64
"""Bytes to which arrays in shared memory are aligned."""
_TRIES = 200
"""Times that a lock is tried: the other process holds it for a microsecond, or was stopped while it does."""
_WRITER, _COMPLETE, _READER, _FRESH = range(4)
"""Places in the header: whose slot each is, and whether the complete one was not read yet."""

Fields = Mapping[str, tuple[Any, tuple[int, ...]]]
"""Type and shape of each array of a slot, by its name."""


def slots_size(fields: Fields) -> int:
    """Return the bytes that the slots of some fields take."""
    return _ALIGNMENT + 3 * _slot_size(fields)


class LatestSlot:
    """One of the two ends of the slots; a process has one of them."""

    def __init__(self, memory: mmap.mmap, file: int, start: int, fields: Fields) -> None:
        """Look into shared memory.

        Args:
            memory: of the file.
            file: its descriptor, inherited by the other process.
            start: where the slots begin; a multiple of 64.
            fields: arrays of a slot.
        """
        self._file, self._start = file, start
        self._header = np.frombuffer(memory, np.int64, 4, start)
        self._slots: list[SimpleNamespace] = [
            _views(memory, start + _ALIGNMENT + i * _slot_size(fields), fields) for i in range(3)
        ]

    def clear(self) -> None:
        """Begin, before the other process looks: nothing was written yet, and all memory is there."""
        self._header[:] = 0, 1, 2, 0
        for slot in self._slots:
            for array in vars(slot).values():
                array.fill(0)

    @property
    def back(self) -> SimpleNamespace:
        """Arrays of the writer's slot, to be filled before `publish`."""
        return self._slots[int(self._header[_WRITER])]

    def publish(self) -> bool:
        """Make the writer's slot the newest; return False where the reader did not let go of the lock."""
        return self._exchange(_WRITER, 1)

    def read(self) -> SimpleNamespace | None:
        """Return the arrays of the newest slot, which stay until the next call; None where it was read before."""
        if not self._header[_FRESH] or not self._exchange(_READER, 0):
            return None
        return self._slots[int(self._header[_READER])]

    def _exchange(self, mine: int, fresh: int) -> bool:
        """Exchange one's own slot for the complete one."""
        for _ in range(_TRIES):
            try:
                fcntl.lockf(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB, 1, self._start)
            except OSError:
                continue
            header = self._header
            header[mine], header[_COMPLETE] = int(header[_COMPLETE]), int(header[mine])
            header[_FRESH] = fresh
            fcntl.lockf(self._file, fcntl.LOCK_UN, 1, self._start)
            return True
        return False


def _slot_size(fields: Fields) -> int:
    return sum(_aligned(np.dtype(kind).itemsize * int(np.prod(shape))) for kind, shape in fields.values())


def _aligned(size: int) -> int:
    return -(-size // _ALIGNMENT) * _ALIGNMENT


def _views(memory: mmap.mmap, start: int, fields: Fields) -> SimpleNamespace:
    views = SimpleNamespace()
    for name, (kind, shape) in fields.items():
        count = int(np.prod(shape))
        setattr(views, name, np.frombuffer(memory, kind, count, start).reshape(shape))
        start += _aligned(np.dtype(kind).itemsize * count)
    return views
