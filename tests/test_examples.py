"""The ways in that the README names: every example runs, and so does the README's own snippet."""

import os
import re
import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from qpavoid import Controller, Sample, build_scene, build_tasks
from qpavoid.config import Task

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
    assert len(EXAMPLES) >= 4
    assert all(len(example.read_text().splitlines()) <= 60 for example in EXAMPLES)


def run_snippet(page):
    (snippet,) = re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(encoding="utf-8"), re.S)
    names: dict[str, Any] = {}
    exec(compile(snippet, page, "exec"), names)
    return names


def test_readme_snippet_runs(capsys):
    run_snippet("README.md")
    assert "SOLVED" in capsys.readouterr().out


def test_embedding_snippet_runs():
    assert run_snippet("docs/embedding.md")["controller"].scene.obstacle_names == ["table"]


def joints_after_cycles(controller, cycles=20, steps=314):
    """Joints at the end of each cycle of the tool around a circle of 0.15 m (cycles + 1, nq)."""
    model, q = controller.scene.robot.model, controller.scene.robot.home.copy()
    data, frame = model.createData(), "panda_hand_tcp"
    pin.framesForwardKinematics(model, data, q)
    start, ends, w = data.oMf[model.getFrameId(frame)].copy(), [q], 2.0 * np.pi / (steps * controller.dt)
    for k in range(cycles * steps):
        c, s = np.cos(w * k * controller.dt), np.sin(w * k * controller.dt)
        position = start.translation + 0.15 * np.array([c - 1.0, s, 0.0])
        target = Sample.at(position, start.rotation, linear=0.15 * w * np.array([-s, c, 0.0]))
        q = pin.integrate(model, q, controller.dt * controller.step(q, targets={frame: target}).v)
        if (k + 1) % steps == 0:
            ends.append(q)
    return np.array(ends)


@pytest.mark.parametrize("kind", ["position", "pose"])
def test_quick_start_holds_the_elbow(kind):
    """Its tasks bring all joints back at the end of each cycle; the tool alone does not."""
    quick = run_snippet("README.md")["controller"]
    posture = next(task.settings for task in quick.tasks if task.settings.label == "posture")
    robot, drift = quick.scene.robot, []
    for blocks in ([posture], []):
        tasks = build_tasks([Task(frame="panda_hand_tcp", type=kind), *blocks], robot, robot.home)
        ends = joints_after_cycles(Controller(build_scene(robot), tasks, dt=0.01))
        drift.append((np.abs(ends[-1] - ends[0]).max(), np.abs(ends[-1] - ends[2]).max()))
    (held, settled), (free, _) = drift
    assert held < 0.3 and settled < 2e-3 and free > 1.0
