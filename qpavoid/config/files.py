"""Text and YAML of files that may be anything: a folder, a pipe, a device, an image of a disk, ten lines of aliases.

In YAML, a key given twice, and what would fill the memory, is a fault with its line and column.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import yaml

from qpavoid.errors import ConfigError

_MOST = 50_000
"""Values in all, those that aliases stand for counted each time: ten lines of aliases can stand for a billion."""
_DIGITS = 300
"""Characters of a whole number: Python refuses to print numbers of thousands of digits, also in messages."""


def read_text(path: Path, largest: int, where: str = "") -> str:
    """Read a UTF-8 file, with or without a byte order mark.

    Args:
        path: the file.
        largest: size up to which it is read [bytes]; what comes after would hang or fill the memory.
        where: file and field to name in errors; the file if left out.

    Raises:
        ConfigError: no ordinary file, too large, or not text.
    """
    try:
        size = path.stat().st_size
        if path.is_dir():
            reason = "is a folder; give a file"
        elif not path.is_file():  # reading a pipe or a device may never end
            reason = "not an ordinary file; give one"
        elif size > largest:
            reason = f"{size} bytes; at most {largest} are read, make it smaller"
        else:
            text = path.read_text(encoding="utf-8-sig")
            if "\0" not in text:
                return text
            reason = "it holds NUL characters; give a text file"
    except OSError as error:
        reason = f"{error.strerror or error}; give another file"
    except ValueError as error:  # bytes that are no UTF-8, or a name that no file can have
        reason = f"{error}; give a UTF-8 text file"
    raise ConfigError(f"{where or path}: cannot be read: {reason}")


def parse_yaml(text: str) -> Any:
    """Parse a YAML text.

    Raises:
        ValueError: not valid, a key given twice, or too deep, too long, or endless.
    """
    try:
        loader = yaml.SafeLoader(text)
        node = loader.get_single_node()
        if node is None:
            return None
        if _count(node, {}) > _MOST:
            raise _fault(f"more than {_MOST} values, aliases written out; put long motions into CSV files", node)
        return loader.construct_document(node)
    except yaml.YAMLError as error:
        raise ValueError(" ".join(str(error).split())) from None
    except RecursionError:
        raise ValueError("nested too deep") from None
    # what PyYAML's conversions do with `!!bool x`, `!!timestamp x` and the like
    except (LookupError, AttributeError, TypeError, ArithmeticError) as error:
        raise ValueError(f"a value does not fit its !!tag ({type(error).__name__}: {error})") from None


def _count(node: Any, counts: dict[int, float]) -> float:
    """Check a node and all below it; count its values, infinitely many where it is part of itself."""
    if id(node) in counts:
        return counts[id(node)]
    counts[id(node)], children = math.inf, []
    if isinstance(node, yaml.MappingNode):
        keys: set[str] = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and key.value in keys:
                raise _fault(f"key {key.value!r} is given twice", key)
            keys.add(str(key.value))
        children = [child for pair in node.value for child in pair]
    elif isinstance(node, yaml.SequenceNode):
        children = node.value
    elif node.tag.endswith(":int") and len(node.value) > _DIGITS:
        raise _fault(f"a number of {len(node.value)} characters", node)
    elif any(character == "\0" or "\ud800" <= character <= "\udfff" for character in node.value):
        raise _fault("text with a NUL or half a character pair", node)  # escapes can write what no name or path holds
    counts[id(node)] = 1 + sum(_count(child, counts) for child in children)
    return counts[id(node)]


def _fault(clause: str, node: Any) -> yaml.MarkedYAMLError:
    return yaml.MarkedYAMLError(problem=clause, problem_mark=node.start_mark)
