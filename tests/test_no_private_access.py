"""Tests use public names of the package alone."""

import ast
from pathlib import Path

import pytest

TESTS = Path(__file__).parent
NAMED_TUPLES = {"_asdict", "_fields", "_make", "_replace"}
"""Public members of named tuples, whose underscore keeps them apart from fields."""


def is_private(name: object) -> bool:
    return isinstance(name, str) and name.startswith("_") and not name.endswith("__") and name not in NAMED_TUPLES


def private_accesses(source: str) -> list[str]:
    """Line and name of every private member that is read, replaced or imported, but those of `self` and `os._exit`."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Attribute) and is_private(node.attr):
            owner = node.value.id if isinstance(node.value, ast.Name) else ""
            if owner not in ("self", "cls", "os"):
                found.append(f"{node.lineno}: {node.attr}")
        elif isinstance(node, ast.ImportFrom) and node.module != "__future__":
            found += [f"{node.lineno}: {alias.name}" for alias in node.names if is_private(alias.name)]
        elif isinstance(node, ast.Call):
            function = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
            if function in ("setattr", "getattr", "delattr", "attrgetter"):
                words = [a.value for a in node.args if isinstance(a, ast.Constant) and isinstance(a.value, str)]
                found += [f"{node.lineno}: {word}" for word in words if is_private(word.rpartition(".")[2])]
    return found


@pytest.mark.parametrize("path", sorted(TESTS.glob("*.py")), ids=lambda path: path.name)
def test_file_uses_public_names_alone(path):
    found = private_accesses(path.read_text(encoding="utf-8"))
    assert found == []


def test_private_accesses_are_found():
    source = (
        "from a.b import _c\nx._d\nx._replace()\nx.__len__()\nself._e = 1\n"
        "monkeypatch.setattr(x, '_f', 1)\nmonkeypatch.setattr('a.b._g', 1)\ngetattr(x, '_h')"
    )
    assert sorted(private_accesses(source)) == ["1: _c", "2: _d", "6: _f", "7: a.b._g", "8: _h"]
