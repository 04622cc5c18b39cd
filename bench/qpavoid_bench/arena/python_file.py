"""Functions and classes from users' Python files."""

from __future__ import annotations

import hashlib
import sys
from functools import lru_cache
from types import ModuleType
from typing import Any

from qpavoid.errors import ConfigError, UnknownName, nearest

MAX_FILE_SIZE = 10_000_000
"""Largest Python file that is read [bytes]: more is no source file."""


def load_attribute(text: str, file: str, name: str) -> Any:
    """Run a file's text as a module, the same wherever the file lies, and return what is called `name` in it.

    Args:
        text: of the file; what it defines can be sent to other processes that run the same text.
        file: its name, for messages.
        name: of a class or function.

    Raises:
        ConfigError, UnknownName: the text cannot be run, or there is nothing of that name in it.
    """
    module = _load_module(text, file)
    if not hasattr(module, name):
        own_names = [key for key, value in vars(module).items() if getattr(value, "__module__", "") == module.__name__]
        raise UnknownName(f"{file}: there is no {name!r} in it{nearest(name, own_names)}")
    return getattr(module, name)


@lru_cache(maxsize=32)
def _load_module(text: str, file: str) -> ModuleType:
    module = ModuleType(f"qpavoid_bench_file_{hashlib.sha256(text.encode()).hexdigest()[:16]}")
    sys.modules[module.__name__] = module  # dataclasses and pickle look for it there
    try:
        exec(compile(text, file, "exec"), module.__dict__)
    except (Exception, SystemExit) as error:  # whatever a user's file does
        del sys.modules[module.__name__]
        raise ConfigError(f"{file}: cannot be run: {type(error).__name__}: {error}") from None
    return module
