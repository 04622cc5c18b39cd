"""`qpavoid bench grasps`: problems of a file as scenes, and the clearance of their configurations."""

import json
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from typer.testing import CliRunner

from qpavoid import ConfigError, Obstacle, Robot
from qpavoid.config import Sphere
from qpavoid_bench.arena.commands import app
from qpavoid_bench.grasps.clearance import measure
from qpavoid_bench.grasps.closed_loop import ENTRANTS, run_grasp
from qpavoid_bench.grasps.problems import load_problems

START = {"panda_joint2": -0.785, "panda_joint4": -2.356, "panda_joint6": 1.571, "panda_finger_joint1": 0.065}
GOAL = {"panda_joint1": 0.3, "panda_joint2": 0.2, "panda_joint4": -2.0, "panda_joint6": 2.2}
BALL = {"name": "ball", "shape": {"type": "sphere", "radius": 0.05}, "position": [2.0, 0.0, 0.5], "rpy": [0, 0, 0]}


@pytest.fixture
def problem_set(tmp_path):
    """Write problems that differ in their obstacle."""

    def write(*obstacles):
        problems = [
            {"index": k, "obstacles": [obstacle], "start": START, "goal": GOAL} for k, obstacle in enumerate(obstacles)
        ]
        (tmp_path / "motionbenchmaker.json").write_text(json.dumps({"panda": {"ball": problems}}))
        return tmp_path

    return write


def test_problem_is_a_scene_with_start_and_goal(problem_set):
    (problem,) = load_problems(problem_set(BALL))
    panda = Robot.load("panda")
    assert (problem.name, problem.scene.obstacle_names) == ("panda/ball/0", ["ball"])
    for q, values in ((problem.q_start, START), (problem.q_goal, GOAL)):
        known = {joint: x for joint, x in values.items() if "finger" not in joint}  # locked by the shipped robot
        assert dict(zip(panda.joint_names, q, strict=True)).items() >= known.items()
    data = panda.model.createData()
    pin.framesForwardKinematics(panda.model, data, problem.q_goal)
    (frame,) = panda.end_effectors
    place = data.oMf[panda.model.getFrameId(frame)]
    np.testing.assert_allclose(problem.goal_poses[frame].position, place.translation, atol=1e-12)
    np.testing.assert_allclose(problem.goal_poses[frame].rotation, place.rotation, atol=1e-12)


def test_clearance_is_that_of_the_nearest_pair(problem_set):
    """A ball below the tool, as far along its axis as leaves 4 mm; then 1 mm."""
    (far,) = load_problems(problem_set(BALL))
    tool = far.goal_poses["panda_hand_tcp"]

    def beside(gap):
        low, high = 0.0, 1.0
        for _ in range(30):
            height = 0.5 * (low + high)
            at = np.asarray(tool.position) + height * np.asarray(tool.rotation)[:, 2]
            obstacle = Obstacle.at("ball", Sphere(radius=0.05), at)
            _, found = measure(replace(far, obstacles=(obstacle,)))
            low, high = (low, height) if found.distance > gap else (height, high)
        return found

    clear, near = beside(0.004), beside(0.001)
    assert clear.distance == pytest.approx(0.004, abs=1e-6) and clear.is_clear
    assert near.distance == pytest.approx(0.001, abs=1e-6) and not near.is_clear
    assert near.pair[1] == "ball"


def test_command_counts_what_is_clear(problem_set, tmp_path):
    at = list(map(float, load_problems(problem_set(BALL))[0].goal_poses["panda_hand_tcp"].position))
    folder = problem_set(BALL, {**BALL, "position": at})
    done = CliRunner().invoke(app, ["grasps", "--data", str(folder), "--out", str(tmp_path)])
    assert done.exit_code == 0
    row = next(line for line in (tmp_path / "grasps.md").read_text().splitlines() if line.startswith("| panda/ball |"))
    cells = [cell.strip() for cell in row.strip("|").split("|")]
    assert cells[1:3] == ["2", "2"] and cells[4] == "1" and cells[-1].endswith(" - ball") and float(cells[5]) < 0.0


@pytest.mark.parametrize("content", [None, "[]", "{", '{"panda": {"x": [{"index": 1}]}}'])
def test_what_is_no_problem_set_is_said_in_one_line(tmp_path, content):
    if content is not None:
        (tmp_path / "motionbenchmaker.json").write_text(content)
    with pytest.raises(ConfigError, match="problem set") as error:
        load_problems(tmp_path)
    assert "\n" not in str(error.value)


def test_closed_loop_reaches_the_pose_without_contact(problem_set):
    """With nothing in the way the law arrives; a hand that is held off by a ball at its goal does not."""
    (free,) = load_problems(problem_set(BALL))
    result = run_grasp(free, ENTRANTS[0])
    assert result.is_success and result.distance <= 1e-3 and 0.0 < result.time < 6.0
    assert result.excess <= 1e-9 and result.clearance > 0.0
    at = list(map(float, free.goal_poses["panda_hand_tcp"].position))
    (blocked,) = load_problems(problem_set({**BALL, "position": at}))
    result = run_grasp(blocked, ENTRANTS[0])
    assert result.is_clear and not result.is_reached and np.isnan(result.time)
    assert result.distance > 0.005
