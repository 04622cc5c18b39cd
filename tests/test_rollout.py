"""Rollouts of backup trajectories, by themselves: scores, validity, and the proof that nothing comes near."""

import numpy as np
import pinocchio as pin
import pytest
from closed_loop import cartesian, changed
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog

from qpavoid import Avoidance, Limits, Obstacle, Robot, Sample, build_scene, kernels
from qpavoid.config import Box, Cone, Line, Sensing, Sphere
from qpavoid.control.obstacles import ObstacleTracker
from qpavoid.control.pair_table import PairTable
from qpavoid.control.scenario import build_parts
from qpavoid.control.settings import ControlSettings
from qpavoid.kernels.rollout import PAUSED, PREFERRED_DISTANCE
from qpavoid.model.trajectory import Trajectory, build_motion
from qpavoid.safety.approach import ApproachCheck
from qpavoid.safety.rollout import LEAST_SCORE, BackupPolicy, BackupRollouts, Start
from qpavoid.solvers.backends import solve_daqp


def rollouts_of(scene, limits=None, dt=0.01):
    """Rollouts of a scene, its settings and its obstacles."""
    limits = limits or Limits()
    bounds = scene.robot.bounds().within(limits)
    shared = ControlSettings(scene, bounds, Avoidance(d1=0.03, d2=0.1), limits, dt)
    tracker = ObstacleTracker(scene.obstacles, Sensing(), dt)
    return BackupRollouts(shared, PairTable(scene), tracker), shared, tracker


def is_far(check, rollouts, q, v, t):
    """Whether obstacles stay away from a robot at q (nq,), at which the distances are those of a control step."""
    rollouts.kinematics.compute(q)
    rollouts.query.compute(rollouts.kinematics.joint_poses, 0.1)
    return check.is_far(v, t)


LIMITS = {"speeds": {}, "accelerations": {"acceleration": 3.0}, "jerks": {"acceleration": 3.0, "jerk": 60.0}}


@pytest.fixture(scope="module", params=LIMITS.values(), ids=LIMITS)
def among_balls(request):
    """Rollouts of a Panda among balls that cross its path, its settings, and where it begins."""
    ends = [
        ((0.9, 0.1, 0.5), (-0.9, 0.1, 0.5)),
        ((0.4, -0.8, 0.7), (0.4, 0.8, 0.4)),
        ((0.2, 0.7, 0.3), (0.2, -0.7, 0.3)),
    ]
    shape = {"type": "sphere", "radius": 0.08}
    balls = [
        {"name": f"ball{i}", "shape": shape, "motion": {"type": "line", "start": start, "end": end, "speed": 0.3}}
        for i, (start, end) in enumerate(ends)
    ]
    parts = build_parts(changed("panda_line", robot="panda-capsules", obstacles=balls))  # searches among hulls remember
    rollouts, shared, _ = rollouts_of(parts.scene, Limits(**request.param))
    return rollouts, shared, parts.q0


def random_policies(rollouts, count, seed=0):
    """The stop, and random policies."""
    rng, nv = np.random.default_rng(seed), len(rollouts.stop_policy.bias_velocity)
    yield rollouts.stop_policy
    for _ in range(count):
        yield BackupPolicy(rng.choice([0.05, 0.2, 0.5]), rng.normal(size=nv) * rng.choice([0.0, 5.0]))


def start_of(rollouts, q, t, v=None):
    rest = np.zeros(len(q))
    return Start(q, rest if v is None else v, rest, t, rollouts.enabled)


def largest_change(trajectory, times):
    """Of the velocities of a trajectory from step to step, or of that change itself."""
    before = [trajectory.start.v - trajectory.start.dv, trajectory.start.v]
    return np.abs(np.diff(np.vstack((before, trajectory.v)), times, axis=0)).max(axis=0, initial=0.0)


