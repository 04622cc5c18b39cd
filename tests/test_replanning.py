"""What plans promise in a closed loop: nothing changes where the law arrives, and the rest costs the plan alone."""

import numpy as np
import pytest
from closed_loop import Awaited

from qpavoid import Controller, Obstacle, Points, Sample, build_scene, build_tasks, kernels, simulate
from qpavoid.config import Box, Capsule, Planning, PointCloud, Sphere, Task
from qpavoid.planning import worker
from qpavoid.viz.compare import path_figure, solver_styles
from qpavoid_bench.arena.entrants import ENTRANTS
from qpavoid_bench.arena.families import load_family, make_case
from qpavoid_bench.arena.rollout import roll_out
from qpavoid_bench.arena.trial import run_trial
from qpavoid_bench.arena.world import build_world

LATE = (
    ("situation2", (4,)),
    ("random_walk", (0, 7, 8, 9, 11)),
    ("noisy_sensor", (7, 8)),
    ("chasing", (2,)),
    ("head_on", (6,)),
)
"""Cases of the suite `full` with obstacles that move in which `qp` does not arrive."""


def roll(case, entrant="qp-planning"):
    """Rollout of a case by an entrant of the arena."""
    world = build_world(case.scenario)
    return roll_out(case, ENTRANTS[entrant].start(case, world), world)


@pytest.mark.parametrize(
    ("family", "seed"),
    [
        ("passing", 1),
        ("sphere_field", 7),
        ("crossing_arms", 3),
        ("shelf", 2),
        pytest.param("head_on", 3, marks=pytest.mark.slow),
        pytest.param("crossing", 3, marks=pytest.mark.slow),
        pytest.param("noisy_sensor", 3, marks=pytest.mark.slow),
        pytest.param("chasing", 11, marks=pytest.mark.slow),
    ],
)
def test_where_the_law_arrives_commands_are_those_of_the_law(family, seed):
    """Bit for bit, with hulls, whose distances start from those of the step before, too."""
    case = make_case(load_family(family), seed)
    assert roll(case).v.tobytes() == roll(case, "qp").v.tobytes()


def test_logs_and_figures_have_the_forecast_that_a_plan_avoids():
    """It is where the law alone ends; the views of the figure show all of both runs."""
    law = make_case(load_family("shelf"), 1).scenario
    logs = [simulate(law), simulate(law.model_copy(update={"planning": Planning(settle=3.0)}))]
    (forecast,), alone, planned = logs[1].meta["forecasts"], logs[0].tool, logs[1].tool
    assert forecast["t"] == logs[1].t[logs[1].planned][0]
    paths = np.array(forecast["tools"])
    np.testing.assert_allclose(paths[:, -1], alone[-1], atol=1e-3)
    assert np.linalg.norm(alone[-1] - logs[1].target[-1]) > 0.1
    figure = path_figure(logs, solver_styles(logs))
    figure.canvas.draw()
    assert "forecast without the plan" in [line.get_label() for line in figure.axes[0].get_lines()]
    for ax in figure.axes:
        vertical, (low, high) = "xyz".index(ax.get_ylabel()[0]), ax.get_ylim()
        assert low < min(alone[..., vertical].min(), planned[..., vertical].min())
        assert high > max(alone[..., vertical].max(), planned[..., vertical].max())


class Counted(worker.InlineWorker):
    """A worker that counts the looks, and keeps their times."""

    looks, times = 0, []

    def ask(self, question):
        super().ask(question)
        type(self).looks += 1
        self.times.append(question.start.t)


class Slow(worker.InlineWorker):
    """A worker whose answers are two seconds late."""

    steps = 0

    def poll(self):
        answer, self.steps = None, self.steps + (self._answer is not None)
        if self.steps > 200:
            answer, self.steps = super().poll(), 0
        return answer


