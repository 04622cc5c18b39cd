"""Limits of position, velocity, acceleration and jerk as one viable set, and stops within them.

The stop of one coordinate is followed tick by tick here, by its definition; the kernels have it in closed form.
"""

from dataclasses import replace
from importlib import import_module

import numpy as np
import pytest
from closed_loop import Ruler, cartesian, changed, drive, make_controller, scenario
from conftest import make_layout
from hypothesis import given, settings
from hypothesis import strategies as st
from test_limits import Axes, random_joints

from qpavoid import Avoidance, ConfigError, Controller, Limits, Obstacle, Robot, Sample, Status, simulate
from qpavoid.config import Box, Damper, Sphere
from qpavoid.kernels.stopping import longest_way, way_to_stop
from qpavoid.limits import JointBounds, limit_layout
from qpavoid.solvers.reasons import what_gave_way
from qpavoid.solvers.relaxation import Relaxed

HELD = 0.02


def kernels_of(name):
    if name == "compiled":
        pytest.importorskip("numba")
    return import_module(f"qpavoid.kernels.{name}")


@pytest.fixture(params=["vectorised", "compiled"])
def version(request):
    """Name of each kernel version in turn."""
    kernels_of(request.param)
    return request.param


# --- the stop of one coordinate ----------------------------------------------------------------------------------


def harder(v):
    """σ(v): largest b for which b + (b - 1) + … is at most v."""
    n = max(np.ceil(0.5 * np.sqrt(1.0 + 8.0 * v) - 0.5), 1.0)
    return v / n + 0.5 * (n - 1.0)


def followed(v, w, most):
    """Speeds of a stop, from v on, in the units of `kernels.stopping`."""
    speeds = [v]
    while abs(v) > 1e-9 or abs(w) > 1.0:
        target = -np.sign(v) * min(harder(abs(v)), most)
        w = min(max(target, w - 1.0), w + 1.0)
        v += w
        speeds.append(v)
        assert len(speeds) < 10_000
    return np.array(speeds)


@st.composite
def moving(draw):
    """v, w and the largest w, some of them whole numbers, at which the phases of a stop change."""
    most = 10.0 ** draw(st.floats(-1.0, 1.5))
    w = draw(st.floats(-1.0, 1.0)) * most
    v = draw(st.sampled_from([-1.0, 1.0])) * 10.0 ** draw(st.floats(-3.0, 2.5))
    if draw(st.booleans()):
        most = max(np.round(most), 1.0)
        v, w = np.round(v), np.clip(np.round(w), -most, most)
    return v, w, most


many = settings(max_examples=400, deadline=None)


def test_the_way_to_stop_by_hand():
    """From 3 with no change yet: 3, 2, then by 1.5 to 0.5, from which 0.5 leads to 0. From 1 with 2: 1, 2, 2, 1, 0."""
    assert followed(3.0, 0.0, 10.0) == pytest.approx([3.0, 2.0, 0.5, 0.0])
    assert way_to_stop(3.0, 0.0, 10.0)[0] == pytest.approx(5.5)
    assert followed(1.0, 2.0, 10.0) == pytest.approx([1.0, 2.0, 2.0, 1.0, 0.0])
    assert way_to_stop(1.0, 2.0, 10.0)[0] == pytest.approx(6.0)
    assert way_to_stop(10.0, 0.0, 0.5)[0] == pytest.approx(sum(np.arange(10.0, 0.0, -0.5)))  # no jerk to speak of
    assert way_to_stop(-5.0, 1.0, 4.0) == (0.0, 0.0)


@many
@given(moving())
def test_the_way_to_stop_is_that_of_the_stop_followed_tick_by_tick(state):
    v, w, most = state
    expected = np.max(np.cumsum(followed(v, w, most)), initial=0.0)
    found = way_to_stop(v, w, most)[0]
    if v > 0.0 and -w - 1.0 > min(harder(v), most):  # braking too hard to come to rest without passing it
        assert found >= expected - 1e-9
        expected = np.sum(followed(v, -min(harder(v), most) - 1.0, most))
    assert found == pytest.approx(expected, rel=1e-9, abs=1e-9)