def test_rollout_of_a_trajectory_and_of_its_remainder_reproduces_it(among_balls):
    rollouts, shared, q = among_balls
    touched, bounds = 0, shared.bounds
    for t in (0.02, 0.13, 0.51):  # a step later, trajectories end at the same time
        for policy in random_policies(rollouts, 4):
            trajectory = rollouts.rollout(start_of(rollouts, q, t), policy, None, None)
            again = rollouts.rollout(trajectory.start, rollouts.stop_policy, trajectory.v, None)
            assert again.score == pytest.approx(trajectory.score, abs=1e-12)
            np.testing.assert_allclose(again.v, trajectory.v, rtol=0, atol=1e-12)
            assert (largest_change(trajectory, 1) <= 0.01 * bounds.acceleration * (1.0 + 1e-9)).all()
            assert (largest_change(trajectory, 2) <= 1e-4 * bounds.jerk * (1.0 + 1e-9)).all()
            touched += trajectory.score.time_to_contact < 1.5
            remainder = rollouts.advance(trajectory)
            later = rollouts.rollout(remainder.start, policy, remainder.v, None)
            assert later.contact_time == pytest.approx(trajectory.contact_time, abs=1e-9)
            # a pair beyond the preferred distance counts with a lower bound, which depends on where the rollout began
            assert later.clearance >= min(trajectory.clearance, PREFERRED_DISTANCE) - 1e-9
    assert 0 < touched < 15


def test_rollout_ends_early_exactly_when_it_does_not_beat_another(among_balls):
    rollouts, _, q = among_balls
    counts = {True: 0, False: 0}
    for t in (0.13, 0.51):
        start, best = start_of(rollouts, q, t), None
        for policy in random_policies(rollouts, 6, seed=1):
            alone = rollouts.rollout(start, policy, None, None)
            beats = best is None or alone.score > best.score
            found = rollouts.rollout(start, policy, None, best)
            assert (found is not None) == beats and (found is None or found.score == alone.score)
            counts[beats] += 1
            best = found or best
    assert min(counts.values()) > 1


def test_a_rollout_that_pauses_is_that_in_one_go_bit_for_bit(among_balls):
    rollouts, _, q = among_balls
    start, rng = start_of(rollouts, q, 0.13), np.random.default_rng(4)
    for policy in random_policies(rollouts, 4, seed=4):
        whole = rollouts.rollout(start, policy, np.full((3, len(q)), 0.1), None)
        rollouts.begin(start, policy, np.full((3, len(q)), 0.1), LEAST_SCORE)
        while rollouts.resume(int(rng.integers(0, 9))) == PAUSED:
            rollouts.kinematics.compute(0.5 * q)  # others use the same memory meanwhile
        paused = rollouts.result()
        assert paused.v.tobytes() == whole.v.tobytes() and paused.q.tobytes() == whole.q.tobytes()
        assert paused[4:7] == whole[4:7]


class OfAnotherClass(Trajectory):
    """A trajectory that compiled code does not know."""


@pytest.mark.parametrize("robot", ["panda", "baxter"])
@pytest.mark.parametrize("limits", LIMITS.values(), ids=LIMITS)
def test_what_compiled_code_leaves_to_python_changes_nothing(robot, limits):
    """Neither a shape for coal, far away, nor a trajectory of another class, nor both in one scene."""
    rng, robot = np.random.default_rng(7), Robot.load(robot)
    lines = [Line(start=tuple(rng.uniform(-1, 1, 3)), end=tuple(rng.uniform(-1, 1, 3)), speed=0.4) for _ in range(6)]
    expected, ball, cone = None, Sphere(radius=0.1), Cone(radius=0.1, length=0.1)
    for custom, shape in ((False, ball), (False, cone), (True, ball)):
        rng, far, found = np.random.default_rng(8), Obstacle.at("far", shape, [9.0, 0.0, 0.0]), []
        motions = [build_motion(line) for line in lines]
        if custom:
            motions = [OfAnotherClass(motion.pieces, motion.initial) for motion in motions]
        balls = [Obstacle(f"ball{i}", Sphere(radius=0.07), motion, True) for i, motion in enumerate(motions)]
        rollouts, _, tracker = rollouts_of(build_scene(robot, [*balls, far]), Limits(**limits))
        for k in range(4):
            t, v = 0.37 * k, rng.uniform(-0.3, 0.3, robot.model.nv)
            sample = Sample.at([9.0, 0.1 * k, 0.0], linear=[0.0, 0.1, 0.0])
            tracker.advance(tracker.read(t, {"far": sample}))
            q = pin.integrate(robot.model, robot.home, rng.uniform(-0.5, 0.5, robot.model.nv))
            policy = BackupPolicy((0.0, 0.05, 0.2, 0.5)[k], rng.normal(size=len(v)))
            found.append(rollouts.rollout(start_of(rollouts, q, t, v), policy, np.tile(v, (5, 1)), None))
        expected = expected or found
        for one, other in zip(found, expected, strict=True):
            np.testing.assert_allclose(one.v, other.v, rtol=0, atol=1e-9)
            np.testing.assert_allclose(one.q, other.q, rtol=0, atol=1e-9)
            assert [*one.score, one.clearance] == pytest.approx([*other.score, other.clearance], abs=1e-9)