def test_obstacle_that_turns_is_looked_at_at_once(panda, monkeypatch):
    """Looks are periodic while a ball goes straight on; two steps after it has turned, there is one."""
    monkeypatch.setattr(Counted, "times", [])
    monkeypatch.setattr(worker, "InlineWorker", Counted)
    scene = build_scene(panda, [Obstacle.at("ball", Sphere(radius=0.05), [0.9, 0.0, 0.9], external=True)])
    tasks = build_tasks([Task(frame="panda_hand_tcp")], panda, panda.home)
    controller = Controller(scene, tasks, planning=Planning(settle=0.5, clearances=[], fast=None))
    position, velocity = np.array([0.9, -0.3, 0.9]), np.array([0.0, 0.2, 0.0])
    for k in range(120):
        if k == 90:
            velocity = np.array([0.0, 0.0, 0.2])
        ball = Sample.at(position, np.eye(3), linear=velocity)
        controller.step(panda.home, 0.01 * k, obstacles={"ball": ball})
        position = position + 0.01 * velocity
    np.testing.assert_allclose(Counted.times, [0.0, 0.4, 0.8, 0.9], atol=0.021)


@pytest.mark.parametrize(("noise", "is_noisy"), [(0.0, False), (0.04, True)])
def test_velocities_that_differ_in_every_step_are_no_base_for_plans(noise, is_noisy, panda, monkeypatch):
    """Positions are exact: where velocities lead within a period is what counts. One turn is no noise."""
    asked = []

    class Recorded(worker.InlineWorker):
        def ask(self, question):
            super().ask(question)
            asked.append(question.is_noisy)

    monkeypatch.setattr(worker, "InlineWorker", Recorded)
    scene = build_scene(panda, [Obstacle.at("ball", Sphere(radius=0.05), [0.9, 0.0, 0.9], external=True)])
    tasks = build_tasks([Task(frame="panda_hand_tcp")], panda, panda.home)
    controller = Controller(scene, tasks, planning=Planning(settle=0.5, clearances=[], fast=None))
    position, velocity, random = np.array([0.9, -0.3, 0.9]), np.array([0.0, 0.2, 0.0]), np.random.default_rng(0)
    for k in range(130):
        if k == 90:
            velocity = np.array([0.0, 0.0, 0.2])
        seen = Sample.at(position, np.eye(3), linear=velocity + noise * random.normal(size=3))
        controller.step(panda.home, 0.01 * k, obstacles={"ball": seen})
        position = position + 0.01 * velocity
    assert asked[0] and len(asked) > 3  # nothing is known of the first one yet
    assert set(asked[1:]) == {is_noisy}


def test_where_nothing_is_planned_few_steps_are_compared_with_the_forecast(panda, monkeypatch):
    """The forecast arrives, and obstacles rest: in a second, every fifth step is compared, and not every one."""
    compared = []
    compare = kernels.strays
    monkeypatch.setattr(kernels, "strays", lambda *x: compared.append(x[2]) or compare(*x))
    scene = build_scene(panda, [Obstacle.at("ball", Sphere(radius=0.05), [0.9, 0.0, 0.9])])
    tasks = build_tasks([Task(frame="panda_hand_tcp")], panda, panda.home)
    controller = Controller(scene, tasks, planning=Planning(settle=2.0))
    compared.clear()
    for k in range(150):
        controller.step(panda.home, 0.01 * k)
    assert 10 <= len(compared) <= 30


def test_answer_that_is_two_seconds_late_changes_nothing(monkeypatch):
    """Commands are those of the law, bit for bit, while it is awaited, and what comes too late is not followed."""
    case = make_case(load_family("shelf"), 1)
    of_law = roll(case, "qp").v
    monkeypatch.setattr(worker, "InlineWorker", Slow)
    late = roll(case).v
    assert late[:200].tobytes() == of_law[:200].tobytes()
    assert np.isfinite(late).all()


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow), pytest.param(2, marks=pytest.mark.slow)])
def test_robot_comes_to_rest_where_the_goal_is_out_of_reach(seed, monkeypatch):
    """Without contact, and with ever fewer looks: 8 at most in 10 s."""
    monkeypatch.setattr(Counted, "looks", 0)
    monkeypatch.setattr(worker, "InlineWorker", Counted)
    case = make_case(load_family("unreachable"), seed)
    result = run_trial(case, ENTRANTS["qp-planning"])
    assert result.success
    assert 1 <= Counted.looks <= 8 * max(1.0, case.scenario.duration / 10.0)


