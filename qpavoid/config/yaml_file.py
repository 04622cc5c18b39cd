"""YAML of unknown origin: what would hang, fill the memory or mean two things is a fault, with its line and column."""

from __future__ import annotations

from typing import Any

import yaml

_DEEPEST = 50
"""Levels of nesting; PyYAML recurses at each, and Python stops at some hundreds."""
_MOST = 50_000
"""Values in all, those that aliases stand for counted each time: ten lines of aliases can stand for a billion."""
_DIGITS = 300
"""Characters of a whole number: Python refuses to print numbers of thousands of digits, also in messages."""


def parse_yaml(text: str) -> Any:
    """Parse a YAML text.

    Raises:
        ValueError: not valid, a key given twice, or too deep, too long, or endless.
    """
    try:
        return yaml.load(text, _Loader)
    except yaml.YAMLError as error:
        raise ValueError(" ".join(str(error).split())) from None
    # what PyYAML's conversions do with `!!bool x`, `!!timestamp x` and the like
    except (LookupError, AttributeError, TypeError, ArithmeticError) as error:
        raise ValueError(f"a value does not fit its !!tag ({type(error).__name__}: {error})") from None


class _Loader(yaml.SafeLoader):
    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._depth = self._count = 0
        self._sizes: dict[str, int] = {}  # values that each finished anchor stands for

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        event: Any = self.peek_event()  # type: ignore[no-untyped-call]
        before = self._count
        self._count += self._size_of(event)
        self._depth += 1
        if self._depth > _DEEPEST:
            raise _fault(f"nested more than {_DEEPEST} deep", event)
        if self._count > _MOST:
            raise _fault(f"more than {_MOST} values, aliases written out; put long motions into CSV files", event)
        node = super().compose_node(parent, index)
        self._depth -= 1
        if isinstance(node, yaml.ScalarNode):
            _check_scalar(node, event)
        if not isinstance(event, yaml.AliasEvent) and event.anchor is not None:
            self._sizes[event.anchor] = self._count - before
        return node

    def _size_of(self, event: Any) -> int:
        if not isinstance(event, yaml.AliasEvent) or event.anchor not in self.anchors:
            return 1
        if event.anchor not in self._sizes:
            raise _fault(f"alias {event.anchor!r} stands for something that it is part of", event)
        return self._sizes[event.anchor]

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        keys_so_far: set[str] = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode):  # others are refused as keys anyway
                if key.value in keys_so_far:
                    raise _fault(f"key {key.value!r} is given twice", key)
                keys_so_far.add(key.value)
        return super().construct_mapping(node, deep)


def _check_scalar(node: yaml.ScalarNode, event: Any) -> None:
    if node.tag.endswith(":int") and len(node.value) > _DIGITS:
        raise _fault(f"a number of {len(node.value)} characters", event)
    # escapes can write them, but no name or path can hold them
    if any(character == "\0" or "\ud800" <= character <= "\udfff" for character in node.value):
        raise _fault("text with a NUL or half a character pair", event)


def _fault(clause: str, place: Any) -> yaml.MarkedYAMLError:
    return yaml.MarkedYAMLError(problem=clause, problem_mark=place.start_mark)
