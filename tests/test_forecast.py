"""Forecasts are what the law then does, and change nothing where it arrives; where it does not, a faster drive does."""

import numpy as np
import pytest

from qpavoid import (
    Controller,
    Limits,
    Obstacle,
    Robot,
    Sample,
    ScenarioConfig,
    Status,
    build_scene,
    build_tasks,
    config,
    load_scenario,
    simulate,
)
from qpavoid.config import Planning
from qpavoid.config.control import FastFinish
from qpavoid.control.scenario import build_parts
from qpavoid.control.settings import ControlSettings
from qpavoid.planning.drive import TRACK
from qpavoid.planning.forecast import MAX_SPREAD, Forecaster, Snapshot
from qpavoid.reason import ReasonKind

TOO_FAR = (0.0, 0.3, 0.0)
"""Displacement of a target that appears at once [m]: with K = 2/s, 300 exp(-2) = 41 mm are left after a second, with
5/s, 2 mm."""


def make_forecaster(scenario):
    """Forecaster of a scenario, and the state in which it begins."""
    parts = build_parts(scenario)
    bounds = parts.scene.robot.bounds().within(scenario.limits)
    avoidance = scenario.avoidance.model_copy(update={"backup": not scenario.contacts})
    settings = ControlSettings(parts.scene, bounds, avoidance, scenario.limits, scenario.dt)
    forecaster = Forecaster(settings, parts.tasks, parts.contacts, scenario.solver, Planning())
    zero = np.zeros(parts.scene.robot.model.nv)
    return forecaster, Snapshot(0.0, parts.q0, zero, zero, TRACK, (), np.zeros((0, 18)), {}, {})


def forecast(scenario):
    """Forecast of a scenario from its start, until its end."""
    forecaster, start = make_forecaster(scenario)
    return forecaster.run(start, scenario.duration)


@pytest.mark.parametrize(
    ("name", "limits"),
    [
        ("situation1", Limits()),
        ("panda_ball", Limits()),
        ("panda_line", Limits(acceleration=10.0, jerk=500.0)),
        pytest.param("humanoid_reach", Limits(), marks=pytest.mark.slow),
    ],
)
def test_forecast_is_what_the_law_does(name, limits):
    """Bit for bit, with obstacles on known trajectories, jerk limits and contacts."""
    scenario = load_scenario(name).model_copy(update={"duration": 0.8, "limits": limits})
    log, ahead = simulate(scenario), forecast(scenario)
    assert ahead.q.tobytes() == log.q.tobytes()
    assert ahead.v[1:].tobytes() == log.v[:-1].tobytes()


def test_margin_of_obstacles_that_turn_grows_in_forecasts():
    """With it, the robot keeps farther from where they really are; the next forecast knows nothing of it."""
    forecaster, start = make_forecaster(load_scenario("chasing_sphere"))
    fist = forecaster.scene.obstacles[0]
    start = start._replace(obstacles=(fist.name,), states=fist.motion.sample(0.0).row[None].copy())
    without, wary = forecaster.run(start, 2.0), forecaster.run(start._replace(spread=0.1), 2.0)
    assert without.clearance[-1] > wary.clearance[-1] > without.clearance[-1] - MAX_SPREAD + 0.01
    assert forecaster.run(start, 2.0).q.tobytes() == without.q.tobytes()


def reaching(panda, **changes):
    """A controller whose target is 0.3 m away from the start on, with a ball beside it, to be reached in 1.2 s."""
    motion = config.Line(displacement=TOO_FAR, speed=1e3)
    task = config.Task(frame="panda_hand_tcp", motion=motion)
    planning = Planning(**{"settle": 1.2, "lead": 0.1, "clearances": [], **changes})
    scene = build_scene(panda, [Obstacle.at("ball", config.Sphere(radius=0.05), [0.307, 0.4, 0.487])])
    limits = Limits(acceleration=10.0)
    return Controller(scene, build_tasks([task], panda, panda.home), limits=limits, planning=planning)


def run(controller, q, duration, **arguments):
    """Positions of the tool (N, 3) and solutions of a loop."""
    tool, solutions = [], []
    for k in range(round(duration / controller.dt)):
        tick = controller.tick(q, k * controller.dt, **arguments)
        tool.append(tick.kinematics.position[0].copy())
        solutions.append(tick.solution)
        q = q + controller.dt * tick.solution.v
    return np.array(tool), solutions


def test_late_law_is_hurried(panda):
    """The drive begins after its lead, says why, and the tool is there in time."""
    tool, solutions = run(reaching(panda), panda.home, 1.2)
    assert np.linalg.norm(tool[0] + TOO_FAR - tool[-1]) < 0.005
    plans = [solution.plan for solution in solutions]
    assert not any(plans[:10]) and all(plans[10:])
    assert plans[10].startswith("fast finish since 0.10 s: the present drive would end ")
    assert all(solution.status is Status.SOLVED for solution in solutions)


def test_end_of_a_run_is_the_deadline_of_its_forecasts(panda):
    """The law would settle in time, but not before the run ends, which is when goals count; so it is hurried."""
    tool, solutions = run(reaching(panda, settle=4.0, deadline=1.2), panda.home, 1.2)
    assert np.linalg.norm(tool[0] + TOO_FAR - tool[-1]) < 0.005
    assert solutions[-1].plan.startswith("fast finish")
    scenario = load_scenario("situation1").model_copy(update={"planning": Planning()})
    assert scenario.planning_in_time.deadline == scenario.duration
    own = scenario.model_copy(update={"planning": Planning(deadline=0.7)})
    assert own.planning_in_time.deadline == 0.7


