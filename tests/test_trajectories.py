"""Many moving obstacles at once: against each motion's own `sample`, plain definitions, and one by one in a loop."""

import math

import numpy as np
import pinocchio as pin
import pytest
from closed_loop import drive, make_controller
from conftest import BOX, CAPSULE, SPHERE, instructions, moved, obstacle
from hypothesis import given
from hypothesis import strategies as st
from pydantic import TypeAdapter

from qpavoid import Obstacle, ReasonKind, Sample, Status, build_scene, config, kernels
from qpavoid.control.distances import DistanceQuery
from qpavoid.control.obstacle_states import ObstacleStates
from qpavoid.control.trajectories import TrajectoryBatch, extrapolate
from qpavoid.errors import NumericalError
from qpavoid.kernels.obstacles import (
    FAR,
    FAST,
    FINE,
    LEFT_HANDED,
    NO_ROTATION,
    NORMALISED,
    NOT_FINITE,
    POSE,
    REST,
    SAMPLE,
)
from qpavoid.model.sample import STATE
from qpavoid.model.trajectory import Motion, Trajectory, build_motion, still

coordinate = st.floats(-2.0, 2.0)
point = st.tuples(coordinate, coordinate, coordinate)


def build(**block):
    return build_motion(TypeAdapter(config.Motion).validate_python(block))


def test_only_rows_of_its_own_are_written():
    motions = {
        4: build(type="line", start=(0, 0, 1), end=(1, 0, 1), speed=0.5),
        1: build(type="fixed", position=(1, 2, 3)),
    }
    states = np.full((6, STATE), np.nan)
    TrajectoryBatch(motions).sample(1.0, states)
    assert np.flatnonzero(np.isfinite(states).all(axis=1)).tolist() == [1, 4]
    assert np.flatnonzero(np.isnan(states).all(axis=1)).tolist() == [0, 2, 3, 5]
    np.testing.assert_allclose(states[4, 9:15], [0.5, 0, 1, 0.5, 0, 0], atol=1e-15)


class Pendulum:
    """A motion that somebody else has made."""

    def sample(self, t):
        return Sample.at([2.0, 0.1 * math.sin(t), 1.0], linear=[0.0, 0.1 * math.cos(t), 0.0])


class Drifting(Trajectory):
    """One that is derived from one of ours."""

    def sample(self, t):
        return self.initial._replace(position=self.initial.position + t)


def test_motions_of_other_classes_are_left_to_their_sample():
    motions: dict[int, Motion] = {0: Pendulum(), 1: build(type="circle", center=(0, 0, 1), radius=0.2, period=3)}
    rest = still(Sample.at([0.0, 0.0, 0.0]))
    motions[2] = Drifting(rest.pieces, rest.initial)
    assert set(TrajectoryBatch(motions).others) == {0, 2}


def test_a_controller_follows_motions_of_other_classes(panda):
    controller = make_controller(panda, [Obstacle("it", SPHERE, Pendulum()), obstacle("rock", SPHERE, (2.0, 1.0, 0.0))])
    for t in (0.3, 1.1):
        controller.step(panda.home, t)
        found = controller.obstacle_pose("it")
        np.testing.assert_array_equal(found.position, Pendulum().sample(t).position)


def test_a_motion_that_gives_nonsense_is_named_and_moves_nothing(panda):
    class Broken:
        def sample(self, t):
            moving = Sample.at([2.0 + t, 0.0, 1.0], linear=[1.0, 0.0, 0.0])
            return moving._replace(position=moving.position * (np.nan if t > 1.0 else 1.0))

    scene = [Obstacle("broken", SPHERE, Broken()), Obstacle("other", SPHERE, Pendulum())]
    controller = make_controller(panda, scene)
    solution = controller.step(panda.home, 0.5)
    assert solution.status is Status.RELAXED and solution.reasons[0].kind is ReasonKind.NO_BACKUP
    before = [controller.obstacle_pose(name).position for name in ("broken", "other")]
    with pytest.raises(NumericalError, match="'broken': NaN or infinity"):
        controller.step(panda.home, 1.5)
    np.testing.assert_array_equal([controller.obstacle_pose(name).position for name in ("broken", "other")], before)


