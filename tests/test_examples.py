"""Every example runs, and is short; they are numbered."""

import os
import re
import runpy
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
EXAMPLES = sorted([*(ROOT / "examples").glob("*.py"), *(ROOT / "examples" / "adapters").glob("*.py")])


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_example_runs(example, capsys):
    """Those of adapters need their library, which is there in CI."""
    for name in re.findall(r"(?m)^import (pink|mink|mujoco)$|^from (roboplan) ", example.read_text(encoding="utf-8")):
        if not os.environ.get("CI"):
            pytest.importorskip("".join(name))
    runpy.run_path(str(example), run_name="__main__")
    printed = capsys.readouterr().out
    assert printed
    for millimetres in re.findall(r"closest (-?[\d.]+) mm", printed):
        assert float(millimetres) > 0.0, "an example collides"


def test_examples_stay_short():
    assert len(EXAMPLES) >= 10
    assert all(len(example.read_text().splitlines()) <= 60 for example in EXAMPLES)


def test_examples_have_a_number_each():
    numbers = [int(path.name[:2]) for path in EXAMPLES if path.parent.name == "examples"]
    assert len(set(numbers)) == len(numbers)


def test_examples_say_what_they_are_about():
    """In one line, as the first thing."""
    assert all(re.match(r'"""\w.+', example.read_text(encoding="utf-8")) for example in EXAMPLES)
