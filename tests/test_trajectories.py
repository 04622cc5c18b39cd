"""Many moving obstacles at once: against each motion's own `sample`, plain definitions, and one by one in a loop."""

import math

import numpy as np
import pinocchio as pin
import pytest
from closed_loop import drive, make_controller
from conftest import BOX, CAPSULE, SPHERE, moved, obstacle
from hypothesis import given
from hypothesis import strategies as st
from pydantic import TypeAdapter

from qpavoid import Obstacle, ReasonKind, Sample, Status, config, kernels
from qpavoid.control.trajectories import extrapolate
from qpavoid.errors import NumericalError
from qpavoid.kernels.obstacles import (
    FINE,
    NO_ROTATION,
    NORMALISED,
    SAMPLE,
)
from qpavoid.model.sample import STATE
from qpavoid.model.trajectory import Trajectory, build_motion, still

coordinate = st.floats(-2.0, 2.0)
point = st.tuples(coordinate, coordinate, coordinate)


def build(**block):
    return build_motion(TypeAdapter(config.Motion).validate_python(block))


class Pendulum:
    """A motion that somebody else has made."""

    def sample(self, t):
        return Sample.at([2.0, 0.1 * math.sin(t), 1.0], linear=[0.0, 0.1 * math.cos(t), 0.0])


class Drifting(Trajectory):
    """One that is derived from one of ours."""

    def sample(self, t):
        return self.initial._replace(position=self.initial.position + t)


def test_a_controller_follows_motions_of_other_classes(panda):
    rest = still(Sample.at([2.0, 0.0, 0.0]))
    motions = {"pendulum": Pendulum(), "drifting": Drifting(rest.pieces, rest.initial)}
    scene = [Obstacle(name, SPHERE, motion) for name, motion in motions.items()]
    controller = make_controller(panda, [*scene, obstacle("rock", SPHERE, (2.0, 1.0, 0.0))])
    for t in (0.3, 1.1):
        controller.step(panda.home, t)
        for name, motion in motions.items():
            np.testing.assert_array_equal(controller.obstacle_pose(name).position, motion.sample(t).position)


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


def random_states(rng, count, turning):
    states = np.zeros((count, STATE))
    for state in states:
        twist = rng.normal(size=(2, 3)) * (rng.random() < 0.7)
        rotation = pin.exp3(rng.normal(size=3))
        state[:] = Sample(rng.normal(size=3), rotation, twist[0], turning * twist[1]).row
    return states


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