@given(data=st.data())
def test_states_move_on_at_their_twists(data):
    states = np.zeros((4, STATE))
    expected = []
    t = data.draw(st.floats(-1.0, 1.0))
    for state in states:
        twist = data.draw(st.sampled_from([(0.0, 0.0, 0.0)]) | point)
        sample = Sample.at(data.draw(point), pin.exp3(np.array(data.draw(point))), data.draw(point), twist)
        state[:] = sample.row
        expected.append(moved(sample, t))
    extrapolate(states, t)
    for view, sample in zip(map(Sample.of_row, states), expected, strict=True):
        np.testing.assert_allclose(view.position, sample.position, atol=1e-14)
        np.testing.assert_allclose(view.rotation, sample.rotation, atol=1e-14)


# --- what distances know of them ---------------------------------------------------------------------------------


def random_states(rng, count, turning):
    states = np.zeros((count, STATE))
    for state in states:
        twist = rng.normal(size=(2, 3)) * (rng.random() < 0.7)
        rotation = pin.exp3(rng.normal(size=3))
        state[:] = Sample(rng.normal(size=3), rotation, twist[0], turning * twist[1]).row
    return states


def placed_scene(panda, count):
    """Spheres, capsules and boxes of which the first two may be attached, and distances of theirs."""
    shapes = [SPHERE, CAPSULE, BOX]
    places = [(1.0 + i, 0.0, 0.5) for i in range(count)]
    obstacles = [Obstacle.at(f"o{i}", shapes[i % 3], place, graspable=i < 2) for i, place in enumerate(places)]
    scene = build_scene(panda, obstacles)
    return scene, DistanceQuery(scene)


@pytest.mark.parametrize("turning", [False, True])
def test_place_writes_twists_speeds_and_poses_by_definition(panda, turning):
    rng = np.random.default_rng(1)
    scene, query = placed_scene(panda, 8)
    x, first, joints = query.arrays, len(scene.body_names), panda.model.njoints
    before = x.poses.copy()
    for which in ([0, 2, 3, 7], [5], [4, 1], []):
        states, margin = random_states(rng, 8, turning), rng.choice([0.0, 0.1], 8)
        query.place(ObstacleStates(np.array(which, dtype=np.intp), states, margin, {}))
        assert query.is_moving == bool(states[which, 12:].any() or margin[which].any())
        for i in which:
            sample = Sample.of_row(states[i])
            at_origin = pin.SE3(np.eye(3), sample.position).act(pin.Motion(sample.linear, sample.angular))
            np.testing.assert_allclose(x.twists[i], at_origin.vector, atol=1e-14)
            speed = np.linalg.norm(sample.linear) + query.obstacle_radii[i] * np.linalg.norm(sample.angular)
            assert x.speeds[joints + i] == pytest.approx(speed, abs=1e-14)
            assert x.margin[i] == margin[i] and (x.states[i] == states[i]).all()
            np.testing.assert_array_equal(x.poses[first + i, :9].reshape(3, 3).T, sample.rotation)
            np.testing.assert_array_equal(x.poses[first + i, 9:], sample.position)
            center = sample.position + sample.rotation @ query.table.spheres[first + i, :3]
            np.testing.assert_allclose(x.centers[first + i], [*center, 1.0, -center @ center], atol=1e-13)
        np.testing.assert_array_equal(x.twists[9:], -x.twists[:2])
        np.testing.assert_array_equal(x.margin[9:], x.margin[:2])
        assert not x.twists[8].any() and x.margin[8] == 0.0
    np.testing.assert_array_equal(x.poses[first + 6], before[first + 6])


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_place_refuses_implausible_numbers_and_changes_nothing(panda, value):
    rng = np.random.default_rng(2)
    _, query = placed_scene(panda, 6)
    before = [np.copy(part) for part in query.arrays]
    for column in range(STATE):
        states = random_states(rng, 6, True)
        states[3, column] = value
        with pytest.raises(NumericalError, match="o3"):
            query.place(ObstacleStates(np.arange(6), states, np.zeros(6), {}))
        for part, was in zip(query.arrays, before, strict=True):
            np.testing.assert_array_equal(part, was)


