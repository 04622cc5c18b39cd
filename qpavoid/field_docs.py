"""Docstrings of named tuples' fields, for `help`: taken from the source, where they stand below each field."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

_FIELD = re.compile(r'^    (\w+): [^\n]*\n    """(.*?)"""', re.MULTILINE | re.DOTALL)


def document_fields(named_tuple: Any, file: str | None) -> None:
    """Give the fields of a named tuple the docstrings that its source has; Python says `Alias for field number 5`.

    Args:
        named_tuple: the class; if its source is not at hand, nothing changes.
        file: the file that defines it.
    """
    try:
        source = Path(file or "").read_text(encoding="utf-8")
    except (OSError, UnicodeError):
        return
    _, _, body = source.partition(f"\nclass {named_tuple.__name__}(NamedTuple):\n")
    for name, text in _FIELD.findall(body.partition("\n\n\n")[0]):
        getattr(named_tuple, name).__doc__ = " ".join(text.split())
