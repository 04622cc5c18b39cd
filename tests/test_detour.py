"""The search for a detour is bounded: its end is reported, the robot rests, and a change begins a new one."""

from itertools import pairwise

import numpy as np
import pinocchio as pin
import pytest
from closed_loop import cartesian, drive, make_controller
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from qpavoid import Avoidance, Obstacle, ReasonKind, Robot, Sample
from qpavoid.config import Box, Detour, Progress, Sphere
from qpavoid.safety.reachability import arm, target_violation

DT, SAFE, RADIUS = 0.01, 0.03, 0.05
QUICK = {"speed": 0.2, "longest": 2.0, "patience": 20.0}


def loop(
    folder, obstacles, goal, seconds, detour=None, updates=None, axes="xyz", acceleration=None, start=(0.0, 0.0, 0.0)
):
    """Controller, positions (N, 3) of a Cartesian tool with the radius 0.05, and `stalled` of each step."""
    controller = make_controller(
        cartesian(folder, axes, acceleration=acceleration), obstacles, axes[-1], dt=DT,
        avoidance=Avoidance(d1=SAFE, d2=0.12), progress=Progress(detour=detour or Detour(**QUICK)),
        task={"max_speed": 0.3},
    )  # fmt: skip
    q, reported, least = [], [], np.inf
    target = goal if callable(goal) else np.array(goal)
    for tick in drive(controller, np.array(start), round(seconds / DT), target=target, obstacles=updates):
        q.append(tick.state.q)
        reported.append(tick.solution.stalled)
        least = min(least, tick.proximity.distance.min(initial=np.inf))
    assert least > SAFE - 1e-3
    return controller, np.array(q), reported


ENDED = ReasonKind.DETOUR_ENDED, ReasonKind.OUT_OF_REACH, ReasonKind.TARGET_OBSTRUCTED


def search_ends(reported):
    """Step and reason of each end of a search; reason None where a new one begins."""
    found = [next((reason for reason in reasons if reason.kind in ENDED), None) for reasons in reported]
    return [(k, reason) for k, reason in enumerate(found) if reason != (found[k - 1] if k else None)]


def stalls(reported):
    """Number of stalls until the search ended: before each detour, and before its end."""
    stalled = [any(reason.kind is ReasonKind.STALLED for reason in reasons) for reasons in reported]
    return sum(now and not before for before, now in pairwise([False, *stalled]))


def closed_box(inner=0.3, thick=0.05, at=(0.6, 0.0, 0.0)):
    """Six plates around a goal; the tool fits in, but there is no door. Nothing about the goal itself proves that."""
    plates, offset = [], inner / 2 + thick / 2
    for axis in range(3):
        for side in (-1.0, 1.0):
            size, place = np.full(3, inner + 2 * thick), np.array(at)
            size[axis] = thick
            place[axis] += side * offset
            plates.append(Obstacle.at(f"{'xyz'[axis]}{'-+'[side > 0]}", Box(size=tuple(size)), place))
    return plates


def wall(size=3.0, at=(0.3, 0.0, 0.0)):
    return [Obstacle.at("wall", Box(size=(0.05, size, size)), at)]


def test_search_ends_after_all_detours_and_the_robot_rests(tmp_path):
    """No try brings the tool nearer, whichever plate it meets: another plate is no reason for a new search."""
    _, q, reported = loop(tmp_path, closed_box(), (0.6, 0.0, 0.0), 40.0)
    ((tick, reason),) = search_ends(reported)
    assert (reason.kind, reason.subject, reason.unit) == (ReasonKind.DETOUR_ENDED, ("z",), "s")
    assert stalls(reported) == 4 + 1
    assert 4 * 1.0 < reason.amount < tick * DT
    assert tick * DT < 3.0 + 4 * (2.0 + 1.0 + 4.0)  # there; each detour, back, and stalled
    assert all(reasons[0] == reason for reasons in reported[tick:])
    assert any(reason.kind is ReasonKind.STALLED for reason in reported[-1])
    assert np.abs(q[-1] - q[-500]).max() < 1e-3 and np.abs(q[-1] - q[-1000]).max() < 5e-3
    np.testing.assert_allclose(np.linalg.norm(q[-1] - [0.6, 0.0, 0.0]), 0.2 + RADIUS + SAFE, atol=0.01)  # at a plate


def test_search_ends_at_an_endless_wall_within_the_default_bounds(tmp_path):
    config = Detour()
    _, q, reported = loop(tmp_path, wall(20.0), (0.6, 0.0, 0.0), 60.0, config)
    ((tick, reason),) = search_ends(reported)
    assert (reason.kind, reason.subject) == (ReasonKind.DETOUR_ENDED, ("z",))
    assert stalls(reported) == 2 + 1  # as long on one side as on the other
    assert config.patience < reason.amount < tick * DT
    assert config.patience < tick * DT < config.patience + 15.0  # and back
    assert np.abs(q[-1] - q[-100]).max() < 1e-3