@pytest.mark.parametrize(
    ("change", "how", "code"),
    [
        (lambda x: None, SAMPLE, FINE),
        *[(lambda x, c=c: x.__setitem__(c, np.nan), SAMPLE, NOT_FINITE) for c in (0, 8, 10, 17)],
        (lambda x: x.__setitem__(4, -np.inf), POSE, NOT_FINITE),
        (lambda x: x.__setitem__(17, np.nan), POSE, FINE),  # of a bare pose, that is nothing that was given
        (lambda x: x.__setitem__(12, np.inf), REST, FINE),
        (lambda x: x.__setitem__(9, -101.0), POSE, FAR),
        (lambda x: x.__setitem__(11, 1e300), SAMPLE, FAR),
        (lambda x: x.__setitem__(13, 11.0), SAMPLE, FAST),
        (lambda x: x.__setitem__(15, -11.0), SAMPLE, FAST),
        (lambda x: x.__setitem__(slice(0, 9), 0.0), POSE, NO_ROTATION),
        (lambda x: x.__imul__(np.r_[np.full(9, 0.5), np.ones(9)]), POSE, NO_ROTATION),
        (lambda x: x.__imul__(np.r_[np.full(9, 1.001), np.ones(9)]), POSE, NO_ROTATION),
        (lambda x: x.__imul__(np.r_[np.full(3, -1.0), np.ones(15)]), POSE, LEFT_HANDED),
        (lambda x: x.__imul__(np.r_[np.full(9, 1.0004), np.ones(9)]), SAMPLE, NORMALISED),
        (lambda x: x.__imul__(np.r_[np.full(9, 1.0 + 1e-7), np.ones(9)]), SAMPLE, FINE),
    ],
)  # fmt: skip
def test_check_states_by_definition(change, how, code):
    rng = np.random.default_rng(0)
    states = random_states(rng, 5, True)
    change(states[3])
    before, which = states.copy(), np.array([1, 3, 0])
    kind = np.array([SAMPLE, how, POSE])
    codes, off = kernels.check_states(states, which, kind, 100.0, 10.0)
    assert codes.tolist() == [FINE, code, FINE]
    if code == NORMALISED:
        R, was = (x[3, :9].reshape(3, 3).T for x in (states, before))
        U, _, V = np.linalg.svd(was)
        np.testing.assert_allclose(R, U @ V, atol=1e-15)  # the nearest rotation
        assert off[1] == pytest.approx(np.abs(was.T @ was - np.eye(3)).max())
        states[3, :9] = before[3, :9]
    np.testing.assert_array_equal(states, before)


@given(data=st.data())
def test_check_states_normalises_what_is_nearly_a_rotation(data):
    """Whatever is less than 1e-3 off in every entry of RᵀR."""
    rng = np.random.default_rng(data.draw(st.integers(0, 10**6)))
    states = random_states(rng, 1, True)
    error = rng.normal(size=(3, 3))
    states[0, :9] += (data.draw(st.floats(0.0, 1e-3)) * error / np.abs(error).max()).ravel()
    was = states[0, :9].reshape(3, 3).T.copy()
    off = np.abs(was.T @ was - np.eye(3)).max()
    codes, found = kernels.check_states(states, np.array([0]), np.array([SAMPLE]), 100.0, 1e3)
    assert found[0] == pytest.approx(off, abs=1e-15)
    assert codes[0] == (NO_ROTATION if off > 1e-3 else NORMALISED if off > 1e-6 else FINE)
    if codes[0] == NORMALISED:
        R = states[0, :9].reshape(3, 3).T
        np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-15)


# --- in the tick -------------------------------------------------------------------------------------------------


