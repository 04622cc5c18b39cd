"""The order of imports: every arrow between rooms of the package leads to a lower level, and no circle can close."""

import ast
from collections import defaultdict
from pathlib import Path

import pytest

import qpavoid

LEVELS = (
    ("errors", "reason"), ("config", "problem"), ("kernels", "geometry"), ("solvers", "model"), ("control",),
    ("safety",), ("controller",), ("run",), ("viz",), ("setup", "arena"), ("cli",), ("__main__",),
)  # fmt: skip
"""Rooms (folders, and modules beside them) from the bottom up; those of one level do not know each other."""
LEVEL = {room: level for level, rooms in enumerate(LEVELS) for room in rooms}
ROOT = Path(qpavoid.__file__).parent


def imported(path):
    """Modules of the package that a file imports, wherever in the file."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def arrows():
    """(room, room it imports, file) of every import between two rooms; `__init__` of the package stands above all."""
    for path in sorted(ROOT.rglob("*.py")):
        room = path.relative_to(ROOT).with_suffix("").parts[0]
        for name in imported(path):
            package, other = (*name.split(".", 2), "")[:2]
            if package == "qpavoid" and room in LEVEL and other in LEVEL and other != room:
                yield room, other, path.relative_to(ROOT).as_posix()


def test_every_room_has_a_level():
    rooms = {path.relative_to(ROOT).with_suffix("").parts[0] for path in ROOT.rglob("*.py")} - {"__init__"}
    assert rooms == set(LEVEL)


def test_imports_lead_down():
    assert [arrow for arrow in arrows() if LEVEL[arrow[0]] <= LEVEL[arrow[1]]] == []


def test_floors(capsys):
    below = defaultdict(set)
    for room, other, _ in arrows():
        below[room].add(other)

    def floor(room):
        return 1 + max(map(floor, below[room]), default=0)

    floors = max(map(floor, LEVEL))
    with capsys.disabled():
        print(f"\nfloors of imports: {floors}")
    assert floors <= 12


@pytest.mark.parametrize("path", sorted(ROOT.rglob("*.py")), ids=lambda path: path.relative_to(ROOT).as_posix())
def test_modules_have_one_idea(path):
    assert len(path.read_text(encoding="utf-8").splitlines()) <= 350