def test_validity_from_a_nearby_start_is_conservative(among_balls):
    """Against a rollout from that start; and it ends with time, and with other pairs."""
    rollouts, shared, q = among_balls
    rng, valid, policies = np.random.default_rng(2), 0, [*random_policies(rollouts, 29, seed=3)]
    for policy in policies:
        t = rng.uniform(0.0, 2.0)
        trajectory = rollouts.rollout(start_of(rollouts, q, t), policy, None, None)
        off = rng.uniform(-1.0, 1.0, len(q)) * 10.0 ** rng.uniform(-4.0, -1.5)
        moved = pin.integrate(shared.scene.robot.model, q, off)
        start = start_of(rollouts, moved, t, rng.uniform(-0.05, 0.05, len(q)))
        if rollouts.is_valid_from(trajectory, start):
            valid += 1
            again = rollouts.rollout(start, rollouts.stop_policy, trajectory.v, None)
            assert again.score >= rollouts.sufficient_score
            assert not rollouts.is_valid_from(trajectory, start._replace(t=t + 0.02))
            assert not rollouts.is_valid_from(trajectory, start._replace(enabled=~rollouts.enabled))
            margin = trajectory.clearance - rollouts.sufficient_score.clearance
            late = trajectory.start._replace(t=t + 0.008)
            assert rollouts.is_valid_from(trajectory, late, 0.99 * margin / 0.008)
            assert not rollouts.is_valid_from(trajectory, late, 1.01 * margin / 0.008)
    assert 1 < valid < 28


def test_a_plate_passed_between_two_decisions_is_a_contact(tmp_path):
    """A ball of 10 cm at 3 m/s passes a plate of 2 mm within 34 ms; rollouts decide every 40 ms."""
    robot = cartesian(tmp_path, "xy", speed=3.0, acceleration=None)
    plate = Obstacle.at("plate", Box(size=(0.002, 2.0, 0.2)), (0.001, 0.0, 0.0))
    rollouts, _, _ = rollouts_of(build_scene(robot, [plate]))
    for shift in np.linspace(0.0, 0.12, 7):
        start = start_of(rollouts, np.array([-0.5 - shift, 0.0]), 0.0)
        trajectory = rollouts.rollout(start, rollouts.stop_policy, np.tile([3.0, 0.0], (40, 1)), None)
        assert trajectory.contact_time == pytest.approx((0.45 + shift) / 3.0, abs=0.04), shift


def farthest(h, closest, J, feedforward, c, bias, bound=1.0):
    nv = len(bias)
    args = h, closest, J, feedforward, c, 10.0, 1e-4, bias, np.full(nv, -bound), np.full(nv, bound)
    v, converged = kernels.max_clearance_velocity(*args)
    assert converged
    return v


def test_policies_maximise_the_smallest_distance():
    """To first order: against a linear program without a preferred distance, and as one QP in (v, s) by daqp."""
    rng = np.random.default_rng(0)
    for _ in range(25):
        A, d = 0.2 * rng.normal(size=(6, 4)), rng.uniform(0.0, 0.1, 6)
        v = farthest(1.0, np.column_stack((d, np.zeros((6, 9)))), A, np.zeros(6), 10.0, np.zeros(4))
        least = np.column_stack((-A, np.ones(6)))
        best = linprog([0, 0, 0, 0, -1], A_ub=least, b_ub=d, bounds=[(-1, 1)] * 4 + [(None, None)])
        # the regularisation costs at most ε/2 ‖v‖² <= 2e-4 of ½ (10 - s)², whose slope is about 10
        assert (A @ v + d).min() == pytest.approx(best.x[-1], abs=1e-4)
        closest, J, rates, bias = (
            rng.uniform(0.0, 0.1, (5, 10)),
            rng.normal(size=(5, 3)),
            0.1 * rng.normal(size=5),
            rng.normal(size=3),
        )
        v = farthest(0.2, closest, J, rates, 0.1, bias)
        P, G = np.diag([1e-4, 1e-4, 1e-4, 1.0]), np.column_stack((0.2 * J, -np.ones(5)))
        limits = np.array([-1.0, -1.0, -1.0, -10.0]), np.array([1.0, 1.0, 1.0, 0.1])
        expected = solve_daqp(P, -P @ np.append(bias, 0.1), G, -(closest[:, 0] + 0.2 * rates), *limits)
        assert v == pytest.approx(expected[:3], abs=1e-6)


