"""Compiled kernels on disk: a folder for each state of their sources, so that stale code is never run.

numba's own cache takes the code of a function as fresh as long as the file of that function is unchanged, and so runs
what the function inlined from other files before they changed. Here, all code is in one folder of the user's cache
directory, whose name has a digest of all kernel sources and of the versions that compiled them. Nothing is written
beside the sources, so that an installation may be read-only, and nothing is deleted but other such folders.

Processes may start at the same time, and the folder may vanish, be read-only or full: code that cannot be read is
compiled, and code that cannot be written is compiled by the next process, too.

`NUMBA_CACHE_DIR` puts the folder elsewhere.
"""

from __future__ import annotations

import os
import pickle
import shutil
import sys
import tempfile
from collections.abc import Callable
from contextlib import suppress
from hashlib import blake2b
from pathlib import Path
from time import perf_counter
from typing import Any

import numba
from numba.core.caching import CompileResultCacheImpl, FunctionCache
from numba.core.serialize import dumps
from numba.misc.appdirs import AppDirs

from qpavoid.kernels import linking

_MAX_FOLDERS = 8
"""Folders that are not deleted, those used last [-]: a few checkouts and versions of numba side by side, 5 MB each."""
_DIGEST = 16
"""Bytes of a digest: collisions do not occur. A file begins with that of its content: damaged code must not be run."""
_COMPLETE = "complete"
"""Empty file in a folder once the kernels of a controller are in it."""


def _folder() -> Path:
    """Return the folder of this state of the sources."""
    sources = [(path.name, path.read_bytes()) for path in sorted(Path(__file__).parent.glob("*.py"))]
    digest = _digest(repr((numba.__version__, sys.implementation.cache_tag, sources)).encode())
    user = AppDirs("qpavoid", appauthor=False).user_cache_dir
    user = user if os.path.isabs(user) else os.devnull  # without a home there is none: nothing can be below this
    return Path(numba.config.CACHE_DIR or user) / f"kernels-{digest.hex()}"


def _digest(content: bytes) -> bytes:
    """Return the digest of some bytes."""
    return blake2b(content, digest_size=_DIGEST).digest()


class _Files:
    """Code of one function in a folder, a file for each signature; replaces numba's index of files.

    Of two processes that add signatures to one index at the same time, either may end with an entry that points to the
    code of the other. Here a file is named after its signature, and contains it.
    """

    def __init__(self, folder: Path, name: str) -> None:
        self._folder, self._name = folder, name

    def load(self, key: Any) -> Any:
        """Return the code of a signature, or None if no readable file has it."""
        with suppress(OSError):
            content = self._path(key).read_bytes()
            if _digest(content[_DIGEST:]) == content[:_DIGEST]:
                signature, code = pickle.loads(content[_DIGEST:])
                if signature == key:
                    self._mark_used()
                    return code
        first_use.begin()
        return None

    def save(self, key: Any, code: Any) -> None:
        """Write the code of a signature, atomically; report an OSError to `first_use`."""
        content = dumps((key, code))
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            handle, temporary = tempfile.mkstemp(suffix=".tmp", dir=self._folder)
            try:
                with open(handle, "wb") as file:
                    file.write(_digest(content) + content)
                os.replace(temporary, self._path(key))
            except BaseException:
                os.unlink(temporary)
                raise
        except OSError as error:
            first_use.fail(error)

    def flush(self) -> None:
        """Delete the code of all signatures."""
        for path in self._folder.glob(f"{self._name}.*.code"):
            with suppress(OSError):
                path.unlink()

    def _mark_used(self) -> None:
        """Set the time of last use of the folder."""
        with suppress(OSError):
            os.utime(self._folder / _COMPLETE)

    def _path(self, key: Any) -> Path:
        """Return the file of a signature."""
        return self._folder / f"{self._name}.{_digest(repr(key).encode()).hex()}.code"


class _Locator:
    """Location of the code of a function, in the form that numba expects."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self._py_file = function.__code__.co_filename

    def get_cache_path(self) -> str:
        """Return the folder."""
        return str(FOLDER)

    def get_source_stamp(self) -> str:
        """Return the name of the folder, which changes with the sources."""
        return FOLDER.name

    def ensure_cache_path(self) -> None:
        """Do nothing: `_Files.save` makes the folder."""


class _Implementation(CompileResultCacheImpl):  # type: ignore[misc]
    """numba's serialisation of compiled functions, with the locator of this module, and with what they call by name."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self._lineno, self._locator = function.__code__.co_firstlineno, _Locator(function)
        self._filename_base = f"{function.__module__.rpartition('.')[2]}.{function.__qualname__}-{self._lineno}"

    def reduce(self, code: Any) -> Any:
        """Return what is written to disk."""
        return linking.links_of(code), super().reduce(code)

    def rebuild(self, target: Any, payload: Any) -> Any:
        """Return what was written to disk as code that can be called."""
        links, reduced = payload
        linking.prepare(target, links)
        return super().rebuild(target, reduced)


class KernelCache(FunctionCache):  # type: ignore[misc]
    """Cache of one compiled function: numba's, with one folder for all sources."""

    _impl_class = _Implementation

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        self._cache_file = _Files(FOLDER, self._impl.filename_base)

    def save_overload(self, signature: Any, code: Any) -> None:
        """Write a kernel that was compiled, before its caller is: large ones are not linked into that."""
        linking.take_out_of_callers(code, self._py_func)
        super().save_overload(signature, code)


class FirstUse:
    """Messages on stderr while a machine compiles the kernels for the first time; none in later runs."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._begin, self._failed = folder, 0.0, False

    def begin(self) -> None:
        """Print that kernels are compiled, at the first one that is missing in an incomplete folder."""
        if not self._begin and not (self._folder / _COMPLETE).exists():
            self._begin = perf_counter()
            _print("compiling kernels, once on this machine: about 45 s ...")

    def end(self) -> None:
        """Print how long the compilation took, if `begin` printed, and mark the folder as complete."""
        if not self._begin:
            return
        _print(f"compiled kernels in {perf_counter() - self._begin:.0f} s")
        self._begin = 0.0
        if not self._failed:
            with suppress(OSError):
                (self._folder / _COMPLETE).touch()
            _delete_old_folders(self._folder.parent)

    def fail(self, error: OSError) -> None:
        """Print, once, that compiled kernels are not on disk for the next run, and why."""
        if not self._failed:
            self._failed = True
            _print(f"cannot keep compiled kernels for the next run: {error}; NUMBA_CACHE_DIR=DIR puts them elsewhere")


def _print(line: str) -> None:
    """Print a line to stderr, if there is one."""
    if sys.stderr is not None:
        print(f"qpavoid: {line}", file=sys.stderr, flush=True)


def _delete_old_folders(parent: Path) -> None:
    """Delete the folders that were not used for the longest time, all but `_MAX_FOLDERS`."""
    with suppress(OSError):
        folders = sorted(parent.glob(f"kernels-*/{_COMPLETE}"), key=lambda path: path.stat().st_mtime)
        for complete in folders[:-_MAX_FOLDERS]:
            shutil.rmtree(complete.parent, ignore_errors=True)


FOLDER = _folder()
"""Folder with the code of these sources."""
first_use = FirstUse(FOLDER)
"""Messages about the first compilation."""
