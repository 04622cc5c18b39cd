"""The ways in that the README names: every example runs, and so does the README's own snippet."""

import re
import runpy
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_example_runs(example, capsys):
    runpy.run_path(str(example), run_name="__main__")
    printed = capsys.readouterr().out
    assert printed
    for millimetres in re.findall(r"closest (-?[\d.]+) mm", printed):
        assert float(millimetres) > 0.0, "an example collides"


def test_examples_stay_short():
    assert len(EXAMPLES) >= 4
    assert all(len(example.read_text().splitlines()) <= 60 for example in EXAMPLES)


def test_readme_snippet_runs(capsys):
    snippets = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.S)
    assert len(snippets) == 1
    exec(compile(snippets[0], "README.md", "exec"), {})
    assert "SOLVED" in capsys.readouterr().out
