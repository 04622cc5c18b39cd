"""URDF, SRDF and MJCF text as XML, checked before a C++ parser sees it: those recurse."""

from __future__ import annotations

import io
import xml.etree.ElementTree as ET
from pathlib import Path
from xml.sax import SAXParseException
from xml.sax.handler import ContentHandler
from xml.sax.xmlreader import AttributesImpl, InputSource

from defusedxml import DefusedXmlException

from qpavoid.config.files import read_text
from qpavoid.errors import ConfigError
from qpavoid.model.packages import find_package, mesh_folders

_LARGEST = 10_000_000
"""Size of a file [bytes]; humanoids take 200 000."""
_DEEPEST = 50
"""Levels of nesting; humanoids take 7."""


def read_robot_xml(path: Path, kind: str) -> ET.Element:
    """Read the root of a `URDF`, `SRDF` or `MJCF`; a xacro file is expanded first.

    Names keep the prefix that they are written with (`drake:capsule`), whether the file declares it or not.

    Raises:
        ConfigError: unreadable, not XML, another root than <robot> (<mujoco>), a DOCTYPE, or nested too deep.
    """
    text = read_text(path, _LARGEST)
    where = f"{path}: not a usable {kind}"
    try:
        root = _parse(text)
        if path.suffix == ".xacro" or "<xacro:" in text:
            root = _parse(_expand_xacro(path))
    except DefusedXmlException:
        raise ConfigError(f"{where}: it has a <!DOCTYPE>; take it out, entities are not read") from None
    except SAXParseException as error:
        place = f"line {error.getLineNumber()}, column {error.getColumnNumber()}"
        raise ConfigError(f"{where}: {error.getMessage()}: {place}") from None
    except ValueError as error:
        raise ConfigError(f"{where}: {error}") from None
    expected_tag = "mujoco" if kind == "MJCF" else "robot"
    if root.tag != expected_tag:
        raise ConfigError(f"{where}: its root is <{root.tag}>; must be <{expected_tag}>")
    return root


def undeclared_prefixes(root: ET.Element) -> list[str]:
    """List the prefixes that no xmlns attribute declares, each once."""
    names = [name for element in root.iter() for name in (element.tag, *element.attrib) if ":" in name]
    declared = {"xml", "xmlns", *(name.removeprefix("xmlns:") for name in names if name.startswith("xmlns:"))}
    return [prefix for prefix in dict.fromkeys(name.partition(":")[0] for name in names) if prefix not in declared]


def _parse(text: str) -> ET.Element:
    """Parse a text; prefixes are part of the names, as the C++ parsers have it."""
    import defusedxml.sax  # brings in what reads from the net

    parser, builder, source = defusedxml.sax.make_parser(), _Builder(), InputSource()
    parser.forbid_dtd = True
    parser.setContentHandler(builder)
    source.setByteStream(io.BytesIO(text.encode()))
    source.setEncoding("utf-8")  # the C++ parsers take every file for that, whatever it says
    parser.parse(source)
    return builder.tree.close()


class _Builder(ContentHandler):
    """Builds a tree, and stops where it gets too deep."""

    def __init__(self) -> None:
        super().__init__()
        self.tree = ET.TreeBuilder()
        self._depth = 0

    def startElement(self, name: str, attrs: AttributesImpl) -> None:
        self._depth += 1
        if self._depth > _DEEPEST:
            raise ValueError(f"<{name}> is nested more than {_DEEPEST} deep")
        self.tree.start(name, dict(attrs.items()))

    def endElement(self, name: str) -> None:
        self._depth -= 1
        self.tree.end(name)

    def characters(self, content: str) -> None:
        self.tree.data(content)


def _expand_xacro(path: Path) -> str:
    """Expand a file in xacro, the macro language of ROS, to a URDF, with the default of every argument.

    `$(find NAME)` is looked up as `package://NAME` is, then by ROS where that is installed.

    Raises:
        ConfigError: the package `xacro` is not installed, or what it says is wrong with the file.
    """
    command = f"`xacro {path.name} > {path.name.partition('.')[0]}.urdf`"
    try:
        import xacro
        from xacro import substitution_args
    except ImportError:
        raise ConfigError(
            f"{path}: it is written in xacro: pip install xacro, or run {command} where ROS is installed"
        ) from None
    original, entries = substitution_args._eval_find, mesh_folders(path, [])

    def find(name: str) -> str:
        if (folder := find_package(name, entries)) is not None:
            return folder
        try:
            return str(original(name))
        except ImportError:
            raise LookupError(f"no package {name!r} beside the file or along ROS_PACKAGE_PATH") from None

    substitution_args._eval_find = find  # by itself, xacro asks only its own index of installed packages
    try:
        return str(xacro.process_file(str(path)).toxml())
    except (Exception, SystemExit) as error:  # it evaluates Python, which may raise anything
        reason = " ".join(f"{error}".split()) or type(error).__name__
        raise ConfigError(
            f"{path}: xacro: {reason}; mend it, or run {command} with the arguments that it needs and give the URDF"
        ) from None
    finally:
        substitution_args._eval_find = original