@many
@given(moving(), st.floats(0.0, 2.0))
def test_ways_grow_with_the_change_and_are_convex_in_it(state, more):
    v, w, most = state
    (low, slope), (middle, _), (high, _) = (way_to_stop(v + s * more, w + s * more, most) for s in (0.0, 0.5, 1.0))
    scale = max(high, 1.0)
    assert low <= middle + 1e-12 * scale <= high + 2e-12 * scale
    assert middle <= 0.5 * (low + high) + 1e-9 * scale
    assert high >= low + more * slope - 1e-9 * scale  # the derivative of a convex function
    assert high <= longest_way(v + more, w + more, most) * (1.0 + 1e-12) + 1e-12


@many
@given(moving(), st.floats(0.0, 3.0))
def test_of_two_stops_the_faster_stays_the_faster(state, more):
    v, w, most = state
    slower, faster = followed(v, w, most), followed(v + more, min(w + more, most), most)
    size = max(len(slower), len(faster))
    slower, faster = (np.pad(a, (0, size - len(a))) for a in (slower, faster))
    assert (slower <= faster + 1e-9).all()


# --- bounds ------------------------------------------------------------------------------------------------------


def jerky_joints(rng, count, some=True):
    """Joints of all kinds, as `random_joints` has them, most of them with a jerk limit: mild, or hardly felt."""
    joints, q = random_joints(rng, count)
    jerk = joints.acceleration * 10.0 ** rng.uniform(0.0, 3.0, count)
    return replace(joints, jerk=np.where(rng.random(count) < 0.9, jerk, np.inf) if some else jerk), q


def bounds_after(axes, q, v, w):
    axes.layout.w_last[:] = w
    return axes.bounds(q, v)


def stops_within(joints, i, q, v, w, dt, slack):
    """Whether coordinate i, at q, moves at v after a change of w and then stops within its limits."""
    unit = joints.jerk[i] * dt**2
    speeds = unit * followed(v / unit, w / unit, joints.acceleration[i] * dt / unit)
    way = q + dt * np.cumsum(speeds)
    inside = (way >= joints.lower[i] - slack).all() and (way <= joints.upper[i] + slack).all()
    return inside and (np.abs(speeds) <= joints.velocity[i] + slack).all()


@pytest.mark.parametrize("dt", [0.001, 0.01, 0.05])
def test_no_limit_is_left_in_a_hundred_thousand_ticks(version, dt):
    """400 joints, 300 ticks each, driven into their limits, to and fro, or at random."""
    rng = np.random.default_rng(1)
    joints, q = jerky_joints(rng, 400)
    axes, v, w = Axes(joints, 0.5, dt, version), np.zeros(400), np.zeros(400)
    unit, reached = np.where(np.isinf(joints.jerk), np.inf, joints.jerk * dt**2), np.zeros(400, dtype=bool)
    for tick in range(300):
        lower, upper = bounds_after(axes, q, v, w)
        assert (lower <= upper).all()
        if tick % 60 == 0:
            goal = rng.choice([0.0, 0.5, 1.0], 400)  # pushed one way for a while; 0.5: anywhere
        following = lower + np.where(goal == 0.5, rng.random(400), goal) * (upper - lower)
        change = following - v
        assert (np.abs(change - w) <= unit * (1.0 + 1e-7) + 1e-12).all()
        assert (np.abs(change) <= joints.acceleration * dt + 1e-9).all()
        assert (np.abs(following) <= joints.velocity + 1e-9).all()
        q, v, w = q + dt * following, following, change
        assert (q >= joints.lower - 1e-9).all() and (q <= joints.upper + 1e-9).all()
        reached |= np.minimum(q - joints.lower, joints.upper - q) < 1e-6
    assert reached.mean() > 0.05  # pushed right to a limit, and no farther