@settings(max_examples=5, deadline=None, phases=[Phase.explicit, Phase.generate])
@given(tries=st.integers(1, 4), longest=st.floats(0.5, 2.0), patience=st.floats(0.5, 9.0))
def test_search_keeps_any_bounds(tmp_path_factory, tries, longest, patience):
    config = Detour(speed=0.2, longest=longest, tries=tries, patience=patience)
    _, _, reported = loop(tmp_path_factory.mktemp("robot"), wall(20.0), (0.6, 0.0, 0.0), 30.0, config)
    ((_, reason),) = search_ends(reported)
    detours, seconds = stalls(reported) - 1, reason.amount
    assert reason.kind is ReasonKind.DETOUR_ENDED
    assert detours <= tries and seconds < min(patience, tries * (longest + 8.0)) + 8.0  # and back
    assert detours == tries or seconds > patience


def test_search_is_renewed_when_the_tool_comes_nearer(tmp_path):
    """Three plates in a row, each across the path, with only one detour to try for each."""
    plates = [
        Obstacle.at(f"plate{i}", Box(size=(0.05, 0.4, 0.4)), [x, 0.0, 0.0]) for i, x in enumerate((0.4, 1.2, 2.0))
    ]
    _, q, reported = loop(tmp_path, plates, (2.5, 0.0, 0.0), 40.0, Detour(tries=1))
    assert np.linalg.norm(q[-1] - [2.5, 0.0, 0.0]) < 1e-3
    stopped = {(reason.kind, reason.subject) for reasons in reported for reason in reasons}
    assert stopped == {(ReasonKind.STALLED, ("tool", f"plate{i}")) for i in range(3)}


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_search_tries_the_other_side(tmp_path, side):
    """On a plane: a wall that ends on one side only, in a corner on the other."""
    walls = [
        Obstacle.at("wall", Box(size=(0.05, 1.0, 1.0)), [0.3, 0.3 * side, 0.0]),
        Obstacle.at("corner", Box(size=(1.0, 0.05, 1.0)), [-0.1, 0.8 * side, 0.0]),
    ]
    _, q, reported = loop(tmp_path, walls, (0.6, 0.1 * side, 0.0), 30.0, axes="xy", start=(0.0, 0.1 * side))
    assert np.linalg.norm(q[-1] - [0.6, 0.1 * side]) < 1e-3 and reported[-1] == ()


@pytest.mark.parametrize("change", ["goal", "wall", "reset", "jitter"])
def test_search_is_renewed_by_changes_above_the_thresholds_only(tmp_path, change):
    """After 20 s something changes, and detours are tried again."""
    random = np.random.default_rng(0)

    def updates(t):
        shift = 0.05 if change == "wall" and t > 20.0 else random.normal(0.0, 2e-3) if change == "jitter" else 0.0
        return {"wall": Sample.at([0.3, shift, 0.0])}

    def goal(t):
        return np.array(
            [0.6, 0.05 if change == "goal" and t > 20.0 else 0.01 * np.sin(0.3 * t) * (change == "jitter"), 0.0]
        )

    config = Detour(**QUICK, tries=2)
    controller, _, reported = loop(tmp_path, wall(20.0), goal, 20.0, config, updates)
    ((_, ended),) = search_ends(reported)
    assert ended is not None
    if change == "reset":
        controller.reset()
    ticks = list(drive(controller, np.array([0.2, 0.0, 0.0]), 2000, target=goal, obstacles=updates, start=2001))
    again = search_ends([(ended,)] + [tick.solution.stalled for tick in ticks])
    moved = np.ptp([tick.state.q for tick in ticks], axis=0)[1:].max()
    if change == "jitter":
        assert len(again) == 1 and moved < 0.05
    else:
        assert len(again) == 3 and again[1][1] is None and moved > 0.2


def test_no_search_for_a_goal_inside_an_obstacle(tmp_path):
    """The amount: the tool's sphere and its safety distance, about the goal, against the ball."""
    _, q, reported = loop(tmp_path, [Obstacle.at("ball", Sphere(radius=0.1), [0.3, 0.0, 0.0])], (0.37, 0.0, 0.0), 8.0)
    (_, reason), = search_ends(reported)  # fmt: skip
    # the frame is the tool's centre: some point of it would be as deep in the ball as the goal is
    assert (reason.kind, reason.subject, reason.unit) == (ReasonKind.TARGET_OBSTRUCTED, ("z", "ball"), "m")
    assert reason.amount == pytest.approx(0.1 - 0.07 + SAFE, abs=5e-6)
    assert np.abs(q[:, 1:]).max() < 1e-3 and np.abs(q[-1] - q[-200]).max() < 2e-3


