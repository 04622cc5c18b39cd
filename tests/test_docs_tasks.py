"""The page on tasks names every kind of them."""

import re
from pathlib import Path

from qpavoid import ScenarioConfig

TASKS = (Path(__file__).parent.parent / "docs" / "tasks.md").read_text()


def test_tasks_page_has_every_kind_of_task():
    kinds = re.findall(
        r"`(\w+)`", " ".join(line.split("|")[1] for line in TASKS.splitlines() if line.startswith("| `"))
    )
    schema = str(ScenarioConfig.model_json_schema()["properties"]["tasks"])
    assert {"position", "orientation", "manipulability"} < set(kinds)
    assert all(kind in schema for kind in kinds if kind not in ("type", "position"))