@pytest.mark.parametrize("seed", range(4))
def test_a_stop_ends_in_time_from_the_bounds_and_not_from_beyond_them(version, seed):
    """Where neither the jerk nor the acceleration is what holds the bound; from all kinds of viable states."""
    rng, dt, held = np.random.default_rng(seed), 0.01, 0
    joints, q = jerky_joints(rng, 40, some=False)
    axes, v, w = Axes(joints, 0.5, dt, version), np.zeros(40), np.zeros(40)
    for _ in range(60):
        lower, upper = bounds_after(axes, q, v, w)
        following = np.where(rng.random(40) < 0.6, upper, lower + rng.random(40) * (upper - lower))
        w, v, q = following - v, following, q + dt * following
    unit, step = joints.jerk * dt**2, joints.acceleration * dt
    for bound, away in zip(bounds_after(axes, q, v, w), (-1.0, 1.0), strict=True):
        farthest = np.minimum(away * w + unit, step) - 1e-3 * unit
        for i in range(40):
            assert stops_within(joints, i, q[i], bound[i], bound[i] - v[i], dt, 1e-9)
            if away * (bound[i] - v[i]) < farthest[i]:
                held, beyond = held + 1, bound[i] + away * 1e-3 * unit[i]
                assert not stops_within(joints, i, q[i], beyond, beyond - v[i], dt, 0.0)
    assert held > 10


def test_a_jerk_that_is_hardly_limited_changes_nothing(version):
    """Nor does it to a coordinate that has none beside one that has."""
    rng, dt = np.random.default_rng(0), 0.01
    joints, q = random_joints(rng, 500)
    free = np.full(500, np.inf)
    loose = replace(joints, jerk=np.where(rng.random(500) < 0.5, np.inf, 1e6 * joints.acceleration / dt))
    one, other = Axes(replace(joints, jerk=free), 0.5, dt, version), Axes(loose, 0.5, dt, version)
    v, w = np.zeros(500), np.zeros(500)
    for _ in range(40):
        lower, upper = bounds_after(one, q, v, 0.0 * w)
        found = bounds_after(other, q, v, w)
        np.testing.assert_allclose(found, (lower, upper), rtol=1e-6, atol=1e-6)
        following = found[0] + rng.random(500) * (found[1] - found[0])
        w, v, q = following - v, following, q + dt * following


def test_from_a_state_that_no_stop_saves_jerk_gives_way_then_acceleration(version):
    """Position and speed are kept, and the bounds do not cross; with acceleration, as far as that can be kept."""
    joints, q = jerky_joints(np.random.default_rng(3), 500)
    rng, dt = np.random.default_rng(4), 0.01
    v = rng.uniform(-5.0, 5.0, 500)
    w = rng.uniform(-1.0, 1.0, 500) * joints.acceleration * dt
    axes = Axes(joints, 0.5, dt, version)
    lower, upper = bounds_after(axes, q, v, w)
    within = Axes(replace(joints, jerk=np.full(500, np.inf)), 0.5, dt, version).bounds(q, v)
    assert (within[0] <= lower).all() and (lower <= upper).all() and (upper <= within[1]).all()
    change, unit = np.maximum(lower - v - w, v + w - upper), joints.jerk * dt**2
    assert (change > unit * (1.0 + 1e-9)).sum() > 100  # what jerk alone would forbid
    gentle = (np.abs(v) < 0.2 * joints.velocity) & (np.minimum(q - joints.lower, joints.upper - q) > 3.0)
    assert (change[gentle] <= unit[gentle] * (1.0 + 1e-9)).all()


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_outside_its_position_limits_a_joint_is_sent_back_within_its_jerk(version, side):
    """From rest, with no more than its acceleration and jerk; once inside, it stays there."""
    joints, _ = jerky_joints(np.random.default_rng(5), 300)
    joints = replace(joints, acceleration=10.0 ** np.random.default_rng(6).uniform(0, 2, 300))
    rng, dt = np.random.default_rng(7), 0.01
    edge = joints.upper if side > 0 else joints.lower
    q = edge + side * rng.uniform(0.01, 5.0, 300) * np.minimum(joints.velocity, 0.1)
    v, w = np.zeros(300), np.zeros(300)
    axes, choose, back = Axes(joints, 0.5, dt, version), rng.random(300), np.zeros(300, dtype=bool)
    unit = np.where(np.isinf(joints.jerk), np.inf, joints.jerk * dt**2)
    for _ in range(3000):
        lower, upper = bounds_after(axes, q, v, w)
        assert (lower <= upper).all()
        following = lower + choose * (upper - lower)
        change = following - v
        assert (np.abs(change) <= joints.acceleration * dt + 1e-9).all()
        assert (np.abs(change - w) <= unit * (1.0 + 1e-7) + 1e-9).all()
        q, v, w = q + dt * following, following, change
        inside = (q >= joints.lower - 1e-9) & (q <= joints.upper + 1e-9)
        assert inside[back].all()
        back |= inside
        if back.all():
            break
    assert back.all()


