"""The search for a way round is bounded: what was given up is said, the robot rests, and a change begins it anew."""

from itertools import pairwise

import numpy as np
import pinocchio as pin
import pytest
from closed_loop import cartesian, drive, make_controller
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from qpavoid import Avoidance, Obstacle, ReasonKind, Robot, Sample
from qpavoid.config import Box, Detour, Progress, Sphere
from qpavoid.safety.reachability import arm, too_near

DT, KEEP, RADIUS = 0.01, 0.03, 0.05
QUICK = {"speed": 0.2, "longest": 2.0, "patience": 20.0}


def loop(
    folder, obstacles, goal, seconds, detour=None, seen=None, axes="xyz", acceleration=None, start=(0.0, 0.0, 0.0)
):
    """Controller, places (N, 3) of a Cartesian tool with the radius 0.05, and what each tick says of being blocked."""
    controller = make_controller(
        cartesian(folder, axes, acceleration=acceleration), obstacles, axes[-1], dt=DT,
        avoidance=Avoidance(d1=KEEP, d2=0.12), progress=Progress(detour=detour or Detour(**QUICK)),
        task={"max_speed": 0.3},
    )  # fmt: skip
    q, said, least = [], [], np.inf
    target = goal if callable(goal) else np.array(goal)
    for tick in drive(controller, np.array(start), round(seconds / DT), target=target, obstacles=seen):
        q.append(tick.state.q)
        said.append(tick.solution.stalled)
        least = min(least, tick.proximity.distance.min(initial=np.inf))
    assert least > KEEP - 1e-3
    return controller, np.array(q), said


ENDED = ReasonKind.DETOUR_ENDED, ReasonKind.OUT_OF_REACH, ReasonKind.TARGET_OBSTRUCTED


def given_up(said):
    """Tick and reason of each end of a search, and of each end of that, which has None."""
    found = [next((reason for reason in reasons if reason.kind in ENDED), None) for reasons in said]
    return [(k, reason) for k, reason in enumerate(found) if reason != (found[k - 1] if k else None)]


def stalls(said):
    """How often the tasks stalled anew until the search ended: before each detour, and before its end."""
    stalled = [any(reason.kind is ReasonKind.STALLED for reason in reasons) for reasons in said]
    return sum(now and not before for before, now in pairwise([False, *stalled]))


def cage(inner=0.3, thick=0.05, at=(0.6, 0.0, 0.0)):
    """Six plates around a room; the tool fits in, but there is no door. Nothing about the goal itself proves that."""
    plates, reach = [], inner / 2 + thick / 2
    for axis in range(3):
        for side in (-1.0, 1.0):
            size, place = np.full(3, inner + 2 * thick), np.array(at)
            size[axis] = thick
            place[axis] += side * reach
            plates.append(Obstacle.at(f"{'xyz'[axis]}{'-+'[side > 0]}", Box(size=tuple(size)), place))
    return plates


def wall(size=3.0, at=(0.3, 0.0, 0.0)):
    return [Obstacle.at("wall", Box(size=(0.05, size, size)), at)]


def test_a_goal_in_a_closed_room_is_given_up_after_all_ways_and_the_robot_rests(tmp_path):
    """No try brings the tool nearer, whichever plate it meets: another culprit is no reason to begin anew."""
    _, q, said = loop(tmp_path, cage(), (0.6, 0.0, 0.0), 40.0)
    ((tick, reason),) = given_up(said)
    assert (reason.kind, reason.subject, reason.unit) == (ReasonKind.DETOUR_ENDED, ("z",), "s")
    assert stalls(said) == 4 + 1
    assert 4 * 1.0 < reason.amount < tick * DT
    assert tick * DT < 3.0 + 4 * (2.0 + 1.0 + 4.0)  # there; each way, back, and being blocked
    assert all(reasons[0] == reason for reasons in said[tick:])
    assert any(reason.kind is ReasonKind.STALLED for reason in said[-1])
    assert np.abs(q[-1] - q[-500]).max() < 1e-3 and np.abs(q[-1] - q[-1000]).max() < 5e-3
    np.testing.assert_allclose(np.linalg.norm(q[-1] - [0.6, 0.0, 0.0]), 0.2 + RADIUS + KEEP, atol=0.01)  # at a plate


def test_with_the_default_bounds_a_wall_without_end_is_given_up_within_them(tmp_path):
    config = Detour()
    _, q, said = loop(tmp_path, wall(20.0), (0.6, 0.0, 0.0), 60.0, config)
    ((tick, reason),) = given_up(said)
    assert (reason.kind, reason.subject) == (ReasonKind.DETOUR_ENDED, ("z",))
    assert stalls(said) == 2 + 1  # as long on one side as on the other
    assert config.patience < reason.amount < tick * DT
    assert config.patience < tick * DT < config.patience + 15.0  # and back
    assert np.abs(q[-1] - q[-100]).max() < 1e-3


@settings(max_examples=5, deadline=None, phases=[Phase.explicit, Phase.generate])
@given(tries=st.integers(1, 4), longest=st.floats(0.5, 2.0), patience=st.floats(0.5, 9.0))
def test_the_bounds_are_kept_whatever_they_are(tmp_path_factory, tries, longest, patience):
    config = Detour(speed=0.2, longest=longest, tries=tries, patience=patience)
    _, _, said = loop(tmp_path_factory.mktemp("robot"), wall(20.0), (0.6, 0.0, 0.0), 30.0, config)
    ((_, reason),) = given_up(said)
    ways, seconds = stalls(said) - 1, reason.amount
    assert reason.kind is ReasonKind.DETOUR_ENDED
    assert ways <= tries and seconds < min(patience, tries * (longest + 8.0)) + 8.0  # and back
    assert ways == tries or seconds > patience