ROBOTS = {}
"""Robots that are built once."""


@settings(max_examples=30, deadline=None)
@given(
    st.lists(st.tuples(*[st.floats(-1.5, 1.5)] * 6, st.floats(0.05, 0.5)), min_size=1, max_size=4),
    st.floats(0.0, 1.0),
    st.tuples(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0)),
)
def test_approach_check_is_conservative(tmp_path_factory, lines, t, v):
    robot = ROBOTS.setdefault("xy", cartesian(tmp_path_factory.mktemp("robot"), "xy", speed=1.0, acceleration=2.0))
    obstacles = [
        Obstacle(f"o{i}", Sphere(radius=0.1), build_motion(Line(start=line[:3], end=line[3:6], speed=line[6])), True)
        for i, line in enumerate(lines)
        if np.linalg.norm(np.subtract(line[:3], line[3:6])) > 1e-3
    ]
    if not obstacles:
        return
    rollouts, shared, tracker = rollouts_of(build_scene(robot, obstacles))
    check, v = ApproachCheck(shared, rollouts.query, rollouts.lever_arm, tracker), np.array(v)
    for k, away in enumerate((0.0, 0.01, 0.1, 0.3)):  # a cached clearance counts for configurations near by
        home, at = robot.home + away, t + 0.02 * k
        moving = [o for o in obstacles if o.motion.sample(at).linear.any()]  # those at rest do not count
        if not is_far(check, rollouts, home, v, at):
            continue
        for later in np.linspace(0.0, 1.5, 76):
            braking = np.minimum(later, np.abs(v) / 2.0)
            place = np.array([*(home + np.sign(v) * (np.abs(v) * braking - braking**2)), 0.0])
            centers = [o.motion.sample(at + later).position for o in moving]
            assert min((np.linalg.norm(place - center) for center in centers), default=1.0) - 0.15 > 0.1


@settings(max_examples=40, deadline=None)
@given(
    st.lists(st.tuples(*[st.floats(-1.5, 1.5)] * 3, *[st.floats(-1.0, 1.0)] * 2), min_size=1, max_size=4),
    st.tuples(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0)),
)
def test_approach_check_of_external_obstacles_is_conservative(tmp_path_factory, balls, v):
    robot = ROBOTS.setdefault("xy", cartesian(tmp_path_factory.mktemp("robot"), "xy", speed=1.0, acceleration=2.0))
    obstacles = [Obstacle.at(f"o{i}", Sphere(radius=0.1), [9.0, 0.0, 0.0]) for i in range(len(balls))]
    rollouts, shared, tracker = rollouts_of(build_scene(robot, obstacles))
    samples = [Sample.at(ball[:3], linear=[*ball[3:], 0.0]) for ball in balls]
    tracker.advance(tracker.read(0.0, {f"o{i}": sample for i, sample in enumerate(samples)}))
    check, v = ApproachCheck(shared, rollouts.query, rollouts.lever_arm, tracker), np.array(v)
    if not is_far(check, rollouts, robot.home, v, 0.0):
        return
    assert check.max_speed == pytest.approx(max(np.linalg.norm(sample.linear) for sample in samples), abs=1e-12)
    for later in np.linspace(0.0, 1.5, 76):
        braking = np.clip(later - 0.01, 0.0, np.abs(v) / 2.0)
        place = robot.home + min(later, 0.01) * v + np.sign(v) * (np.abs(v) * braking - braking**2)
        centers = [s.position + later * s.linear for s in samples if np.abs(s.linear).max() > 1e-100]
        assert min((np.linalg.norm([*place, 0.0] - center) for center in centers), default=1.0) - 0.15 > 0.1
