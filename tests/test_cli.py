"""The command line: what it prints where, and its exit status."""

import json
import os
import signal
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest
import yaml
from conftest import Result

from qpavoid import Log
from qpavoid.files.shipped import data_folder, robot_names, scenario_names
from qpavoid.solvers import SOLVERS

METRICS = {
    "scenario", "solver", "completed", "collided", "min_distance", "min_pair", "time_in_collision", "time_below",
    "final_error", "max_deviation", "tracking_rmse", "peak_velocity", "jitter", "status_counts", "relaxed_ticks",
    "tick_us", "time_blocked", "severity_counts", "events",
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


def process(*args: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "qpavoid", *args]
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=300, check=False)


# list


def test_list_names_everything_that_ships(cli):
    result = cli("list")
    assert result.status == 0
    words = result.stdout.split()
    assert {*robot_names(), *scenario_names(), *SOLVERS, "qp:daqp"} <= set(words)
    assert SITUATION["title"] in next(line for line in result.stdout.splitlines() if "situation1" in line)
    assert all(len(line) <= 80 for line in result.stdout.splitlines())


def test_list_of_one_kind_is_a_name_a_line(cli):
    assert cli("list", "robots").stdout.splitlines() == robot_names()
    assert cli("list", "scenarios").stdout.splitlines() == scenario_names()
    assert {"eq10", "qp", "qp:proxqp"} <= set(cli("list", "solvers").stdout.splitlines())


# run


def test_collision_is_exit_status_1_and_json_is_all_there_is_on_stdout(cli):
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


def test_run_that_stays_clear_is_exit_status_0(cli):
    result = cli("run", "situation1", "--no-figures", "--json")
    assert result.status == 0
    assert json.loads(result.stdout)["collided"] is False
    assert result.lines == []


def test_table_for_people(cli, scene):
    result = cli("run", scene(), "--no-figures")
    assert result.status == 0
    assert "arrived" in result.stdout
    assert result.stdout.splitlines()[-1] == "1 log in out (--verbose lists them)"
    assert os.path.join("out", "scene_qp.npz") not in result.stdout
    verbose = cli("run", scene(), "--no-figures", "--verbose").stdout.splitlines()
    assert verbose[-2:] == ["1 log in out", os.path.join("out", "scene_qp.npz")]


def test_version(cli):
    result = cli("--version")
    assert (result.status, result.stdout) == (0, f"qpavoid {version('qpavoid')}\n")


def test_set_and_solver_reach_the_run(cli, scene):
    result = cli("run", scene(), "--no-figures", "--solver", "eq10", "--set", "solver.damping=0.2", "--set", "dt=0.02")
    assert result.status == 0
    config = Log.load("out/scene_eq10.npz").meta["config"]
    assert config["solver"]["damping"] == 0.2
    assert config["dt"] == 0.02


def test_figures_are_drawn_and_listed(cli, scene):
    pytest.importorskip("matplotlib")
    files = json.loads(cli("run", scene(), "--json").stdout)["files"]
    assert any(file.endswith((".png", ".pdf", ".svg")) for file in files)
    assert all(Path(file).is_file() for file in files)


def test_logs_of_different_solvers_do_not_overwrite_each_other(cli, scene):
    name = scene("dodge.v2.yaml")
    document = json.loads(cli("compare", name, "--solvers", "tracking,eq10,qp", "--no-figures", "--json").stdout)
    assert [Log.load(file).meta["solver"] for file in document["files"]] == ["tracking", "eq10", "qp"]


# compare


def test_compare_counts_a_collision_as_a_result(cli):
    solvers = "tracking,eq10-literal,eq10,qp"
    result = cli("compare", "situation1", "--solvers", solvers, "--json", "--no-figures")
    assert result.status == 0
    runs = json.loads(result.stdout)["runs"]
    assert [run["solver"] for run in runs] == solvers.split(",")
    assert [run["collided"] for run in runs] == [True, False, False, False]
    assert all(run.keys() >= METRICS for run in runs)


def test_compare_checks_everything_before_the_first_run(cli, scene, tmp_path):
    good, bad = scene("good.yaml"), scene("bad.yaml", robot="pand")
    result = cli("compare", good, bad, "--no-figures")
    assert result.status == 2
    assert not (tmp_path / "out").exists()


# Bad input


