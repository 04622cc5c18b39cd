"""SRDF files: reading and writing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from xml.sax.saxutils import quoteattr

from qpavoid.model.xml_file import read_robot_xml

MADE_BY = "written by `qpavoid robot add`"
_HOMES = ("home", "ready", "default", "standing", "half_sitting", "neutral")
"""Names of poses to start from, the likeliest first."""


@dataclass(frozen=True)
class Semantics:
    """The parts of an SRDF that matter here."""

    disabled: Mapping[frozenset[str], str] = field(default_factory=dict)
    """Two links that are not to be checked: the reason."""
    states: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    """Named poses: joint and position [rad or m]; what comes first is most likely a home pose."""
    end_effectors: Sequence[str] = ()
    """Links that carry tools or feet, in the order of the file."""


def find_srdf(urdf: Path) -> Path | None:
    """Find the SRDF beside a URDF, or in `srdf/` beside its folder, whose name has most in common with the URDF's.

    Those that `robot add` wrote are left out: they hold its own results.
    """
    folders = (urdf.parent, urdf.parent / "srdf", urdf.parent.parent / "srdf")
    paths = [path for folder in folders for path in sorted(folder.glob("*.srdf")) if not _is_own(path)]
    same = [path for path in paths if path.stem.startswith(urdf.stem) or urdf.stem.startswith(path.stem)]
    return max(same, key=lambda path: (path.stem == urdf.stem, min(len(path.stem), len(urdf.stem))), default=None)


def _is_own(path: Path) -> bool:
    with suppress(OSError):
        return MADE_BY.encode() in path.read_bytes()[:500]
    return False


def read_srdf(path: Path) -> Semantics:
    """Read an SRDF; what cannot be understood is left out.

    Raises:
        ConfigError: not a usable SRDF.
    """
    root = read_robot_xml(path, "SRDF")
    disabled = {
        frozenset((pair.get("link1", ""), pair.get("link2", ""))): pair.get("reason", "User")
        for pair in root.iter("disable_collisions")
    }
    states = {}
    for state in root.iter("group_state"):
        values = {joint.get("name", ""): _number(joint.get("value", "")) for joint in state.iter("joint")}
        states[state.get("name", "")] = {name: value for name, value in values.items() if value is not None}
    names = sorted(states, key=lambda name: (_HOMES.index(name) if name in _HOMES else len(_HOMES), name))
    ends = [end.get("parent_link", "") for end in root.iter("end_effector")]
    return Semantics(disabled, {name: states[name] for name in names}, tuple(dict.fromkeys(ends)))


def _number(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:  # joints with several coordinates have several
        return None
    return value if abs(value) < 1e9 else None


def srdf_text(robot: str, comment: str, disabled: Mapping[frozenset[str], str], ends: Sequence[str]) -> str:
    """Write an SRDF of a robot: a comment, disabled pairs of links with their reasons, links that carry tools."""
    lines = ['<?xml version="1.0"?>', f"<!-- {comment.replace('--', '- -')} -->", f"<robot name={quoteattr(robot)}>"]
    lines += [f"  <end_effector name={name} parent_link={name} group={name}/>" for name in map(quoteattr, ends)]
    for pair in sorted(sorted(links) for links in disabled):
        a, b, why = map(quoteattr, (pair[0], pair[-1], disabled[frozenset(pair)]))
        lines.append(f"  <disable_collisions link1={a} link2={b} reason={why}/>")
    return "\n".join([*lines, "</robot>", ""])