def circling(rng, count, away, radius=0.3):
    """Spheres, capsules and boxes on circles, lines and turning ways around the robot."""
    found = []
    for i in range(count):
        center = away * rng.uniform(0.9, 1.1) * np.array([np.cos(i), np.sin(i), 0.4])
        if i % 3 == 0:
            motion = build(
                type="circle", center=center.tolist(), radius=radius, period=4.0, normal=rng.normal(size=3).tolist()
            )
        elif i % 3 == 1:
            motion = build(type="line", start=center.tolist(), displacement=(-0.5 * center).tolist(), speed=0.3)
        else:
            ends = [center.tolist(), (0.6 * center).tolist()]
            motion = build(type="waypoints", times=[0.0, 2.0], positions=ends, rpys=[(0, 0, 0), (1.0, 2.0, 0.5)])
        found.append(Obstacle(f"o{i}", (SPHERE, CAPSULE, BOX)[i % 3], motion))
    return found


def test_python_work_does_not_grow_with_the_number_of_moving_obstacles(panda):
    steps = []
    for count in (30, 90):
        controller = make_controller(panda, circling(np.random.default_rng(5), count, 20.0), "panda_hand_tcp")
        for t in (0.10, 0.11):
            controller.step(panda.home, t)
        assert not len(controller.tick(panda.home, 0.12).proximity.pair)
        steps.append(instructions(lambda controller=controller: controller.step(panda.home, 0.13)))
    assert 0 < steps[0] == steps[1] < 4000


def test_a_loop_is_the_same_with_trajectories_of_another_class(panda):
    """One that does no more than to pass on the samples of ours."""

    class Relay:
        def __init__(self, motion):
            self.sample = motion.sample

    obstacles = circling(np.random.default_rng(6), 9, 0.6)
    relayed = [Obstacle(item.name, item.shape, Relay(item.motion)) for item in obstacles]
    runs = []
    for scene in (obstacles, relayed):
        controller = make_controller(panda, scene, "panda_hand_tcp")
        runs.append(list(drive(controller, panda.home, 200, target=[0.6, 0.2, 0.5])))
    assert max(len(tick.proximity.pair) for tick in runs[0]) > 3
    assert {tick.solution.status for tick in runs[0]} == {Status.SOLVED, Status.RELAXED}
    for a, b in zip(*runs, strict=True):
        np.testing.assert_allclose(a.solution.v, b.solution.v, atol=1e-9)
        np.testing.assert_array_equal(a.proximity.pair, b.proximity.pair)
        np.testing.assert_allclose(a.proximity.feedforward, b.proximity.feedforward, atol=1e-9)


def test_what_the_robot_carries_leaves_its_trajectory(panda):
    """And what is given takes the place of a trajectory, for good."""
    load = Obstacle(
        "load", SPHERE, build(type="line", start=(0.4, 0, 0.5), end=(2.0, 0, 0.5), speed=0.5), graspable=True
    )
    controller = make_controller(panda, [load, *circling(np.random.default_rng(7), 4, 5.0)], "panda_hand_tcp")
    controller.step(panda.home, 0.1)
    controller.attach("load", "panda_hand_tcp", panda.home)
    at = controller.obstacle_pose("load", panda.home)
    np.testing.assert_allclose(at.position, [0.45, 0.0, 0.5], atol=1e-12)
    given = Sample.at([3.0, 3.0, 3.0], linear=[0.0, 0.0, 0.4])
    for k in range(3):
        controller.step(panda.home, 0.2 + 0.01 * k, None, {"o1": given} if k == 0 else None)
    np.testing.assert_array_equal(controller.obstacle_pose("load", panda.home).position, at.position)
    later = [3.0, 3.0, 3.0 + 2 * controller.dt * 0.4]
    np.testing.assert_allclose(controller.obstacle_pose("o1").position, later, atol=1e-12)
    expected = controller.scene.obstacles[3].motion.sample(0.22)
    np.testing.assert_allclose(controller.obstacle_pose("o2").position, expected.position, atol=1e-12)