def assert_refused(result: Result, *words: str) -> None:
    assert result.status == 2
    assert result.stdout == ""
    (line,) = result.stderr.splitlines()
    assert line.startswith("error: ")
    assert "Traceback" not in line
    for word in words:
        assert word in line


def test_runs_that_would_overwrite_each_other_are_refused(cli, scene):
    names = [scene("a/scene.yaml"), scene("b/scene.yaml")]
    assert_refused(cli("compare", *names, "--solvers", "qp", "--no-figures"), "scene qp", "twice")
    assert_refused(cli("compare", names[0], "--solvers", "eq10,eq10", "--no-figures"), "scene eq10", "twice")


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"robot": "pand"}, ["scene.yaml: robot", "did you mean 'panda'"]),
        ({"robot": "absent/robot.yaml"}, ["scene.yaml: robot", "absent/robot.yaml: no such file"]),
        ({"q0": [0.0, 1.0]}, ["scene.yaml: q0: 2 values for 14 coordinates"]),
        ({"q0": {"left_joint9": 1.0}}, ["scene.yaml: q0: no joint 'left_joint9'; did you mean 'left_joint"]),
        ({"q0": [float("nan")] * 14}, ["scene.yaml: q0.0", "finite"]),
        ({"lock": ["righ_joint*"]}, ["scene.yaml: lock", "no joint 'righ_joint*'"]),
        ({"avoidance": {"d1": 0.3, "d2": 0.1}}, ["scene.yaml: avoidance: needs 0 < d1 < d2"]),
        ({"solver": "eq11"}, ["scene.yaml: solver", "did you mean 'eq10'"]),
        ({"solver": "qp:daqpp"}, ["scene.yaml: solver", "unknown QP back end 'daqpp'; usable are daqp"]),
        ({"solver": "qp:gurobi"}, ["scene.yaml: solver", "'gurobi' is not installed"]),
        ({"durations": 1}, ["scene.yaml: durations: unknown key; did you mean 'duration'"]),
        ({"tasks": [{**SITUATION["tasks"][0], "frame": "left_tol"}]}, ["tasks.0.frame", "did you mean 'left_tool'"]),
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
def test_bad_scenario_is_one_line_and_exit_status_2(cli, scene, fields, words):
    assert_refused(cli("run", scene(**fields), "--no-figures"), *words)


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["run", "situaton1"], ["unknown scenario 'situaton1'; did you mean 'situation1'"]),
        (["run", "absent.yaml"], ["absent.yaml: no such file"]),
        (["run", "situation1", "--solver", "eq11"], ["did you mean 'eq10'"]),
        (["run", "situation1", "--solver", "eq10:daqp"], ["solver.backend: unknown key"]),
        (["run", "situation1", "--set", "avoidance.d2"], ["expected path=value"]),
        (["run", "situation1", "--set", "avoidance.d2=0.1"], ["needs 0 < d1 < d2"]),
        (["compare", "situation1", "--solvers", ","], ["--solvers"]),
        (["compare", "situation1", "--solvers", "qp,eq11"], ["did you mean 'eq10'"]),
    ],
)
def test_bad_arguments_are_one_line_and_exit_status_2(cli, args, words):
    assert_refused(cli(*args, "--no-figures"), *words)


def test_out_that_is_a_file_is_refused(cli, scene, tmp_path):
    (tmp_path / "taken").write_text("", encoding="utf-8")
    result = cli("run", scene(), "--no-figures", "--out", "taken")
    assert result.status == 2
    (line,) = result.lines
    assert line.startswith("error: ")
    assert "taken" in line


def test_run_too_long_for_the_memory_is_refused(cli, scene):
    result = cli("run", scene(duration=1e13), "--no-figures")
    assert result.status == 2
    (line,) = result.lines
    assert line.startswith("error: ")
    assert "duration" in line


@pytest.mark.parametrize("bodies", ["convex", "capsule", "mesh"])
def test_mesh_that_cannot_be_found(cli, scene, tmp_path, bodies):
    mesh = '<mesh filename="package://nowhere_description/meshes/hand.stl"/>'
    (tmp_path / "arm.urdf").write_text(
        f'<robot name="arm"><link name="base"><collision><geometry>{mesh}</geometry></collision></link></robot>',
        encoding="utf-8",
    )
    (tmp_path / "arm.yaml").write_text(f"name: arm\nurdf: arm.urdf\nbodies: {bodies}\n", encoding="utf-8")
    result = cli("run", scene(robot="arm.yaml"), "--no-figures")
    assert_refused(result, "nowhere_description/meshes/hand.stl", "package_dirs", "ROS_PACKAGE_PATH")