def test_what_brings_the_tool_nearer_renews_the_budget(tmp_path):
    """Three plates in a row, each across the way, with only one way to try for each."""
    plates = [
        Obstacle.at(f"plate{i}", Box(size=(0.05, 0.4, 0.4)), [x, 0.0, 0.0]) for i, x in enumerate((0.4, 1.2, 2.0))
    ]
    _, q, said = loop(tmp_path, plates, (2.5, 0.0, 0.0), 40.0, Detour(tries=1))
    assert np.linalg.norm(q[-1] - [2.5, 0.0, 0.0]) < 1e-3
    stopped = {(reason.kind, reason.subject) for reasons in said for reason in reasons}
    assert stopped == {(ReasonKind.STALLED, ("tool", f"plate{i}")) for i in range(3)}


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_one_side_closed_the_other_is_tried_next(tmp_path, side):
    """On a plane: a wall that ends on one side only, in a corner on the other."""
    walls = [
        Obstacle.at("wall", Box(size=(0.05, 1.0, 1.0)), [0.3, 0.3 * side, 0.0]),
        Obstacle.at("corner", Box(size=(1.0, 0.05, 1.0)), [-0.1, 0.8 * side, 0.0]),
    ]
    _, q, said = loop(tmp_path, walls, (0.6, 0.1 * side, 0.0), 30.0, axes="xy", start=(0.0, 0.1 * side))
    assert np.linalg.norm(q[-1] - [0.6, 0.1 * side]) < 1e-3 and said[-1] == ()


@pytest.mark.parametrize("what", ["goal", "wall", "reset", "jitter"])
def test_a_change_begins_it_anew_and_less_than_that_does_not(tmp_path, what):
    """After 20 s something changes, and the ways are tried again."""
    random = np.random.default_rng(0)

    def seen(t):
        aside = 0.05 if what == "wall" and t > 20.0 else random.normal(0.0, 2e-3) if what == "jitter" else 0.0
        return {"wall": Sample.at([0.3, aside, 0.0])}

    def goal(t):
        return np.array(
            [0.6, 0.05 if what == "goal" and t > 20.0 else 0.01 * np.sin(0.3 * t) * (what == "jitter"), 0.0]
        )

    config = Detour(**QUICK, tries=2)
    controller, _, said = loop(tmp_path, wall(20.0), goal, 20.0, config, seen)
    ((_, ended),) = given_up(said)
    assert ended is not None
    if what == "reset":
        controller.reset()
    ticks = list(drive(controller, np.array([0.2, 0.0, 0.0]), 2000, target=goal, obstacles=seen, start=2001))
    again = given_up([(ended,)] + [tick.solution.stalled for tick in ticks])
    moved = np.ptp([tick.state.q for tick in ticks], axis=0)[1:].max()
    if what == "jitter":
        assert len(again) == 1 and moved < 0.05
    else:
        assert len(again) == 3 and again[1][1] is None and moved > 0.2


def test_nothing_is_tried_for_a_goal_inside_an_obstacle(tmp_path):
    """The amount: the tool's sphere, and its distance to keep, about the goal, against the ball."""
    _, q, said = loop(tmp_path, [Obstacle.at("ball", Sphere(radius=0.1), [0.3, 0.0, 0.0])], (0.37, 0.0, 0.0), 8.0)
    (_, reason), = given_up(said)  # fmt: skip
    # the frame is the tool's centre: some point of it would be as deep in the ball as the goal is
    assert (reason.kind, reason.subject, reason.unit) == (ReasonKind.TARGET_OBSTRUCTED, ("z", "ball"), "m")
    assert reason.amount == pytest.approx(0.1 - 0.07 + KEEP, abs=5e-6)
    assert np.abs(q[:, 1:]).max() < 1e-3 and np.abs(q[-1] - q[-200]).max() < 2e-3


def stand_off(folder):
    """A tool 0.25 m in front of the one body that it has."""
    cartesian(folder, acceleration=None)
    body = {"name": "tool", "frame": "z", "shape": {"type": "sphere", "radius": 0.05}, "position": [-0.25, 0.0, 0.0]}
    return Robot.from_urdf(folder / "cartesian.urdf", bodies=[body])


def test_a_goal_inside_an_obstacle_is_reached_where_the_body_stands_off_from_it(tmp_path):
    robot = stand_off(tmp_path)
    ball = Obstacle.at("ball", Sphere(radius=0.1), [0.3, 0.0, 0.0])
    controller = make_controller(robot, [ball], "z", progress=Progress(detour=Detour()), task={"max_speed": 0.3})
    ticks = list(drive(controller, np.zeros(3), 600, target=[0.3, 0.0, 0.0]))
    assert np.linalg.norm(ticks[-1].state.q - [0.3, 0.0, 0.0]) < 1e-3
    assert not any(tick.solution.stalled for tick in ticks)


@pytest.mark.parametrize("where", ["panda", "stand-off"])
def test_what_is_attained_is_never_said_to_be_too_near(panda, tmp_path, where):
    """Wherever all bodies are as clear of a ball as they have to be, nothing is said of the place of the tool."""
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
            assert too_near(controller.scene, query, tool, goal, least)[0] < 1e-6
            close += least < 0.1
    assert close > 5


def test_a_goal_beyond_the_arm_is_given_up_by_name_and_amount(panda):
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
def test_no_configuration_is_beyond_the_arm(robot):
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


def test_a_base_that_drives_has_no_longest_reach():
    robot = Robot.load("g1")
    tool = robot.model.nframes - 1
    assert arm(robot, tool)[1] == np.inf
