"""What docs/ shows works: every Python snippet runs, every block of a scenario is one."""

import re
from pathlib import Path

import pytest
import yaml

from qpavoid import Controller, ScenarioConfig

TASKS = (Path(__file__).parent.parent / "docs" / "tasks.md").read_text()


@pytest.mark.parametrize("snippet", re.findall(r"```python\n(.*?)```", TASKS, re.S))
def test_tasks_page_snippet_runs(snippet, capsys):
    exec(compile(snippet, "docs/tasks.md", "exec"), {})
    assert "SOLVED" in capsys.readouterr().out


@pytest.mark.parametrize("block", re.findall(r"```yaml\n(.*?)```", TASKS, re.S))
def test_tasks_page_block_is_one_of_a_scenario(block):
    scenario = ScenarioConfig.model_validate({"robot": "panda", "duration": 1.0, **yaml.safe_load(block)})
    controller, q = Controller.from_scenario(scenario)
    assert len(controller.tasks) == len(scenario.tasks)
    assert controller.step(q).status.value == "SOLVED"


def test_tasks_page_has_every_kind_of_task():
    kinds = re.findall(
        r"`(\w+)`", " ".join(line.split("|")[1] for line in TASKS.splitlines() if line.startswith("| `"))
    )
    schema = str(ScenarioConfig.model_json_schema()["properties"]["tasks"])
    assert {"position", "orientation", "manipulability"} < set(kinds)
    assert all(kind in schema for kind in kinds if kind not in ("type", "position"))