def test_deadline_that_has_passed_is_none(panda):
    """Nothing arrives until then; from then on, what counts is the time that targets have after their motion."""
    _, solutions = run(reaching(panda, settle=1.2, deadline=0.1), panda.home, 1.0)
    assert not any(solution.plan for solution in solutions[:10])
    assert solutions[60].plan.startswith("fast finish")


def test_fast_finish_keeps_limits_and_safety_distance(panda):
    """Dampers let the tool close faster, and no nearer to the ball than the safety distance."""
    controller = reaching(panda)
    nearest, v, q = np.inf, [np.zeros(7)], panda.home
    for k in range(150):
        tick = controller.tick(q, k * controller.dt)
        nearest = min(nearest, tick.problem.avoidance.d.min(initial=np.inf))
        v.append(tick.solution.v)
        q = q + controller.dt * tick.solution.v
    bounds = panda.bounds().within(controller.limits)
    assert 0.0 < nearest - controller.avoidance.d1 < 1e-3
    assert (np.abs(np.diff(v, axis=0)) <= bounds.acceleration * controller.dt + 1e-9).all()


def test_without_fast_finish_nothing_is_followed(panda):
    tool, solutions = run(reaching(panda, fast=None), panda.home, 1.2)
    assert not any(solution.plan for solution in solutions)
    assert np.linalg.norm(tool[0] + TOO_FAR - tool[-1]) > 0.02


def test_where_the_law_arrives_commands_are_those_of_the_law(panda):
    """Bit for bit: what is forecast changes nothing."""
    planned, alone = reaching(panda, settle=4.0), reaching(panda, fast=None)
    _, solutions = run(planned, panda.home, 4.0)
    _, of_law = run(alone, panda.home, 4.0)
    assert [solution.v.tobytes() for solution in solutions] == [solution.v.tobytes() for solution in of_law]


def test_target_that_jumps_is_looked_at_anew(panda):
    """A program gives another target: what was forecast is not what comes."""
    task = config.Task(frame="panda_hand_tcp")
    controller = Controller(
        build_scene(panda), build_tasks([task], panda, panda.home), planning=Planning(settle=1.2, lead=0.1)
    )
    start = controller.tick(panda.home, 0.0).kinematics.position[0].copy()
    _, before = run(controller, panda.home, 1.0)
    goal = Sample.at(start + TOO_FAR, np.diag([1.0, -1.0, -1.0]))
    solutions = [controller.step(panda.home, 1.0 + 0.01 * k, {"panda_hand_tcp": goal}) for k in range(60)]
    assert not any(solution.plan for solution in before)
    assert solutions[-1].plan


def test_reset_and_filter_drop_the_plan(panda):
    controller = reaching(panda)
    run(controller, panda.home, 0.2)
    assert controller.step(panda.home, 0.2).plan
    assert not controller.filter(panda.home, np.zeros(7), 0.21).plan
    assert not controller.step(panda.home, 0.22).plan
    controller.reset()
    assert not controller.step(panda.home, 0.0).plan


def test_excluded_laws_are_named(panda):
    tasks = build_tasks([config.Task(frame="panda_hand_tcp")], panda, panda.home)
    controller = Controller(build_scene(panda), tasks, "eq10", planning=Planning())
    (reason,) = controller.step(panda.home).assumptions
    assert (reason.kind, reason.subject) == (ReasonKind.NO_PLAN, ("solver",))
    controller = Controller(build_scene(panda), (), "qp", planning=Planning(fast=FastFinish(gain=3.0)))
    assert controller.step(panda.home).assumptions[0].subject == ("tasks",)


def test_paths_attain_poses_of_frames_and_between_them():
    """What a path leads to is where tasks want frames, in the axes of another one if they are seen from it."""
    left, right = Robot.load("baxter").end_effectors[:2]
    tasks = [
        {"frame": left, "motion": {"type": "line", "displacement": [0.0, 0.1, 0.0], "speed": 0.1}},
        {"type": "relative", "frame": right, "relative_to": left},
    ]
    scenario = ScenarioConfig.model_validate({"robot": "baxter", "duration": 1.0, "tasks": tasks})
    forecaster, start = make_forecaster(scenario)
    first, last = (forecaster.targets_at(start, t) for t in (0.0, 5.0))
    assert set(last) == {left, (right, left)}
    np.testing.assert_allclose(last[left] - first[left], [0.0, 0.1, 0.0], atol=1e-12)
    assert np.array_equal(last[right, left].position, first[right, left].position)


def test_paths_refuse_a_centre_of_mass_by_name(panda):
    tasks = build_tasks([config.Task(frame="panda_hand_tcp"), config.ComTask(axes="xy")], panda, panda.home)
    controller = Controller(build_scene(panda), tasks, planning=Planning())
    (reason,) = controller.step(panda.home).assumptions
    assert reason.kind is ReasonKind.NO_PLAN
    assert "centre of mass" in str(reason)
