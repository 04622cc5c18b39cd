"""Environments of the libraries: a folder each, made with pip at the first use, apart from the one of qpavoid.

They need other versions of the packages that qpavoid needs, of Pinocchio above all. They are in the user's cache
directory, or in the folder that QPAVOID_BENCH_ENVIRONMENTS names; a folder is named after what is installed in it.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import sys
import venv
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from qpavoid.errors import ConfigError

FOLDER_VARIABLE = "QPAVOID_BENCH_ENVIRONMENTS"
TIME_LIMIT = 600.0
"""Time that pip may take for one of them [s]."""


def folder(name: str, requirements: tuple[str, ...]) -> Path:
    """Return the folder of an environment, made or not."""
    text = " ".join((*requirements, sys.implementation.cache_tag or ""))
    default = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "qpavoid" / "environments"
    parent = Path(os.environ.get(FOLDER_VARIABLE) or default)
    return parent.absolute() / f"{name}-{hashlib.sha256(text.encode()).hexdigest()[:10]}"


def is_made(name: str, requirements: tuple[str, ...]) -> bool:
    """Return whether an environment is there, complete."""
    return (folder(name, requirements) / "complete").is_file()


def interpreter(name: str, requirements: tuple[str, ...]) -> Path:
    """Return the interpreter of an environment, which is made if it is not there.

    Raises:
        ConfigError: pip cannot install what it needs: there is no wheel for this machine, or no network.
    """
    place = folder(name, requirements)
    with _lock(place):
        if not (place / "complete").is_file():
            print(f"makes an environment for {name}: {place}", file=sys.stderr, flush=True)
            shutil.rmtree(place, ignore_errors=True)
            venv.create(place, with_pip=True)
            _install(name, place, requirements)
            (place / "complete").touch()
    return _python(place)


def _python(place: Path) -> Path:
    return place / ("Scripts" if os.name == "nt" else "bin") / "python"


def _install(name: str, place: Path, requirements: tuple[str, ...]) -> None:
    command = [str(_python(place)), "-m", "pip", "install", "--quiet", "--only-binary", ":all:", *requirements]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=TIME_LIMIT, check=False)
        last = (done.stderr.strip().splitlines() or ["no reason given"])[-1] if done.returncode else ""
    except subprocess.TimeoutExpired:
        last = f"not done after {TIME_LIMIT:g} s"
    if last:
        shutil.rmtree(place, ignore_errors=True)
        raise ConfigError(f"{name}: pip cannot install {' '.join(requirements)}: {last}")


@contextmanager
def _lock(place: Path) -> Iterator[None]:
    """Let one process at a time make an environment."""
    import fcntl

    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        file = place.with_suffix(".lock").open("w")
    except OSError as error:
        raise ConfigError(f"{place.parent}: {error.strerror}; let {FOLDER_VARIABLE} name another folder") from None
    with file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield
