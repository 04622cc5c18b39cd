"""URDF, SRDF and MJCF text, checked before a C++ parser sees it: those recurse, and some are quadratic."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path
from xml.parsers import expat

from qpavoid.config.text import read_text
from qpavoid.errors import ConfigError
from qpavoid.model.xacro import expand_xacro, is_xacro

_LARGEST = 10_000_000
"""Size of a file [bytes]; humanoids take 200 000."""
_DEEPEST = 50
"""Levels of nesting; humanoids take 7."""
_MOST_ATTRIBUTES = 100
"""Attributes of one element, at most; humanoids take 12."""


def read_robot_xml(path: Path, kind: str) -> ET.Element:
    """Read the root of a URDF, SRDF or MJCF; a xacro file is expanded first.

    Names keep the prefix that they are written with (`drake:capsule`), whether the file declares it or not.

    Args:
        path: the file.
        kind: `URDF`, `SRDF` or `MJCF`.

    Raises:
        ConfigError: unreadable, not XML, another root than <robot> (<mujoco>), a DOCTYPE, or nested too deep.
    """
    text = read_text(path, _LARGEST)
    where = f"{path}: not a usable {kind}"
    _refuse_doctype(text, where)
    if is_xacro(path, text):
        text = expand_xacro(path)
        _refuse_doctype(text, where)
    try:
        root = _parse(text)
    except (expat.ExpatError, ValueError) as error:
        raise ConfigError(f"{where}: {error}") from None
    expected_tag = "mujoco" if kind == "MJCF" else "robot"
    if root.tag != expected_tag:
        raise ConfigError(f"{where}: its root is <{root.tag}>; must be <{expected_tag}>")
    return root


def undeclared_prefixes(root: ET.Element) -> list[str]:
    """List the prefixes that no xmlns attribute declares, each once."""
    prefixes: dict[str, None] = {}
    declared = {"xml", "xmlns"}
    for element in root.iter():
        names = [name for name in (element.tag, *element.attrib) if ":" in name]
        declared |= {name.removeprefix("xmlns:") for name in names if name.startswith("xmlns:")}
        prefixes |= {name.partition(":")[0]: None for name in names}
    return [prefix for prefix in prefixes if prefix not in declared]


def _refuse_doctype(text: str, where: str) -> None:
    if "<!DOCTYPE" in text:  # before any parser: only a DOCTYPE can declare entities that grow or that read files
        raise ConfigError(f"{where}: it has a <!DOCTYPE>; take it out, entities are not read")


def _parse(text: str) -> ET.Element:
    """Parse a text; prefixes are part of the names, as the C++ parsers have it."""
    # those take every file for UTF-8, whatever it says
    parser, builder = expat.ParserCreate("utf-8"), _Builder()
    parser.StartElementHandler = builder.start
    parser.EndElementHandler = builder.end
    parser.CharacterDataHandler = builder.data
    parser.buffer_text = True
    parser.Parse(text.encode(), True)
    return builder.close()


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
