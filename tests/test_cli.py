"""The command line: what it prints where, and its exit status."""

import json
import os
import signal
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest
import yaml
from conftest import Result

from qpavoid import Controller, Log
from qpavoid.config.shipped import data_folder, shipped_names
from qpavoid.solvers import SOLVERS

METRICS = {
    "scenario", "solver", "completed", "collided", "min_distance", "min_pair", "time_in_collision", "time_below",
    "final_error", "max_deviation", "tracking_rmse", "peak_velocity", "jitter", "status_counts", "relaxed_ticks",
    "tick_us", "time_blocked", "severity_counts", "events", "torque",
}  # fmt: skip
SITUATION = yaml.safe_load((data_folder("tasks") / "situation1.yaml").read_text(encoding="utf-8"))


@pytest.fixture
def scene(tmp_path):
    """Writes a short situation 1 with some fields exchanged, and gives its name."""

    def scene(name: str = "scene.yaml", **fields: object) -> str:
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(yaml.safe_dump({**SITUATION, "duration": 0.05, **fields}), encoding="utf-8")
        return name

    return scene


def test_list_names_all_that_ships(cli):
    result = cli("list")
    assert result.status == 0
    words = result.stdout.split()
    assert {*shipped_names("robot"), *shipped_names("scenario"), *SOLVERS, "qp:daqp"} <= set(words)
    assert SITUATION["title"] in next(line for line in result.stdout.splitlines() if "situation1" in line)
    assert all(len(line) <= 80 for line in result.stdout.splitlines())


def test_run_with_a_collision_is_exit_status_1(cli):
    result = cli("run", "situation1", "--solver", "tracking", "--json", "--no-figures", "--out", "out")
    assert result.status == 1
    document = json.loads(result.stdout)
    assert document.keys() >= METRICS | {"files"}
    assert document["tick_us"].keys() == {"p50", "p99", "max"}
    assert document["collided"] is True
    assert document["completed"] is True
    assert document["min_pair"] == ["left_hand", "fist"]
    assert document["files"] == [os.path.join("out", "situation1_tracking.npz")]
    metrics = Log.load(document["files"][0]).metrics()
    assert {key: document[key] for key in metrics} == metrics


def test_run_prints_a_table(cli, scene):
    result = cli("run", scene(), "--no-figures")
    assert result.status == 0
    assert "arrived" in result.stdout
    assert result.stdout.splitlines()[-1] == "1 log in out (--verbose lists them)"
    assert os.path.join("out", "scene_qp.npz") not in result.stdout
    verbose = cli("run", scene(), "--no-figures", "--verbose").stdout.splitlines()
    assert verbose[-2:] == ["1 log in out", os.path.join("out", "scene_qp.npz")]


def test_warmup_leaves_the_code_of_a_scenario_on_disk(cli):
    result = cli("warmup", "panda_line")
    assert result.status == 0 and "1 scenarios" in result.stdout
    folder = Path(result.stdout.split(" in ")[-1].strip())
    assert {"complete"} < {path.name for path in folder.iterdir()}
    refused = cli("warmup", "panda_lin")
    assert refused.status == 2 and "panda_line" in refused.stderr and refused.stderr.count("\n") == 1


def test_version_is_printed(cli):
    result = cli("--version")
    assert (result.status, result.stdout) == (0, f"qpavoid {version('qpavoid')}\n")


def test_run_takes_settings_and_solver(cli, scene):
    result = cli("run", scene(), "--no-figures", "--solver", "eq10", "--set", "solver.damping=0.2", "--set", "dt=0.02")
    assert result.status == 0
    config = Log.load("out/scene_eq10.npz").meta["config"]
    assert config["solver"]["damping"] == 0.2
    assert config["dt"] == 0.02


def test_run_draws_and_lists_figures(cli, scene):
    pytest.importorskip("matplotlib")
    files = json.loads(cli("run", scene(), "--json").stdout)["files"]
    assert any(file.endswith((".png", ".pdf", ".svg")) for file in files)
    assert all(Path(file).is_file() for file in files)


