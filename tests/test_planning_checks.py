"""Paths of the planner seen by others: coal along those of a public problem set, OMPL in scenes of both."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from test_planning import Checker, samples, shelf

from qpavoid import Planner, PlannerSettings, Robot, build_scene, plan_to
from qpavoid_bench.arena.families import load_family, make_case
from qpavoid_bench.arena.world import build_world, surface_safety_distance
from qpavoid_bench.grasps.problems import load_problems

DATA = Path(__file__).parents[2] / "shared" / "data"
REQUIRED, ROUND_OFF = 2e-3, 1e-6
"""Distance that paths keep, and what distances by two programs may differ by [m]."""


@pytest.mark.skipif(not (DATA / "motionbenchmaker.json").is_file(), reason="the problem set is not beside the checkout")
@pytest.mark.parametrize("part", [0, *(pytest.param(part, marks=pytest.mark.slow) for part in range(1, 20))])
def test_paths_to_public_grasps_are_clear_by_coal(part):
    """Every 5 mm of travel, each pair has the required distance, or what it has at the start less 1 mm."""
    for problem in load_problems(DATA)[part::67]:
        path = plan_to(problem.scene, problem.q_start, problem.q_goal, settings=PlannerSettings(REQUIRED))
        assert path, (problem.name, path.reason)
        checker, scene = Checker(problem.scene), problem.scene
        allowance = scene.distance_allowance(REQUIRED)[np.any(scene.support != 0.0, axis=1)]
        needed = np.minimum(REQUIRED - allowance, checker.distances(problem.q_start) - 1e-3) - ROUND_OFF
        for q in samples(checker, path):
            assert (checker.distances(q) >= needed).all(), problem.name


@pytest.mark.slow
def test_plans_of_static_cases_of_the_arena_are_clear_by_coal():
    """From the start to where each task's frame should be at the end: of 72, 70 are found; every 5 mm, coal agrees."""
    found = 0
    for family in ("box", "shelf", "narrow_gap", "sphere_field", "window", "crossing_arms"):
        for seed in range(12):
            case = make_case(load_family(family), seed)
            world, d1 = build_world(case.scenario), surface_safety_distance(case.scenario)
            ends = {task.settings.frame: task.motion.sample(case.scenario.duration) for task in world.tools}
            targets = {task.settings.frame: task.turns for task in world.tools}
            targets = {frame: ends[frame] if turns else ends[frame].position for frame, turns in targets.items()}
            path = plan_to(world.scene, world.q0, targets=targets, settings=PlannerSettings(d1))
            if not path:
                continue
            found += 1
            checker, is_movable = Checker(world.scene), np.any(world.scene.support != 0.0, axis=1)
            needed = d1 - world.scene.distance_allowance(d1)[is_movable]
            needed = np.minimum(needed, checker.distances(path.q[0]) - 1e-3) - ROUND_OFF
            for q in samples(checker, path):
                assert (checker.distances(q) >= needed).all(), (family, seed)
    assert found >= 70


@pytest.mark.parametrize("seed", range(3))
def test_ompl_agrees_that_there_is_a_path(seed):
    """Its RRT-Connect, with coal as checker, finds one between the same configurations, and takes ours for valid."""
    base, geometric = pytest.importorskip("ompl.base"), pytest.importorskip("ompl.geometric")
    robot, d1 = Robot.load("panda"), 0.02
    scene, bounds = build_scene(robot, shelf()), robot.bounds()
    checker = Checker(scene)
    ours = Planner(scene, PlannerSettings(d1)).plan(robot.home, targets={"panda_hand_tcp": [0.5, 0.3, 0.75]}, seed=seed)
    assert ours, ours.reason
    allowance = scene.distance_allowance(d1)[np.any(scene.support != 0.0, axis=1)]
    needed = np.minimum(d1 - allowance, checker.distances(robot.home) - 1e-3) - ROUND_OFF
    space, box = base.RealVectorStateSpace(7), base.RealVectorBounds(7)
    for i, (low, high) in enumerate(zip(bounds.lower, bounds.upper, strict=True)):
        box.setLow(i, float(low))
        box.setHigh(i, float(high))
    space.setBounds(box)
    setup = geometric.SimpleSetup(space)

    def is_valid(state):
        return bool((checker.distances(np.array([state[i] for i in range(7)])) >= needed).all())

    def state_at(q):
        state = space.allocState()
        for i, x in enumerate(q):
            state[i] = float(x)
        return state

    setup.setStateValidityChecker(is_valid)
    setup.getSpaceInformation().setStateValidityCheckingResolution(0.01)
    setup.setPlanner(geometric.RRTConnect(setup.getSpaceInformation()))
    setup.setStartAndGoalStates(state_at(ours.q[0]), state_at(ours.q[-1]))
    setup.setup()
    states = [state_at(q) for q in ours.q]
    assert all(setup.getSpaceInformation().checkMotion(a, b) for a, b in pairwise(states))
    assert setup.solve(20.0)
    assert setup.haveExactSolutionPath()
