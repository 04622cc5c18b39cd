"""docs/arena_families.md: its table is that of what ships, its families are families, its snippets run."""

import re
from pathlib import Path

import pytest

from qpavoid.config.shipped import shipped_names
from qpavoid.model.robot import Robot
from qpavoid_bench.arena.families import load_family, make_case
from qpavoid_bench.arena.families.arms import arms

PAGE = (Path(__file__).parent.parent / "docs" / "arena_families.md").read_text(encoding="utf-8")
FAMILIES = re.findall(r"```yaml\n(.*?)```", PAGE, re.S)
SNIPPETS = re.findall(r"```python\n(.*?)```", PAGE, re.S)


def test_the_table_lists_what_ships():
    names = re.findall(r"^\| `(\w+)` \|", PAGE.split("## How a case")[0], re.M)
    assert sorted(names) == shipped_names("family")


@pytest.mark.parametrize("number", range(2))
def test_families_of_the_page_make_cases(number, tmp_path):
    (tmp_path / "own.yaml").write_text(FAMILIES[number])
    (tmp_path / "posts.py").write_text(SNIPPETS[1])
    family = load_family(tmp_path / "own.yaml")
    made = [make_case(family, seed) for seed in range(2)]
    assert made[0].scenario.obstacles != made[1].scenario.obstacles
    assert all("RRT-Connect" in case.solved_by for case in made)


def test_page_snippet_output(capsys):
    """The snippet prints what solved it."""
    exec(compile(SNIPPETS[0], "docs/arena_families.md", "exec"), {})
    assert re.match(rf"{len(shipped_names('family'))} ur5 RRT-Connect", capsys.readouterr().out)


@pytest.mark.parametrize(("name", "said"), [("panda", "Panda"), ("ur5", "UR5"), ("paper-dual-arm", "the paper's arm")])
def test_arm_lengths_are_those_of_the_page(name, said):
    (length,) = re.findall(rf"{said} (\d\.\d\d) m", PAGE)
    assert arms(Robot.load(name))[0].length == pytest.approx(float(length), abs=0.006)