def test_compare_keeps_a_log_of_each_solver(cli):
    """A collision is a result, and no error."""
    solvers = ["tracking", "eq10", "qp"]
    result = cli("compare", "situation1", "--solvers", ",".join(solvers), "--json", "--no-figures")
    assert result.status == 0 and result.lines == []
    document = json.loads(result.stdout)
    assert [run["solver"] for run in document["runs"]] == solvers
    assert [run["collided"] for run in document["runs"]] == [True, False, False]
    assert all(run.keys() >= METRICS for run in document["runs"])
    assert [Log.load(file).meta["solver"] for file in document["files"]] == solvers


def test_compare_with_and_without_planning(cli, scene):
    result = cli("compare", scene(), "--solvers", "eq10,qp", "--planning", "--json", "--no-figures")
    document = json.loads(result.stdout)
    assert [run["solver"] for run in document["runs"]] == ["eq10", "qp", "qp with planning"]
    assert len({Path(file).name for file in document["files"]}) == 3


LAWS = """
import numpy as np
from qpavoid import Solution, Solver


class Slow(Solver):
    def solve(self, problem):
        return Solution(0.5 * problem.v_tracking)


class Plain:
    bounded = True

    def solve(self, problem):
        return Solution(np.clip(0.5 * problem.v_tracking, problem.lower, problem.upper))


def half(problem):
    return 0.5 * problem.v_tracking


class Needy(Slow):
    def __init__(self, gain):
        pass
"""


def test_laws_of_a_file_run_and_are_compared(cli, tmp_path):
    (tmp_path / "laws.py").write_text(LAWS)
    names = ["Slow", "Plain", "half"]
    words = ("situation1", "--set", "duration=0.5", "--no-figures", "--json")
    result = cli("compare", *words, "--solvers", ",".join([*(f"laws.py:{name}" for name in names), "tracking"]))
    document = json.loads(result.stdout)
    assert [run["solver"] for run in document["runs"]] == [*names, "tracking"]
    steps = [np.linalg.norm(Log.load(file).v[0]) for file in document["files"]]
    assert steps[:3] == pytest.approx([0.5 * steps[3]] * 3, rel=0.05)
    assert json.loads(cli("run", *words, "--solver", "laws.py:half").stdout)["solver"] == "half"
    for name, said in (
        ("laws.py", "laws.py: give FILE.py:NAME"),
        ("laws.py:Slo", "did you mean 'Slow'"),
        ("laws.py:np", "laws.py:np: is no law"),
        ("laws.py:Needy", "laws.py:Needy: cannot be made without arguments"),
        ("other.py:Slow", "other.py: cannot be read"),
        ("hpq", "solver 'hpq': solver: unknown name 'hpq'; did you mean 'hqp'?"),
    ):
        assert_refused(cli("run", "situation1", "--no-figures", "--solver", name), said)


def test_an_older_page_is_said_to_be_one(cli, tmp_path):
    words = ("run", "situation1", "--set", "duration=0.05", "--no-figures")
    assert "index.html" not in cli(*words).stdout
    (tmp_path / "out" / "index.html").touch()
    assert "out/index.html and its figures are those of an earlier command" in cli(*words).stdout


def test_compare_checks_all_before_the_first_run(cli, scene, tmp_path):
    good, bad = scene("good.yaml"), scene("bad.yaml", robot="pand")
    result = cli("compare", good, bad, "--no-figures")
    assert result.status == 2
    assert not (tmp_path / "out").exists()


def assert_refused(result: Result, *words: str) -> None:
    assert result.status == 2
    assert result.stdout == ""
    (line,) = result.stderr.splitlines()
    assert line.startswith("error: ")
    assert "Traceback" not in line
    for word in words:
        assert word in line


