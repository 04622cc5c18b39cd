"""docs/laws.md: its blocks are scenarios' with every setting at its default, its figures those of its commands."""

import json
import re
import shlex
from pathlib import Path

import pytest
import yaml

from qpavoid import ScenarioConfig
from qpavoid.config import Avoidance
from qpavoid.solvers import SOLVERS, parse_solver

PAGE = (Path(__file__).parent.parent / "docs" / "laws.md").read_text(encoding="utf-8")
METRICS = {
    "closest surfaces [mm]": ("min_distance", 1e3),
    "in collision [s]": ("time_in_collision", 1.0),
    "end error [mm]": ("final_error", 1e3),
    "off the path [mm]": ("max_deviation", 1e3),
    "peak q̇ [rad/s]": ("peak_velocity", 1.0),
    "Σ|Δq̇| [rad/s]": ("jitter", 1.0),
}
"""Column of a table of figures: name among the figures of a run, and its unit."""


def tables():
    """Rows of each table, as {column: cell}."""
    for table in re.findall(r"(?:^\|.*\n)+", PAGE, re.M):
        lines = [
            [cell.strip().strip("`").replace("\\|", "|") for cell in re.split(r"(?<!\\)\|", line)[1:-1]]
            for line in table.splitlines()
        ]
        yield [dict(zip(lines[0], line, strict=True)) for line in lines[2:]]


FIGURES = [
    rows for rows in tables() if "Σ|Δq̇| [rad/s]" in rows[0] and not any(" / " in cell for cell in rows[0].values())
]
"""Tables of single runs; the one of ratios has two figures in a cell."""
SNIPPETS = re.findall(r"```python\n(.*?)```", PAGE, re.S)
COMMANDS = re.findall(r"^    qpavoid (compare .*)$", PAGE, re.M)


def ran(cli, command):
    return json.loads(cli(*shlex.split(command), "--json").stdout)["runs"]


def assert_figures(row, run):
    """Each figure of a row is within two of its last digit and 2 %: platforms differ where a law chatters."""
    for column in set(row) & set(METRICS):
        name, unit = METRICS[column]
        digit = 10.0 ** -len(row[column].partition(".")[2])
        assert float(row[column]) == pytest.approx(unit * run[name], abs=2 * digit, rel=0.02), f"{row}: {column}"


def test_laws_page_has_all_settings_at_their_defaults():
    parts = re.split(r"^## ", PAGE, flags=re.M)
    for name in SOLVERS:
        (part,) = [part for part in parts if f"`{name}`" in part.splitlines()[0]]
        (block,) = [yaml.safe_load(block) for block in re.findall(r"```yaml\n(.*?)```", part, re.S)]
        ScenarioConfig.model_validate({"robot": "panda", "tasks": [{"frame": "panda_hand"}], "duration": 1.0, **block})
        default = parse_solver(name).model_dump()
        assert block["solver"] | {"name": name} == default
        if "avoidance" in block:
            assert Avoidance(**block["avoidance"]) == Avoidance()


def test_laws_page_commands_run(cli):
    for command in COMMANDS:
        assert ran(cli, f"{command} --set duration=0.02 --no-figures"), command


def test_law_of_ones_own_keeps_the_distance_of_its_scene():
    names = {}
    exec(compile(SNIPPETS[1], "docs/laws.md", "exec"), names)
    assert f"It keeps the {1e3 * names['closest']:.0f} mm" in PAGE
    assert f"is {1e3 * names['left']:.0f} mm from its goal" in PAGE


@pytest.mark.slow
def test_laws_page_figures_are_those_of_its_commands(cli):
    (command,) = [command for command in COMMANDS if "situation1" in command]
    runs = ran(cli, command)
    assert [(row["scenario"], row["law"]) for row in FIGURES[0]] == [(run["scenario"], run["solver"]) for run in runs]
    for row, run in zip(FIGURES[0], runs, strict=True):
        assert_figures(row, run)
    for row, command in zip(FIGURES[1], [command for command in COMMANDS if "eq10 " in command], strict=True):
        assert command.endswith(f"--set {row['set']}")
        (run,) = ran(cli, command)
        assert_figures(row, run)
    commands = [command for command in COMMANDS if "avoidance.row" in command]
    runs = [(command, run) for command in commands for run in ran(cli, command)]
    for row, (command, run) in zip(FIGURES[2], runs, strict=True):
        assert row["row"] in command and row["scenario"] == run["scenario"]
        assert_figures(row, run)


@pytest.mark.slow
def test_laws_page_snippet_prints_what_the_page_says(capsys):
    """But for the digits."""
    snippet, _ = SNIPPETS
    (said,) = re.findall(r"```text\n(.*?)```", PAGE, re.S)
    exec(compile(snippet, "docs/laws.md", "exec"), {})
    numbers = r"(?<![\w.])\d+"
    assert re.sub(numbers, "#", capsys.readouterr().out) == re.sub(numbers, "#", said)
