"""Notes of a robot: what was left out, mended, replaced or assumed when it was loaded."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import Literal


class NoteKind(str, Enum):
    """Part of a robot that a note is about."""

    SHAPE = "shape"
    """Collision shape: left out, replaced, taken from what is meant to be seen."""
    MESH = "mesh"
    """File of a mesh: missing, implausibly large."""
    PAIR = "pair"
    """Pair of bodies that is not checked."""
    LIMIT = "limit"
    """Position or velocity limit: missing, assumed."""
    JOINT = "joint"
    """Joint: locked, moving on its own though it should follow another one."""
    LINK = "link"
    """Link: its size, its mass, its place in the tree."""
    HOME = "home"
    """Home pose: replaced, near a collision, singular."""
    FRAME = "frame"
    """Frame: taken as an end effector."""
    FILE = "file"
    """The file as a whole: prefixes of other tools, xacro."""


SEVERITIES = ("error", "warning", "note")
"""The most serious first."""


@dataclass(frozen=True)
class Note:
    """One thing that was left out, mended, replaced or assumed."""

    kind: NoteKind
    """Part of a robot that it is about."""
    subject: tuple[str, ...]
    """Names of the shapes, joints, links, … that it is about."""
    what: str
    """One clause that says what was done with them, and why."""
    remedy: str = ""
    """What a user can do about it; empty where nothing is needed."""
    severity: Literal["note", "warning", "error"] = "note"
    """`warning`: motion may differ from what the file's author meant; `error`: the robot cannot be used as it is."""
    fraction: float | None = None
    """Of a pair: share of random configurations in which it touches [-]; None where that was not looked at."""

    def __str__(self) -> str:
        """Return one line: kind, names, clause, remedy."""
        names = " - ".join(self.subject) if self.kind is NoteKind.PAIR else abbreviate(self.subject)
        remedy = f"; {self.remedy}" if self.remedy else ""
        return f"{self.kind.value} {names}: {self.what}{remedy}"


class RobotWarning(UserWarning):
    """A robot was loaded, and something of it left out, mended, replaced or assumed; see `Robot.notes`."""


def abbreviate(names: Sequence[str], most: int = 6) -> str:
    """Join the first names of a list, with the number of further ones."""
    suffix = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + suffix


def merge_notes(notes: Iterable[Note]) -> list[Note]:
    """Merge the notes that differ in their subjects alone, in the order of the first.

    Notes of pairs are not merged.
    """
    subjects: dict[Note, list[str]] = {}
    for note in notes:
        key = note if note.kind is NoteKind.PAIR else replace(note, subject=())
        subjects.setdefault(key, []).extend(note.subject)
    return [replace(note, subject=tuple(dict.fromkeys(subject))) for note, subject in subjects.items()]


def issue_warning(notes: Iterable[Note], where: str) -> None:
    """Issue one `RobotWarning` that names the notes of a file which are warnings; none where there are none."""
    serious = [str(note) for note in notes if note.severity == "warning"]
    if serious:
        warnings.warn(f"{where}: " + " | ".join(serious), RobotWarning, stacklevel=4)