def test_compare_refuses_runs_that_would_overwrite_each_other(cli, scene):
    names = [scene("a/scene.yaml"), scene("b/scene.yaml")]
    assert_refused(cli("compare", *names, "--solvers", "qp", "--no-figures"), "scene qp", "twice")
    assert_refused(cli("compare", names[0], "--solvers", "eq10,eq10", "--no-figures"), "scene eq10", "twice")


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"robot": "pand"}, ["scene.yaml: robot", "did you mean 'panda'"]),
        ({"solver": "qp:daqpp"}, ["scene.yaml: solver", "unknown QP back end 'daqpp'; usable are daqp"]),
        (
            {"tasks": [{"frame": "left_tool", "motion": {"type": "csv", "path": "absent.csv"}}]},
            ["tasks.0", "absent.csv", "cannot be read"],
        ),
        (
            {"obstacles": [{**SITUATION["obstacles"][0], "name": "left_hand"}]},
            ["scene.yaml", "'left_hand' is the name of a body"],
        ),
    ],
)
def test_bad_scenario_is_refused_in_one_line(cli, scene, fields, words):
    assert_refused(cli("run", scene(**fields), "--no-figures"), *words)


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["run", "situaton1"], ["unknown scenario 'situaton1'; did you mean 'situation1'"]),
        (["run", "situation1", "--solver", "eq11"], ["did you mean 'eq10'"]),
        (["run", "situation1", "--set", "avoidance.d2=0.1"], ["needs 0 < d1 < d2"]),
        (["compare", "situation1", "--solvers", ","], ["--solvers"]),
    ],
)
def test_bad_arguments_are_refused_in_one_line(cli, args, words):
    assert_refused(cli(*args, "--no-figures"), *words)


def test_run_that_cannot_be_logged_is_refused(cli, scene, tmp_path):
    """The folder is a file; there is not enough memory."""
    (tmp_path / "taken").write_text("", encoding="utf-8")
    for options, word in ((["--out", "taken"], "taken"), (["--set", "duration=1e13"], "duration")):
        result = cli("run", scene(), "--no-figures", *options)
        assert result.status == 2
        (line,) = result.lines
        assert line.startswith("error: ") and word in line


def test_start_in_collision_or_outside_the_limits_is_a_warning(cli, scene):
    fist = {**SITUATION["obstacles"][0], "motion": {"type": "fixed", "position": [0.396, 0.65, 0.747]}}
    result = cli("run", scene(obstacles=[fist]), "--no-figures", "--json")
    assert result.status == 1
    assert json.loads(result.stdout)["collided"] is True
    (line,) = result.lines
    assert line.startswith("warning: scene.yaml: q0: left_hand and fist overlap by ")
    robot = yaml.safe_load((data_folder("robots") / "paper-dual-arm" / "robot.yaml").read_text(encoding="utf-8"))
    robot["urdf"] = str(data_folder("robots") / "paper-dual-arm" / robot["urdf"])
    robot["limits"] = {"position": {"left_joint1": [-1.0, 1.0]}}
    Path("arm.yaml").write_text(yaml.safe_dump(robot), encoding="utf-8")
    result = cli("run", scene(robot="arm.yaml"), "--no-figures", "--json")
    assert result.status == 0
    assert result.lines == ["warning: scene.yaml: q0: left_joint1 = -1.18 lies outside its limits [-1, 1] [rad or m]"]


@pytest.mark.parametrize("args", [["run"], ["fly"], ["run", "situation1", "--fast"], ["list", "planets"]])
def test_usage_error_is_exit_status_2(cli, args):
    result = cli(*args)
    assert result.status == 2
    assert result.stdout == ""
    assert "Usage" in result.stderr
    assert "Traceback" not in result.stderr


def test_module_runs_as_a_process(tmp_path):
    command = [sys.executable, "-m", "qpavoid", "run", "situation1", "--set", "duration=0.05", "--no-figures", "--json"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["completed"] is True


@pytest.mark.skipif(os.name != "posix", reason="signals")
@pytest.mark.parametrize("signum", [signal.SIGINT, signal.SIGTERM])
def test_signal_leaves_a_log_of_the_steps_before(cli, monkeypatch, signum):
    ticks, tick = [], Controller.tick

    def counted(self, *args, **named):
        ticks.append(args)
        if len(ticks) == 60:
            signal.raise_signal(signum)
        return tick(self, *args, **named)

    monkeypatch.setattr(Controller, "tick", counted)
    monkeypatch.setattr(Controller, "closed_loop", lambda self: None)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a parent may have it ignored
    result = cli("run", "situation1", "--set", "duration=1000", "--no-figures", "--json")
    signal.signal(signal.SIGINT, before)
    assert result.status == 1
    assert "broken off" in result.stderr and "Traceback" not in result.stderr
    document = json.loads(result.stdout)
    assert document["completed"] is False
    log = Log.load(document["files"][0])
    assert 50 <= len(log.t) <= 60
    assert log.meta["completed"] is False
