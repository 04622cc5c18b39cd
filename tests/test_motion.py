"""Trajectories against closed forms, against their own finite differences, and against bad input."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from pydantic import TypeAdapter
from scipy.spatial.transform import Rotation  # type: ignore[import-untyped]

from qpavoid import config
from qpavoid.errors import ConfigError, NumericalError
from qpavoid.model.sample import Sample
from qpavoid.model.trajectory import Motion, build_motion, rpy_to_matrix

Array = NDArray[np.float64]

HERE = Path()
STEP = 1e-5  # of the central differences [s]
CIRCLE = {"type": "circle", "center": (0, 0, 0), "radius": 1, "period": 1}
POSES = "t,x,y,z,qx,qy,qz,qw"
START = Sample.at([0.4, -0.1, 0.7], rpy_to_matrix([0.3, -0.5, 1.1]))

coordinate = st.floats(-2.0, 2.0)
point = st.tuples(coordinate, coordinate, coordinate)
direction = point.filter(lambda v: np.linalg.norm(v) > 0.1)
profile = st.sampled_from(["constant", "smooth"])


def build(start: Sample | None = None, folder: Path = HERE, /, **block: Any) -> Motion:
    """Build the motion of a block written as in a scenario file."""
    return build_motion(TypeAdapter(config.Motion).validate_python(block), start, folder)


def write(folder: Path, *lines: str) -> str:
    (folder / "path.csv").write_text("\n".join(lines) + "\n")
    return "path.csv"


def assert_rests(motion: Motion, t: float, position: Any, rotation: Any):
    sample = motion.sample(t)
    np.testing.assert_allclose(sample.position, position, atol=1e-12)
    np.testing.assert_allclose(sample.rotation, rotation, atol=1e-12)
    assert not sample.linear.any()
    assert not sample.angular.any()


def assert_twist_is_rate_of_pose(motion: Motion, t: float):
    """Velocities against central differences; the rotation must be one, to 1e-12."""
    before, now, after = (motion.sample(t + dt) for dt in (-STEP, 0.0, STEP))
    np.testing.assert_allclose(now.rotation @ now.rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(now.rotation) == pytest.approx(1.0, abs=1e-12)
    np.testing.assert_allclose(now.linear, (after.position - before.position) / (2 * STEP), atol=1e-6)
    turn = Rotation.from_matrix(after.rotation @ before.rotation.T).as_rotvec()
    np.testing.assert_allclose(now.angular, turn / (2 * STEP), atol=1e-6)


# --- closed forms -------------------------------------------------------------------------------------------


def test_rpy_turns_about_fixed_axes():
    rpy = [0.3, -0.7, 2.1]
    np.testing.assert_allclose(rpy_to_matrix(rpy), Rotation.from_euler("xyz", rpy).as_matrix(), atol=1e-15)
    np.testing.assert_allclose(rpy_to_matrix([0, 0, math.pi / 2]) @ [1, 0, 0], [0, 1, 0], atol=1e-15)
    # pitch is applied before yaw: x goes down to -z with pitch 90°, where yaw leaves it
    np.testing.assert_allclose(rpy_to_matrix([0, math.pi / 2, 1.0]) @ [1, 0, 0], [0, 0, -1], atol=1e-15)


def test_fixed_takes_from_the_start_what_is_left_out():
    for t in (0.0, 3.7):
        assert_rests(build(START, type="fixed"), t, START.position, START.rotation)
        assert_rests(build(START, type="fixed", position=(1, 2, 3)), t, (1, 2, 3), START.rotation)
        assert_rests(build(START, type="fixed", rpy=(0, 0, 1)), t, START.position, rpy_to_matrix([0, 0, 1]))
        assert_rests(build(type="fixed", position=(1, 2, 3)), t, (1, 2, 3), np.eye(3))


def test_line_has_constant_velocity_on_its_half_open_interval():
    line = build(START, type="line", displacement=(0, 3, 4), speed=0.5, start_time=1.0)  # 10 s
    end = START.position + np.array([0, 3, 4])
    velocity = np.array([0, 0.3, 0.4])
    for t in (-1.0, 0.0, 0.999):
        assert_rests(line, t, START.position, START.rotation)
    for t in (1.0, 4.3, 10.999):
        sample = line.sample(t)
        np.testing.assert_allclose(sample.position, START.position + (t - 1) * velocity, atol=1e-12)
        np.testing.assert_allclose(sample.linear, velocity, atol=1e-12)
        assert not sample.angular.any()
    for t in (11.0, 1e6):
        assert_rests(line, t, end, START.rotation)


def test_smooth_line_has_the_speed_of_the_quintic():
    line = build(type="line", start=(1, 0, 0), end=(3, 0, 0), speed=0.5, profile="smooth")  # 4 s
    middle, quarter = line.sample(2.0), line.sample(1.0)
    np.testing.assert_allclose(middle.position, [2, 0, 0], atol=1e-12)
    np.testing.assert_allclose(middle.linear, [1.875 * 0.5, 0, 0], atol=1e-12)
    # 10/64 - 15/256 + 6/1024 = 53/512; 30/16 * 9/16 * 1/4 of [1/s] times 2 m
    np.testing.assert_allclose(quarter.position, [1 + 2 * 53 / 512, 0, 0], atol=1e-12)
    np.testing.assert_allclose(quarter.linear, [2 * 30 / 16 * 9 / 16 / 4, 0, 0], atol=1e-12)
    for t in (1e-4, 4 - 1e-4):
        np.testing.assert_allclose(line.sample(t).linear, 0, atol=1e-7)


@pytest.mark.parametrize("dt", [0.01, 0.001, 0.1, 1 / 3, 0.007])
def test_accumulated_times_fall_on_the_right_side(dt):
    """At tick k of an n-tick line it moves for k < n and rests from n on, multiplied or summed up."""
    n = 800
    line = build(type="line", start=(0, 0, 0), end=(n * dt * 0.1, 0, 0), speed=0.1)
    for times in (np.arange(n + 2) * dt, np.concatenate([[0], np.cumsum(np.full(n + 1, dt))])):
        moving = [bool(line.sample(float(t)).linear.any()) for t in times]
        assert moving == [True] * n + [False] * 2


def test_circle_runs_counter_clockwise_and_rests_after_its_turns():
    circle = build(type="circle", center=(1, 2, 3), radius=0.5, normal=(0, 0, 2), period=4.0, turns=1.25)
    for t, x, v in (
        (0.0, (1.5, 2, 3), (0, math.pi / 4, 0)),
        (1.0, (1, 2.5, 3), (-math.pi / 4, 0, 0)),
        (2.0, (0.5, 2, 3), (0, -math.pi / 4, 0)),
        (4.0, (1.5, 2, 3), (0, math.pi / 4, 0)),
    ):
        np.testing.assert_allclose(circle.sample(t).position, x, atol=1e-12)
        np.testing.assert_allclose(circle.sample(t).linear, v, atol=1e-12)
    assert_rests(circle, -1.0, (1.5, 2, 3), np.eye(3))
    assert_rests(circle, 5.0, (1, 2.5, 3), np.eye(3))
    assert_rests(circle, 9.0, (1, 2.5, 3), np.eye(3))
    assert circle.sample(5.0 - 1e-6).linear.any()


@given(normal=direction, towards=direction, radius=st.floats(0.01, 2), t=st.floats(0, 100))
def test_circle_without_centre_starts_at_the_frame(normal, towards, radius, t):
    if np.linalg.norm(np.cross(normal, towards)) < 1e-3:
        return
    circle = build(START, type="circle", radius=radius, normal=normal, start_direction=towards, period=3.0)
    first, now = circle.sample(0.0), circle.sample(t)
    np.testing.assert_allclose(first.position, START.position, atol=1e-12)
    np.testing.assert_allclose(now.rotation, START.rotation, atol=0)
    n = np.array(normal) / np.linalg.norm(normal)
    in_plane = np.array(towards) - (towards @ n) * n
    center = first.position - radius * in_plane / np.linalg.norm(in_plane)
    arm = now.position - center
    assert np.linalg.norm(arm) == pytest.approx(radius, abs=1e-9)
    assert arm @ n == pytest.approx(0, abs=1e-9)
    np.testing.assert_allclose(now.linear, 2 * math.pi / 3.0 * np.cross(n, arm), atol=1e-9)


def test_waypoints_pass_through_their_poses_and_turn_at_a_constant_rate():
    rpys = [(0.0, 0.0, 3.0), (0.0, 0.0, -3.0), (0.0, 0.0, -2.5)]  # the short way from 3 to -3 is through π
    positions = [(0, 0, 0), (1, 0, 0), (1, 2, 0)]
    path = build(type="waypoints", times=[1, 2, 4], positions=positions, rpys=rpys)
    for t, x, rpy in zip([1.0, 2.0, 4.0], positions, rpys, strict=True):
        np.testing.assert_allclose(path.sample(t).position, x, atol=1e-12)
        np.testing.assert_allclose(path.sample(t).rotation, rpy_to_matrix(rpy), atol=1e-12)
    np.testing.assert_allclose(path.sample(1.5).rotation, rpy_to_matrix([0, 0, math.pi]), atol=1e-12)
    np.testing.assert_allclose(path.sample(1.5).angular, [0, 0, 2 * math.pi - 6], atol=1e-12)
    np.testing.assert_allclose(path.sample(2.0).linear, [0, 1, 0], atol=1e-12)  # of the piece that begins
    np.testing.assert_allclose(path.sample(3.0).angular, [0, 0, 0.25], atol=1e-12)
    assert_rests(path, 0.5, positions[0], rpy_to_matrix(rpys[0]))
    assert_rests(path, 4.0, positions[2], rpy_to_matrix(rpys[2]))


def test_two_roundings_of_one_orientation_are_no_turn(tmp_path):
    for k in range(1, 20):
        q = np.array([0.1 * k, 0.2, -0.3, 0.7])
        rows = [f"{t},0,0,0," + ",".join(repr(float(x)) for x in scale * q) for t, scale in ((0, 1), (1, 0.7))]
        motion = build(None, tmp_path, type="csv", path=write(tmp_path, POSES, *rows))
        assert not motion.sample(0.5).angular.any()


@pytest.mark.parametrize("angle", [1e-9, 1e-4, 1.0, math.pi - 1e-9, math.pi])
def test_turns_of_any_size_reach_their_end(angle):
    axis = np.array([0.6, 0.0, 0.8])
    end = Rotation.from_rotvec(angle * axis) * Rotation.from_matrix(START.rotation)
    rpys = [Rotation.from_matrix(START.rotation).as_euler("xyz"), end.as_euler("xyz")]
    path = build(type="waypoints", times=[0, 1], positions=[(0, 0, 0)] * 2, rpys=rpys)
    np.testing.assert_allclose(path.sample(1 - 1e-8).rotation, end.as_matrix(), atol=1e-7)
    rate = path.sample(0.3).angular
    np.testing.assert_allclose(rate if angle != math.pi else abs(rate), angle * axis, atol=1e-12)


def test_csv_without_quaternions_keeps_the_orientation_of_the_start(tmp_path):
    name = write(tmp_path, "t, x, y, z", "0, 0, 0, 0", "", "2, 1, 0, -1", "3,1,1,1")
    motion = build(START, tmp_path, type="csv", path=name)
    np.testing.assert_allclose(motion.sample(0.5).position, [0.25, 0, -0.25], atol=1e-12)
    np.testing.assert_allclose(motion.sample(2.5).linear, [0, 1, 2], atol=1e-12)
    assert_rests(motion, 3.0, (1, 1, 1), START.rotation)
    assert_rests(build(None, tmp_path, type="csv", path=str(tmp_path / name)), 3.0, (1, 1, 1), np.eye(3))


@given(
    q0=st.tuples(*[coordinate] * 4).filter(lambda q: np.linalg.norm(q) > 0.1),
    q1=st.tuples(*[coordinate] * 4).filter(lambda q: np.linalg.norm(q) > 0.1),
    s=st.floats(0.01, 0.99),
)
def test_csv_quaternions_turn_the_short_way_whatever_their_sign(tmp_path_factory, q0, q1, s):
    folder = tmp_path_factory.getbasetemp()

    def motion(sign: float, scale: float = 1.0) -> Motion:
        rows = (
            "0,0,0,0," + ",".join(map(repr, q0)),
            "1,0,0,0," + ",".join(repr(sign * scale * x) for x in q1),
        )
        return build(None, folder, type="csv", path=write(folder, POSES, *rows))

    a, b, c = motion(1).sample(s), motion(-1).sample(s), motion(1, scale=2.0).sample(s)
    for other in (b, c):
        np.testing.assert_array_equal(a.rotation, other.rotation)
        np.testing.assert_array_equal(a.angular, other.angular)
    r0, r1 = Rotation.from_quat(q0), Rotation.from_quat(q1)
    turn = (r1 * r0.inv()).magnitude()
    assert turn <= math.pi + 1e-12
    assert np.linalg.norm(a.angular) == pytest.approx(turn, abs=1e-9)
    assert (Rotation.from_matrix(a.rotation) * r0.inv()).magnitude() == pytest.approx(s * turn, abs=1e-7)
    if turn < math.pi - 1e-3:
        expected = Rotation.from_rotvec(s * (r1 * r0.inv()).as_rotvec()) * r0
        np.testing.assert_allclose(a.rotation, expected.as_matrix(), atol=1e-9)


# --- twist = rate of the pose -------------------------------------------------------------------------------


@given(
    positions=st.lists(point, min_size=3, max_size=3),
    rpys=st.lists(point, min_size=3, max_size=3),
    profile=profile,
    s=st.floats(0.01, 0.99),
    piece=st.integers(0, 1),
)
def test_twist_of_waypoints(positions, rpys, profile, s, piece):
    times = [0.5, 1.5, 4.0]
    motion = build(type="waypoints", times=times, positions=positions, rpys=rpys, profile=profile)
    assert_twist_is_rate_of_pose(motion, times[piece] + s * (times[piece + 1] - times[piece]))


@given(
    positions=st.lists(point, min_size=4, max_size=4),
    rpys=st.lists(point, min_size=4, max_size=4),
    profile=profile,
)
def test_pose_is_continuous_at_the_corners(positions, rpys, profile):
    times = [0.0, 0.7, 1.0, 2.5]
    motion = build(type="waypoints", times=times, positions=positions, rpys=rpys, profile=profile)
    for t, position, rpy in zip(times, positions, rpys, strict=True):
        for side in (-1e-8, 0.0, 1e-8):
            sample = motion.sample(t + side)
            np.testing.assert_allclose(sample.position, position, atol=1e-6)
            np.testing.assert_allclose(sample.rotation, rpy_to_matrix(rpy), atol=1e-6)
            if profile == "smooth":
                np.testing.assert_allclose(sample.linear, 0, atol=1e-6)
                np.testing.assert_allclose(sample.angular, 0, atol=1e-6)


# --- errors -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        (["t,x,y", "0,0,0", "1,0,0"], ["header", "t,x,y,z,qx,qy,qz,qw"]),
        (["0,0,0,0", "1,0,0,0"], ["header", "first line"]),
        (["t,x,y,z"], ["0 rows", "give 2"]),
        (["t,x,y,z", "0,0,0,0", "", "1,0,abc,0"], ["abc", "row 1", "column 3"]),
        (["t,x,y,z", "0,0,0,0", "-1,0,0,0"], ["row 2", "increase"]),
        ([POSES, "0,0,0,0,0,0,0,1", "1,0,0,0,0,0,0,0"], ["row 2", "quaternion", "zero"]),
    ],
)
def test_bad_csv(tmp_path, lines, words):
    name = write(tmp_path, *lines)
    with pytest.raises(ConfigError) as error:
        build(None, tmp_path, type="csv", path=name)
    for word in (name, *words):
        assert word in str(error.value)


@pytest.mark.parametrize(
    ("block", "words"),
    [
        ({"type": "fixed"}, "motion.position is missing"),
        ({"type": "line", "end": (0, 0, 1), "speed": 1}, "motion.start is missing"),
        ({"type": "circle", "radius": 1, "period": 1}, "motion.center is missing"),
        ({"type": "line", "start": (0, 0, 1), "end": (0, 0, 1), "speed": 1}, "motion.end: the line has no length"),
        ({**CIRCLE, "normal": (0, 0, 0)}, "motion.normal has no"),
        ({**CIRCLE, "start_direction": (0, 0, 0)}, "motion.start_direction has no length"),
        ({**CIRCLE, "normal": (-2, 0, 0)}, "motion.start_direction is parallel to motion.normal"),
    ],
)
def test_bad_block(block, words):
    with pytest.raises(ConfigError) as error:
        build(**block)
    assert words in str(error.value)


def test_sample_copies_what_it_is_given_and_cannot_be_written_to():
    position = np.zeros(3)
    sample = Sample.at(position)
    position[0] = 1.0
    assert sample.position[0] == 0.0
    with pytest.raises(ValueError, match="read-only"):
        sample.position[0] = 1.0


@pytest.mark.parametrize("t", [math.nan, math.inf])
def test_time_that_is_not_finite(t):
    for motion in (
        build(START, type="line", displacement=(1, 0, 0), speed=1),
        build(START, type="circle", radius=1, period=1),
    ):
        with pytest.raises(NumericalError, match="time"):
            motion.sample(t)