def stand_off(folder):
    """A tool 0.25 m in front of the one body that it has."""
    cartesian(folder, acceleration=None)
    body = {"name": "tool", "frame": "z", "shape": {"type": "sphere", "radius": 0.05}, "position": [-0.25, 0.0, 0.0]}
    return Robot.from_urdf(folder / "cartesian.urdf", bodies=[body])


def test_goal_inside_an_obstacle_is_reached_by_a_frame_off_its_body(tmp_path):
    robot = stand_off(tmp_path)
    ball = Obstacle.at("ball", Sphere(radius=0.1), [0.3, 0.0, 0.0])
    controller = make_controller(robot, [ball], "z", progress=Progress(detour=Detour()), task={"max_speed": 0.3})
    ticks = list(drive(controller, np.zeros(3), 600, target=[0.3, 0.0, 0.0]))
    assert np.linalg.norm(ticks[-1].state.q - [0.3, 0.0, 0.0]) < 1e-3
    assert not any(tick.solution.stalled for tick in ticks)


@pytest.mark.parametrize("where", ["panda", "stand-off"])
def test_target_violation_is_zero_for_attained_poses(panda, tmp_path, where):
    """Wherever all bodies are as clear of a ball as they have to be, the position of the tool is no violation."""
    rng, name = np.random.default_rng(0), "panda_hand_tcp" if where == "panda" else "z"
    robot = panda if where == "panda" else stand_off(tmp_path)
    controller = make_controller(robot, [Obstacle.at("ball", Sphere(radius=0.1), [0.0, 0.0, 5.0])], name)
    tool, query, data, close = robot.frame_id(name, "test"), controller._query, robot.model.createData(), 0
    for _ in range(300):
        q = rng.uniform(robot.model.lowerPositionLimit, robot.model.upperPositionLimit)
        pin.framesForwardKinematics(robot.model, data, q)
        goal = data.oMf[tool].translation.copy()
        away = rng.normal(size=3)
        place = goal + rng.uniform(0.0, 0.25) * away / np.linalg.norm(away)
        near = controller.tick(q, 0.0, None, {"ball": Sample.at(place)}).proximity
        of_ball = controller.scene.obstacle_of[controller.scene.pairs[near.pair, 1]] == 0
        least = near.distance[of_ball].min(initial=0.1)  # no farther than pairs are looked for
        if least > 0.0:
            assert target_violation(controller.scene, query, tool, goal, least)[0] < 1e-6
            close += least < 0.1
    assert close > 5


def test_goal_beyond_the_arm_is_out_of_reach_by_its_excess(panda):
    """It lies 100 mm outside the sphere around the first joint that the outstretched arm could draw."""
    tool = panda.frame_id("panda_hand_tcp", "test")
    root, length = arm(panda, tool)
    goal = root + (length + 0.1) * np.array([1.0, 0.0, 0.0])
    ball = Obstacle.at("ball", Sphere(radius=0.1), [0.62, 0.0, 0.45])
    controller = make_controller(panda, [ball], "panda_hand_tcp", progress=Progress(detour=Detour()))
    ticks = list(drive(controller, panda.home, 1200, target=goal))
    reason = ticks[-1].solution.stalled[0]
    assert (reason.kind, reason.subject, reason.unit) == (ReasonKind.OUT_OF_REACH, ("panda_hand_tcp",), "m")
    assert reason.amount == pytest.approx(0.1, abs=1e-9)
    assert np.abs(ticks[-1].solution.v).max() < 2e-3


@pytest.mark.parametrize("robot", ["panda", "ur5"])
def test_arm_length_bounds_all_configurations(robot):
    loaded = Robot.load(robot)
    model, data = loaded.model, loaded.model.createData()
    tool = model.nframes - 1
    root, length = arm(loaded, tool)
    random, far = np.random.default_rng(0), 0.0
    for _ in range(2000):
        q = random.uniform(model.lowerPositionLimit, model.upperPositionLimit)
        pin.framesForwardKinematics(model, data, q)
        far = max(far, float(np.linalg.norm(data.oMf[tool].translation - root)))
    assert 0.5 * length < far <= length


def test_arm_length_of_a_mobile_base_is_infinite():
    robot = Robot.load("g1")
    tool = robot.model.nframes - 1
    assert arm(robot, tool)[1] == np.inf
