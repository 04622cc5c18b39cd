"""Every block of code on the pages is run, once: here, or by the test that is named here."""

import functools
import re
import shlex
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
import typer
import yaml
from typer.main import get_command

from qpavoid import Controller, Sample, ScenarioConfig, build_scene, build_tasks
from qpavoid.cli import app
from qpavoid.config import Task
from qpavoid.config.shipped import shipped_names

ROOT = Path(__file__).parents[1]
PAGES = {page.name: page.read_text(encoding="utf-8") for page in [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]}
ELSEWHERE = {
    "adapters.md": "test_adapters.py",  # needs Pink and MuJoCo
    "arena.md": "test_docs_arena.py",  # needs results of a sweep
    "arena_families.md": "test_docs_families.py",  # makes cases of its families
    "camera.md": "test_docs_camera.py",  # its second block needs a world of MuJoCo
    "laws.md": "test_docs_laws.py",  # slow: two whole runs of eq. 10
    "your_own_robot.md": "test_docs.py",  # slow: describes a robot
}
"""Pages whose Python is run by another test, and why."""
NOT_RUN = {
    "view": "serves until it is stopped: test_view_browser",
    "serve": "serves until it is stopped: test_service_clients",
    "render": "makes films: test_render",
    "warmup": "compiles for minutes",
    "robot": "needs a file: test_robot_commands, test_docs",
    "bench": "runs for minutes: test_docs_arena, test_bench",
}
"""Commands that are parsed only, and why."""


def blocks(page, kind):
    return re.findall(rf"```{kind}\n(.*?)```", PAGES[page], re.S)


@functools.cache
def run(page):
    """Names after all Python of a page, as somebody copies it block by block."""
    names = {}
    for block in blocks(page, "python"):
        exec(compile(block, page, "exec"), names)
    return names


RUN_HERE = sorted(page for page in PAGES if blocks(page, "python") and page not in ELSEWHERE)


@pytest.mark.filterwarnings("ignore::UserWarning")  # of a bare URDF, whose notes a page prints
@pytest.mark.parametrize("page", RUN_HERE)
def test_python_of_a_page_runs(page, tmp_path, monkeypatch, capsys):
    if page == "view.md":
        pytest.importorskip("viser")
    monkeypatch.chdir(tmp_path)
    for name, text in re.findall(r"Save this as `([\w.]+)`:\n+```yaml\n(.*?)```", PAGES[page], re.S):
        (tmp_path / name).write_text(text)
    run(page)
    said = {"README.md": "SOLVED", "tasks.md": "SOLVED", "architecture.md": "tool0", "start.md": "tracking True"}
    assert said.get(page, "") in capsys.readouterr().out


def test_pages_that_are_run_elsewhere_are():
    for page, test in ELSEWHERE.items():
        text = (ROOT / "tests" / test).read_text(encoding="utf-8")
        assert page in text and "exec(" in text and blocks(page, "python")


def test_loop_of_real_robots_keeps_the_limits_and_evades_late():
    names = run("real_robots.md")
    assert (np.abs(names["v"]) <= names["robot"].bounds().velocity + 1e-9).all()
    assert 0.01 < np.abs(names["q"] - names["robot"].home).max() < 1.0


def test_loop_of_ones_own_ends_without_the_cup():
    assert run("embedding.md")["controller"].scene.obstacle_names == ["table"]


def test_own_scenario_of_the_start_is_as_the_page_says(cli, tmp_path):
    """The QP arrives where tracking collides; with the ball on the goal it stops in front of it, and says why."""
    (block,) = blocks("start.md", "yaml")
    (tmp_path / "first.yaml").write_text(block)
    _, blocked = re.findall(r"^    (qpavoid .*first.yaml.*)$", PAGES["start.md"], re.M)
    both = cli("compare", "first.yaml", "--solvers", "tracking,qp", "--no-figures").stdout
    assert both.count("arrived") == 2 and both.count("collided") == 1
    said = cli(*shlex.split(blocked)[1:], "--no-figures")
    assert said.status == 0 and "no progress" in said.stdout and "ball" in said.stdout


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
    quick = run("README.md")["controller"]
    posture = next(task.settings for task in quick.tasks if task.settings.label == "posture")
    robot, drift = quick.scene.robot, []
    for blocks in ([posture], []):
        tasks = build_tasks([Task(frame="panda_hand_tcp", type=kind), *blocks], robot, robot.home)
        ends = joints_after_cycles(Controller(build_scene(robot), tasks, dt=0.01))
        drift.append((np.abs(ends[-1] - ends[0]).max(), np.abs(ends[-1] - ends[2]).max()))
    (held, settled), (free, _) = drift
    assert held < 0.3 and settled < 2e-3 and free > 1.0


@pytest.mark.parametrize("block", blocks("tasks.md", "yaml"))
def test_tasks_page_block_is_one_of_a_scenario(block):
    scenario = ScenarioConfig.model_validate({"robot": "panda", "duration": 1.0, **yaml.safe_load(block)})
    controller, q = Controller.from_scenario(scenario)
    assert len(controller.tasks) == len(scenario.tasks)
    assert controller.step(q).status.value == "SOLVED"


def commands():
    """(page, words) of each command of qpavoid that a page shows, without its comment."""
    for page, text in PAGES.items():
        for line in re.findall(r"^(?:    |\$ )qpavoid (.*)$", text, re.M):
            yield page, tuple(shlex.split(line, comments=True))


COMMANDS = sorted(set(commands()))


def parse(words):
    """Refuse a command that does not exist, or an option that it does not have."""
    command, context, words = get_command(app), None, list(words)
    while isinstance(command, typer.core.TyperGroup):
        context = command.make_context(words[0], [], parent=context, resilient_parsing=True)
        _, command, words = command.resolve_command(context, words)
    command.make_context("qpavoid", words, parent=context)


@pytest.mark.parametrize(
    ("page", "words"), COMMANDS, ids=lambda part: "-".join(part[:2]) if isinstance(part, tuple) else part
)
def test_command_of_a_page_exists(page, words):
    if words[0] != "bench":  # whose options another parser takes: test_docs_arena
        parse(words)
    if words[0] in ("view", "serve", "render"):
        assert words[1] in shipped_names("scenario") or "." in words[1]


def test_commands_of_pages_run(cli):
    """What is left of the commands, each once, and shortly; laws.md has tests of its own."""
    with_tests = ("laws.md", "your_own_robot.md")
    for words in sorted({words for page, words in COMMANDS if words[0] not in NOT_RUN and page not in with_tests}):
        short = ("--set", "duration=0.05", "--no-figures") if words[0] in ("run", "compare") else ()
        if "first.yaml" not in words:  # of the start page, run above
            assert cli(*words, *short).status == 0, words