@pytest.mark.slow
def test_among_obstacles_that_move_most_of_what_the_law_fails_at_arrives():
    results = [run_trial(make_case(load_family(f), s), ENTRANTS["qp-planning"]) for f, seeds in LATE for s in seeds]
    assert sum(result.success for result in results) >= 6
    assert sum(result.collided for result in results) <= 1


WALL = np.array([[x, 0.2, z] for x in np.arange(0.15, 0.75, 0.02) for z in np.arange(0.2, 0.75, 0.02)])
"""A board of points between a Panda's tool and where it should go [m]."""


def beside_a_cloud(panda, **planning):
    """A controller whose tool should go to the other side of what a camera sees, and its target."""
    scene = build_scene(panda, [Obstacle.at("camera", PointCloud(resolution=0.02), [0, 0, 0], external=True)])
    tasks = build_tasks([Task(frame="panda_hand_tcp", type="position")], panda, panda.home)
    return Controller(scene, tasks, planning=Planning(settle=4.0, **planning))


def drive(controller, q, steps, targets, points):
    """Solutions of a loop that is given a picture at every tenth step, and where the tool is at its end [m]."""
    solutions = []
    for k in range(steps):
        picture = {"camera": Points(points, at_rest=True)} if k % 10 == 0 else None
        tick = controller.tick(q, k * controller.dt, targets, picture)
        solutions.append(tick.solution)
        q = q + controller.dt * tick.solution.v
    return solutions, tick.kinematics.position[0].copy(), q


@pytest.mark.slow
def test_points_of_a_camera_are_in_forecasts(panda):
    """The law is stopped by a board of points; that is forecast, and a path leads around it."""
    target = {"panda_hand_tcp": Sample.at([0.45, 0.4, 0.5], np.eye(3))}
    _, tool, _ = drive(beside_a_cloud(panda, fast=None, clearances=[]), panda.home, 400, target, WALL)
    assert np.linalg.norm(tool - target["panda_hand_tcp"].position) > 0.05
    solutions, tool, _ = drive(beside_a_cloud(panda), panda.home, 400, target, WALL)
    (plan,) = {solution.plan for solution in solutions} - {""}
    assert plan.startswith("path from ") and "camera" in plan
    assert np.linalg.norm(tool - target["panda_hand_tcp"].position) < 5e-3


@pytest.mark.slow
def test_process_knows_what_is_attached_and_may_touch(panda, monkeypatch):
    """A stick in the hand is part of the robot there: a loop that waits for answers does what the step would do."""
    stick = Obstacle.at("stick", Capsule(radius=0.01, length=0.3), [0.307, 0.0, 0.487], graspable=True)
    board = Obstacle.at("board", Box(size=(0.3, 0.02, 0.5)), [0.45, 0.22, 0.5])
    answers = {}
    for name in ("inline", "process"):
        monkeypatch.setattr(worker, "ProcessWorker", Awaited)
        tasks = build_tasks([Task(frame="panda_hand_tcp", type="position")], panda, panda.home)
        controller = Controller(build_scene(panda, [stick, board]), tasks, planning=Planning(settle=4.0, worker=name))
        controller.allow_contact("stick", ["panda_hand_0", "panda_leftfinger_0", "panda_rightfinger_0"])
        controller.attach("stick", "panda_hand_tcp", panda.home)
        q, solutions = panda.home, []
        target = {"panda_hand_tcp": Sample.at([0.45, 0.45, 0.5], np.eye(3))}
        for k in range(150):
            solutions.append(controller.step(q, k * controller.dt, target))
            q = q + controller.dt * solutions[-1].v
        answers[name] = [solution.v.tobytes() for solution in solutions], [solution.plan for solution in solutions]
    assert answers["inline"] == answers["process"]
    assert any(answers["inline"][1])