# --- stops of all coordinates -------------------------------------------------------------------------------------


def limited(seed, n=7):
    """A layout with limits of everything, far away positions, and room to move."""
    rng = np.random.default_rng(seed)
    acceleration = rng.uniform(1.0, 20.0, n)
    joints = JointBounds(np.full(n, 5.0), np.arange(n), np.arange(n), np.full(n, -9.0), np.full(n, 9.0),
                         acceleration, acceleration * 10.0 ** rng.uniform(0.5, 2.5, n))  # fmt: skip
    return make_layout(n, **limit_layout(joints, 0.5, 0.01)), rng


def stops(kernels, x, q, v, w):
    """Velocities of a stop as `velocity_bounds` and `stop_velocity` lead it, tick by tick."""
    packed, way = kernels.pack(x), [v]
    while (np.abs(v) > 1e-9 * x.v_step).any() or (np.abs(w) > x.w_step).any():
        q = q + x.dt * v
        x.v_last[:], x.w_last[:] = v, w
        kernels.velocity_bounds(packed, q)
        kernels.stop_velocity(packed)
        assert (x.v_stop >= x.lower).all() and (x.v_stop <= x.upper).all()
        v, w = x.v_stop.copy(), x.v_stop - v
        way.append(v)
        assert len(way) < 3000
    return np.array(way)


@pytest.mark.parametrize("seed", range(6))
def test_a_stop_ends_at_rest_within_all_limits(version, seed):
    """At most twice as late as the slowest coordinate could alone."""
    kernels = kernels_of(version)
    x, rng = limited(seed)
    v, w = rng.uniform(-1.0, 1.0, 7) * 2.0, rng.uniform(-1.0, 1.0, 7) * x.v_step
    way = stops(kernels, x, np.zeros(7), v, w)
    assert np.abs(way[-1]).max() < 1e-9
    changes = np.diff(way, axis=0)
    assert (np.abs(changes) <= x.v_step * (1.0 + 1e-9)).all()
    assert (np.abs(np.diff(changes, axis=0, prepend=w[None])) <= x.w_step * (1.0 + 1e-9)).all()
    alone = [len(followed(v[i] / x.w_step[i], w[i] / x.w_step[i], x.v_step[i] / x.w_step[i])) for i in range(7)]
    assert len(way) <= 2 * max(alone) + 1


@pytest.mark.parametrize("seed", range(3))
def test_a_stop_from_constant_speed_slows_all_coordinates_alike_and_as_fast_as_one_can(version, seed):
    x, rng = limited(seed)
    v = rng.uniform(-2.0, 2.0, 7)
    way = stops(kernels_of(version), x, np.zeros(7), v, np.zeros(7))
    shares = way / v
    np.testing.assert_allclose(shares, np.repeat(shares[:, :1], 7, axis=1), atol=1e-12)
    jerk = np.abs(np.diff(way, n=2, axis=0, prepend=np.array([v]))) / x.w_step
    assert jerk[0].max() == pytest.approx(1.0) and (np.diff(shares[:, 0]) < 1e-12).all()


