"""Docstrings of named tuples' fields, for `help`: taken from the source, where they stand below each field."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

_FIELD = re.compile(r'^    (\w+): [^\n]*\n    """(.*?)"""', re.MULTILINE | re.DOTALL)


def document_fields(*classes: Any) -> None:
    """Give the fields of named tuples the docstrings that their source has; Python says `Alias for field number 5`.

    Args:
        classes: named tuples; of one whose source is not at hand, nothing changes.
    """
    for each in classes:
        try:
            source = Path(sys.modules[each.__module__].__file__ or "").read_text(encoding="utf-8")
        except (OSError, UnicodeError):
            continue
        _, _, body = source.partition(f"\nclass {each.__name__}(NamedTuple):\n")
        for name, text in _FIELD.findall(body.partition("\n\n\n")[0]):
            getattr(each, name).__doc__ = " ".join(text.split())
