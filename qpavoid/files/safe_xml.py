"""URDF, SRDF and MJCF text, checked before a C++ parser sees it: those recurse, and some are quadratic."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

from qpavoid.errors import ConfigError
from qpavoid.files.text import read_text

_LARGEST = 10_000_000
"""Size of a file [bytes]; humanoids take 200 000."""
_DEEPEST = 50
"""Levels of nesting; humanoids take 7."""
_MOST_ATTRIBUTES = 100
"""Of one element; humanoids take 12."""


def read_robot_xml(path: Path, kind: str) -> ET.Element:
    """The root of a URDF, SRDF or MJCF.

    Args:
        path: the file.
        kind: `URDF`, `SRDF` or `MJCF`.

    Raises:
        ConfigError: unreadable, not XML, another root than <robot> (<mujoco>), a DOCTYPE, or nested too deep.
    """
    text = read_text(path, _LARGEST)
    where = f"{path}: not a usable {kind}"
    if "<!DOCTYPE" in text:  # before any parser: only a DOCTYPE can declare entities that grow or that read files
        raise ConfigError(f"{where}: it has a <!DOCTYPE>; take it out, entities are not read")
    # the C++ parsers take every file for UTF-8, whatever it says
    parser = ET.XMLParser(target=_Builder(), encoding="utf-8")
    try:
        parser.feed(text.encode())
        root: ET.Element = parser.close()
    except (ET.ParseError, ValueError) as error:
        raise ConfigError(f"{where}: {error}") from None
    wanted = "mujoco" if kind == "MJCF" else "robot"
    if root.tag != wanted:
        raise ConfigError(f"{where}: its root is <{root.tag}>; must be <{wanted}>")
    return root


class _Builder(ET.TreeBuilder):
    """Stops where a tree gets too deep or too wide."""

    def __init__(self) -> None:
        super().__init__()
        self._depth = 0

    def start(self, tag: str, attrs: dict[str, str]) -> ET.Element:
        self._depth += 1
        if self._depth > _DEEPEST:
            raise ValueError(f"<{tag}> is nested more than {_DEEPEST} deep")
        if len(attrs) > _MOST_ATTRIBUTES:
            raise ValueError(f"<{tag}> has more than {_MOST_ATTRIBUTES} attributes")
        return super().start(tag, attrs)

    def end(self, tag: str) -> ET.Element:
        self._depth -= 1
        return super().end(tag)
