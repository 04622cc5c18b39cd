"""A disk cache for what is slow to make of a mesh: its convex hull, and the capsule around it.

Every result is one file in the user's cache directory, named after a digest of all that it depends on. The cache may
vanish, be damaged, read-only or full at any time: then a result is made anew, without a message.

`QPAVOID_CACHE=0` switches it off, `QPAVOID_CACHE=DIR` puts it elsewhere.
"""

from __future__ import annotations

import os
import platform
import re
import sys
import tempfile
from collections.abc import Callable
from contextlib import suppress
from hashlib import blake2b
from pathlib import Path
from typing import TypeVar

import coal
import numpy as np

from qpavoid.problem import Array

VERSION = 2
"""To be raised whenever the same points would give another result than before, or a file is written otherwise."""

_MADE_WITH = repr((VERSION, coal.__version__, np.__version__, sys.platform, platform.machine()))
"""What else a result depends on: other libraries may round, or write a hull to a file, in another way."""
_DIGEST = 16
"""Bytes of a digest; one of the content ends every file."""
_LARGEST = 100_000_000
"""Size that all files together are kept below [bytes]; the hulls of a humanoid take 3 million."""
_FILE_NAMES = re.compile(r"(?:hull|capsule)-[0-9a-f]{32}\.")
"""Names that may be deleted; the directory may hold other things."""

_T = TypeVar("_T")


def load_or_make(
    kind: str, points: Array, make: Callable[[], _T], pack: Callable[[_T], bytes], unpack: Callable[[Path], _T]
) -> _T:
    """Load a result from the cache, or make it and put it there.

    Args:
        kind: `hull` or `capsule`.
        points: (n, 3) all that the result depends on.
        make: computes it.
        pack: the bytes that are written; must not change the result.
        unpack: gives it back from a file that starts with these bytes. May raise OSError, RuntimeError, ValueError:
            then it is made anew.
    """
    folder = cache_folder()
    if folder is None:
        return make()
    key = _digest(_MADE_WITH.encode() + np.asarray(points, dtype=np.float64).tobytes())
    path = folder / f"{kind}-{key.hex()}.bin"
    with suppress(OSError, RuntimeError, ValueError):
        if _intact(path.read_bytes()):
            result = unpack(path)
            with suppress(OSError):
                os.utime(path)  # the ones used last are kept longest
            return result
    result = make()
    with suppress(OSError):
        _write(path, pack(result))
    return result


def cache_folder() -> Path | None:
    """Return the folder that holds results; None where the cache is off."""
    chosen = os.environ.get("QPAVOID_CACHE", "")
    if chosen:
        return None if chosen == "0" else Path(chosen)
    if os.path.isabs(parent := os.environ.get("XDG_CACHE_HOME", "")):  # a relative one is to be ignored
        return Path(parent) / "qpavoid"
    try:
        home = Path.home()
    except RuntimeError:
        return None
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA") or home / "AppData" / "Local") / "qpavoid" / "Cache"
    return home / ("Library/Caches" if sys.platform == "darwin" else ".cache") / "qpavoid"


def _digest(content: bytes) -> bytes:
    return blake2b(content, digest_size=_DIGEST).digest()


def _intact(content: bytes) -> bool:
    """Return True if a file is as it was written.

    coal takes what it reads for a hull, whatever it is.
    """
    return len(content) > _DIGEST and _digest(content[:-_DIGEST]) == content[-_DIGEST:]


def _write(path: Path, content: bytes) -> None:
    """Put a whole file in its place at once.

    Other processes see all of it or none.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(prefix=path.stem + ".", suffix=".tmp", dir=path.parent)
    try:
        with open(handle, "wb") as file:
            file.write(content + _digest(content))
        os.replace(temporary, path)
    except OSError:
        os.unlink(temporary)
        raise
    _make_room(path.parent)


def _make_room(folder: Path) -> None:
    """Delete the files that were unused for longest, down to half of what is allowed."""
    with os.scandir(folder) as entries:
        files = [(entry.stat(), entry.path) for entry in entries if _FILE_NAMES.match(entry.name)]
    size = sum(stat.st_size for stat, _ in files)
    if size <= _LARGEST:
        return
    for stat, path in sorted(files, key=lambda file: file[0].st_mtime):
        with suppress(OSError):  # another process may have been first
            os.unlink(path)
        size -= stat.st_size
        if size <= _LARGEST // 2:
            return