@pytest.mark.parametrize("place", [0.0, 8.9])
@pytest.mark.parametrize("seed", range(4))
def test_the_way_of_a_stop_is_the_stop_of_the_ticks(version, seed, place):
    """In free space, and where position limits bend it; both versions alike."""
    kernels = kernels_of(version)
    x, rng = limited(seed)
    q, v, w = np.full(7, place), rng.uniform(0.5, 1.5, 7), rng.uniform(-1.0, 1.0, 7) * x.v_step
    if place:  # a state that is viable: on the way there
        q, v, w = 0.0 * q + 5.0, 0.0 * v, 0.0 * w
        axes = kernels.pack(x)
        for _ in range(1000):
            x.v_last[:], x.w_last[:] = v, w
            kernels.velocity_bounds(axes, q)
            following = x.upper.copy() if (q < 8.0).any() else 0.5 * (x.upper + np.minimum(v, x.upper))
            w, v = following - v, following
            q = q + x.dt * v
            if q.max() > 8.6:
                break
        q = q - x.dt * v
    expected = stops(kernels, x, q, v, w)
    way = np.full((1000, 7), np.nan)
    way[0] = v
    count = kernels.stop_way(kernels.pack(x), q.copy(), w, way)
    assert abs(count - len(expected)) <= 1
    size = min(count, len(expected))
    np.testing.assert_allclose(way[:size], expected[:size], rtol=1e-9, atol=1e-9)
    assert (np.ptp(expected[: size // 2] / v, axis=1) > 1e-6).any()  # not all coordinates alike
    other = np.zeros((1000, 7))
    other[0] = v
    assert kernels_of("vectorised").stop_way(kernels_of("vectorised").pack(x), q.copy(), w, other) == count
    np.testing.assert_allclose(other[:count], way[:count], rtol=1e-12, atol=1e-12)


# --- rows --------------------------------------------------------------------------------------------------------


def test_half_of_jerks_and_accelerations_bring_a_pair_to_rest_where_it_has_to_be(version):
    """A pair that closes as fast as its row allows, and as its joints can follow, never comes nearer than it may."""
    kernels = kernels_of(version)
    step, unit, J, dt = np.array([0.1, 0.2]), np.array([0.01, 0.02]), np.array([[0.5, -1.0]]), 0.01
    d, v, w = np.array([0.9]), np.zeros(2), np.zeros(2)
    way, changes = [], []
    for _ in range(400):
        closest = np.zeros((1, 10))
        closest[:, 0] = d
        x = make_layout(2, pairs=1, closest=closest, near=np.arange(1), drift=np.zeros(1), J=J, v_step=step,
            w_step=unit, v_last=v, w_last=w, accelerated=True, jerked=True, v_stop=np.array([0.0, -1e3]),
            switching=False, row_gain=100.0, lower=-np.ones(2), upper=np.ones(2),
        )  # fmt: skip
        kernels.row_bounds(kernels.pack(x), 1, False)
        # the velocity along J that closes fastest, within the row and within what half of the limits allow
        share = np.array([-1.0, 1.0]) / (J[0] @ [-1.0, 1.0]) * np.array([1.0, 1.0])
        least = max(x.least[0], J[0] @ (v + np.maximum(w + unit * [-1.0, 1.0], 0.0) * [1.0, 1.0]) - 9.0)
        following = share * max(least, J[0] @ v + max(J[0] @ w - 0.5 * np.abs(J[0]) @ unit, -0.5 * np.abs(J[0]) @ step))
        w, v = following - v, following
        changes.append(J[0] @ w)
        d = d + dt * (J @ v)
        way.append(d[0])
    changes = np.array(changes)
    half = 0.5 * np.abs(J[0])
    assert min(way) >= 0.1 - 1e-9 and way[-1] == pytest.approx(0.1, abs=1e-3)
    assert (np.abs(np.diff(changes[:-60])) <= 1.25 * half @ unit).all()
    assert np.abs(changes).max() <= 1.01 * half @ step


# --- controllers -------------------------------------------------------------------------------------------------


def within_limits(controller, vs, slack=1e-9):
    """That commands, from a standstill on, keep to velocity, acceleration and jerk limits."""
    b, dt = controller._bounds, controller.dt
    changes = np.diff(vs, axis=0, prepend=np.zeros((1, len(vs[0]))))
    jumps = np.diff(changes, axis=0, prepend=np.zeros((1, len(vs[0]))))
    assert (np.abs(vs) <= b.velocity + slack).all()
    assert (np.abs(changes) <= b.acceleration * dt + slack).all()
    assert (np.abs(jumps) <= b.jerk * dt**2 + slack).all()
    return np.max(np.abs(jumps) / (b.jerk * dt**2))


@pytest.mark.parametrize("row", ["switching", "damper"])
@pytest.mark.parametrize("size", [[0.004, 0.6, 0.6], [0.2, 0.2, 0.2]], ids=["plate", "box"])
@pytest.mark.parametrize(("dt", "duration"), [(0.002, 0.8), (0.01, 1.5), (0.05, 3.0)])
def test_no_period_and_no_speed_pass_the_safe_distance(row, size, dt, duration):
    """As without jerk limits, with ones of about 10 times the accelerations a second: a target leads through a body."""
    run = scenario(
        "panda",
        {"type": "line", "displacement": [0.4, 0.05, -0.1], "speed": 2.0},
        [{"name": "it", "shape": {"type": "box", "size": size},
          "motion": {"type": "fixed", "position": [0.55, 0.0, 0.45]}}],
        dt=dt, duration=duration, limits={"jerk": 100.0},
        avoidance={"d1": HELD, "d2": 0.10, "row": {"type": row}},
    )  # fmt: skip
    log = simulate(run)
    controller, _ = Controller.from_scenario(run)
    ruler = Ruler(controller.scene)
    least = min(ruler.least_between(q, v, dt, t, 4) for q, v, t in zip(log.q, log.v, log.t, strict=True))
    assert least > HELD - 1e-3
    assert log.metrics()["status_counts"]["SOLVED"] == len(log.t)
    assert within_limits(controller, log.v) == pytest.approx(1.0, abs=1e-6)
    assert log.metrics()["peak_velocity"] > 1.0


def test_nothing_is_first_seen_inside_its_margin(tmp_path):
    """A row sees 30 mm ahead; at 2 m/s, 4 m/s² and 20 m/s³, braking takes 0.7 m."""
    robot = cartesian(tmp_path, speed=2.0, acceleration=4.0)
    wall = Obstacle.at("wall", Box(size=(0.1, 2.0, 2.0)), [2.05, 0.0, 0.0])
    controller = make_controller(
        robot, [wall], "z", avoidance=Avoidance(d1=HELD, d2=0.03, row=Damper(gain=20.0)), task={"gain": 50.0},
        limits=Limits(jerk=20.0),
    )  # fmt: skip
    vs, near = [], []
    for tick in drive(controller, np.array([-2.0, 0.0, 0.0]), 500, target=[4.0, 0.0, 0.0]):
        assert tick.solution.status is Status.SOLVED
        vs.append(tick.solution.v)
        near.append(1.95 - tick.state.q[0])
    within_limits(controller, np.array(vs))
    assert max(v[0] for v in vs) == pytest.approx(2.0)
    assert min(near) > HELD - 1e-3 and near[-1] < HELD + 2e-3


@pytest.mark.parametrize("seed", range(3))
def test_random_targets_among_obstacles_stay_feasible(panda, seed):
    """At up to full speed, half of the targets inside obstacles, with the robot's own accelerations."""
    rng, bounds = np.random.default_rng(seed), panda.bounds()
    shapes = Box(size=(0.3, 0.3, 0.3)), Sphere(radius=0.1), Box(size=(0.004, 0.5, 0.5))
    clear = False
    while not clear:
        obstacles = [Obstacle.at(f"o{i}", s, rng.uniform(-0.8, 0.8, 3)) for i, s in enumerate(shapes)]
        controller = make_controller(
            panda, obstacles, "panda_hand_tcp", task={"gain": 5.0, "max_speed": 2.0}, limits=Limits(jerk=300.0)
        )
        ruler = Ruler(controller.scene)
        q = rng.uniform(bounds.lower, bounds.upper)
        clear = ruler.distances(q).min() > 0.03
    vs, least = [], np.inf
    for k in range(700):
        if k % 60 == 0:
            inside = obstacles[rng.integers(3)].motion.sample(0.0).position
            target = {"panda_hand_tcp": Sample.at(rng.uniform(-0.8, 0.8, 3) if rng.random() < 0.5 else inside)}
        s = controller.step(q, 0.01 * k, target)
        assert s.status is Status.SOLVED, s.reasons
        vs.append(s.v)
        q = q + 0.01 * s.v
        assert (q <= bounds.upper + 1e-9).all() and (q >= bounds.lower - 1e-9).all()
        least = min(least, ruler.distances(q).min())
    assert within_limits(controller, np.array(vs)) > 0.99
    assert least > HELD - 1e-3


def test_what_is_left_on_the_way_of_a_stop_is_a_lower_bound(panda):
    """Distances along stops from random velocities and accelerations, by brute force."""
    rng, bounds = np.random.default_rng(0), panda.bounds()
    balls = [Obstacle.at(f"ball{i}", Sphere(radius=0.08), p) for i, p in enumerate(rng.uniform(-0.7, 0.7, (3, 3)))]
    controller = make_controller(panda, balls, limits=Limits(jerk=400.0))
    assembly, ruler, close = controller._assembly, Ruler(controller.scene), 0
    for _ in range(150):
        q = rng.uniform(bounds.lower + 0.3, bounds.upper - 0.3)
        before, change = rng.uniform(-0.3, 0.3, 7) * bounds.velocity, rng.uniform(-1.0, 1.0, 7) * bounds.acceleration
        controller.reset(before)
        near = len(controller.tick(q).proximity.pair)
        controller.reset(before)
        v = before + 0.01 * change
        stop = assembly.stop(q, v)
        way = stop.way.copy()
        bound = assembly.closest_call(v, near, 0.1, float(stop.forwards.sum()), stop)
        least = np.inf
        for velocity in way:
            least = min(least, ruler.distances(q).min())
            q = q + 0.01 * velocity
        assert min(least, ruler.distances(q).min()) - HELD >= bound - 1e-9
        close += bound > 0.0
    assert close > 3


def test_a_stop_is_within_the_jerk_and_the_next_good_tick_goes_on(panda):
    controller = make_controller(panda, frame="panda_hand_tcp", task={"gain": 4.0}, limits=Limits(jerk=200.0))
    q, vs, target = panda.home.copy(), [], {"panda_hand_tcp": Sample.at([0.4, 0.3, 0.6])}
    for k in range(90):
        given = np.full(7, np.nan) if 15 <= k < 60 else q
        s = controller.step(given, 0.01 * k, target)
        assert s.status is (Status.STOPPED if 15 <= k < 60 else Status.SOLVED)
        vs.append(s.v)
        q = q + 0.01 * s.v
    within_limits(controller, np.array(vs))
    assert np.abs(vs[14]).max() > 0.2 and np.abs(vs[59]).max() < 1e-9 and np.abs(vs[75]).max() > 0.1


def test_a_measured_velocity_counts_and_a_reset_forgets_the_acceleration(panda):
    controller = make_controller(panda, frame="panda_hand_tcp", task={"gain": 50.0}, limits=Limits(jerk=200.0))
    q, target, v, change = panda.home, {"panda_hand_tcp": Sample.at([0.2, 0.6, 0.6])}, np.zeros(7), np.zeros(7)
    unit = 200.0 * 0.01**2
    for _ in range(4):
        s = controller.step(q, 0.0, target)
        assert (np.abs(s.v - v - change) <= unit + 1e-12).all()
        v, change = s.v, s.v - v
    assert np.abs(change).max() > 3.9 * unit
    measured = v + 0.01
    found = controller.step(q, 0.0, target, v=measured).v
    assert (np.abs(found - measured - change) <= unit + 1e-12).all()
    controller.reset(v)
    assert (np.abs(controller.step(q, 0.0, target).v - v) <= unit + 1e-12).all()


# --- what gives way, and what users say --------------------------------------------------------------------------


@pytest.mark.parametrize("gives_way", [True, False])
def test_jerk_gives_way_with_the_acceleration_or_never(tmp_path, gives_way):
    """A ball that comes straight at the tool at 2 m/s from 60 mm off: contact cannot be avoided within the limits."""
    robot = cartesian(tmp_path, speed=5.0, acceleration=4.0)
    limits = Limits(jerk=40.0, acceleration_gives_way=gives_way)
    ball = Obstacle.at("ball", Sphere(radius=0.1), [9.0, 0.0, 0.0])
    controller = make_controller(robot, [ball], "z", limits=limits)
    seen = {"ball": Sample.at([0.21, 0.0, 0.0], linear=[-6.0, 0.0, 0.0])}
    tick = controller.tick(np.zeros(3), 0.0, {"z": Sample.at([0.0, 0.0, 0.0])}, seen)
    assert tick.problem.jerked and tick.solution.status is Status.RELAXED
    step = np.abs(tick.solution.v).max()
    if gives_way:
        assert step > 4.0 * 0.01
        assert any("beyond its acceleration and jerk limits" in reason for reason in tick.solution.reasons)
    else:
        assert step <= 40.0 * 0.01**2 + 1e-12
        assert not any("beyond" in reason for reason in tick.solution.reasons)


def test_the_reason_names_the_limits_that_there_are(panda):
    """Without jerk limits, none is named."""
    for limits, said in ((Limits(), "acceleration limit"), (Limits(jerk=50.0), "acceleration and jerk limits")):
        problem = make_controller(panda, frame="panda_hand_tcp", limits=limits).tick(panda.home).problem
        relaxed = Relaxed(np.zeros(7), np.zeros(len(problem.avoidance.d)), np.array([0.0, 0.5, *np.zeros(5)]))
        (line,) = what_gave_way(relaxed, problem)
        assert line == f"panda_joint2: 0.500 rad/s or m/s beyond its {said}"


def test_jerk_limits_of_a_robot_and_of_a_scenario(tmp_path):
    """The scenario's is for joints to which the robot gives none."""
    cartesian(tmp_path)
    body = {"name": "tool", "frame": "z", "shape": {"type": "sphere", "radius": 0.05}}
    limits = {"acceleration": {"joint_x": 2.0, "joint_y": 3.0}, "jerk": {"joint_x": 30.0}}
    robot = Robot.from_urdf(tmp_path / "cartesian.urdf", bodies=[body], limits=limits)
    np.testing.assert_array_equal(robot.bounds().jerk, [30.0, np.inf, np.inf])
    found = robot.bounds().within(Limits(acceleration=5.0, jerk=70.0))
    np.testing.assert_array_equal(found.jerk, [30.0, 70.0, 70.0])
    np.testing.assert_array_equal(robot.bounds().within(Limits()).jerk, [30.0, np.inf, np.inf])
    make_controller(robot, frame="z")
    with pytest.raises(ConfigError, match=r"limits\.jerk: 1 of 3 coordinates have no acc.*give limits\.acceleration"):
        make_controller(robot, frame="z", limits=Limits(jerk=70.0))


@pytest.mark.parametrize(
    ("limits", "said"),
    [
        ({"jerk": {"joint_x": 30.0}}, "jerk of 'joint_x': needs a limit under `acceleration`, too"),
        ({"acceleration": {"joint_x": 3.0}, "jerk": {"joint_x": -1.0}}, "greater than 0"),
        ({"acceleration": {"joint_q": 3.0}, "jerk": {"joint_q": 9.0}}, "joint_q"),
    ],
)
def test_errors_name_the_field(tmp_path, limits, said):
    cartesian(tmp_path)
    with pytest.raises(ConfigError, match=said):
        Robot.from_urdf(tmp_path / "cartesian.urdf", bodies="convex", limits=limits)


def test_a_scenario_says_where_its_jerk_limit_lacks_an_acceleration():
    run = changed("situation1", limits={"jerk": 50.0})
    with pytest.raises(ConfigError, match=r"situation1.*limits\.jerk: 7 of 7"):
        Controller.from_scenario(run)