def test_urdf_that_is_none(cli, scene, tmp_path):
    (tmp_path / "arm.urdf").write_text("<robot", encoding="utf-8")
    assert_refused(cli("run", scene(robot="arm.urdf"), "--no-figures"), "arm.urdf: not a usable URDF")


# A start that is questionable, but possible


def test_start_in_collision_is_a_warning(cli, scene):
    fist = {**SITUATION["obstacles"][0], "motion": {"type": "fixed", "position": [0.396, 0.65, 0.747]}}
    result = cli("run", scene(obstacles=[fist]), "--no-figures", "--json")
    assert result.status == 1
    assert json.loads(result.stdout)["collided"] is True
    assert len(result.lines) == 1
    assert result.lines[0].startswith("warning: scene.yaml: q0: left_hand and fist overlap by ")


def test_start_outside_the_limits_is_a_warning(cli, scene):
    robot = yaml.safe_load((data_folder("robots") / "paper-dual-arm" / "robot.yaml").read_text(encoding="utf-8"))
    robot["urdf"] = str(data_folder("robots") / "paper-dual-arm" / robot["urdf"])
    robot["limits"] = {"position": {"left_joint1": [-1.0, 1.0]}}
    Path("arm.yaml").write_text(yaml.safe_dump(robot), encoding="utf-8")
    result = cli("run", scene(robot="arm.yaml"), "--no-figures", "--json")
    assert result.status == 0
    assert result.lines == ["warning: scene.yaml: q0: left_joint1 = -1.18 lies outside its limits [-1, 1] [rad or m]"]


# Usage


@pytest.mark.parametrize(
    "args", [["run"], ["compare"], ["fly"], ["run", "situation1", "--fast"], ["list", "planets"], ["run", "a", "b"]]
)
def test_usage_errors_are_exit_status_2(cli, args):
    result = cli(*args)
    assert result.status == 2
    assert result.stdout == ""
    assert "Usage" in result.stderr
    assert "Traceback" not in result.stderr


@pytest.mark.parametrize("args", [["--help"], ["run", "--help"], ["compare", "--help"], ["list", "--help"]])
def test_help(cli, args):
    result = cli(*args)
    assert result.status == 0
    assert "Usage" in result.stdout


# In a process of its own


def test_whole_process_good_and_bad(tmp_path):
    args = ("run", "situation1", "--set", "duration=0.05", "--no-figures")
    good = process(*args, "--json", cwd=tmp_path)
    assert good.returncode == 0, good.stderr
    assert json.loads(good.stdout)["completed"] is True
    bad = process(*args, "--solver", "eq11", cwd=tmp_path)
    assert bad.returncode == 2
    assert bad.stdout == ""
    assert len(bad.stderr.splitlines()) == 1


LONG_RUN = """
import signal, sys
from qpavoid import __main__ as cli

signal.signal(signal.SIGINT, signal.default_int_handler)  # a parent in the background passes on that it is ignored
update = cli._update

def tell(bar, job, done, total):
    update(bar, job, done, total)
    if done == 50:
        print("under way", file=sys.stderr, flush=True)

cli._update = tell
sys.argv = ["qpavoid", "run", "situation1", "--set", "duration=1000", "--no-figures", "--json"]
cli.main()
"""


@pytest.mark.skipif(os.name != "posix", reason="signals")
@pytest.mark.parametrize("signum", [signal.SIGINT, signal.SIGTERM])
def test_signal_leaves_a_log_of_what_was_done(tmp_path, signum):
    with subprocess.Popen(
        [sys.executable, "-c", LONG_RUN], cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as child:
        assert child.stderr.readline() == "under way\n"
        child.send_signal(signum)
        stdout, stderr = child.communicate(timeout=300)
    assert child.returncode == 1
    assert "Traceback" not in stderr
    assert "broken off" in stderr
    document = json.loads(stdout)
    assert document["completed"] is False
    log = Log.load(tmp_path / document["files"][0])
    assert 50 <= len(log.t) < 100_000
    assert log.meta["completed"] is False
