"""qpavoid: follow a planned motion and stay clear of obstacles, other arms and yourself."""

import sys
from typing import Any

import lazy_loader

from qpavoid.field_docs import document_fields

_load, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
"""Names of `__init__.pyi`: a program that reads a scenario loads neither numba nor Pinocchio."""


def __getattr__(name: str) -> Any:
    """Import a public name at its first use, and keep it: later ones cost nothing."""
    value = globals()[name] = _load(name)
    if hasattr(value, "_fields"):
        document_fields(value, sys.modules[value.__module__].__file__)
    return value
