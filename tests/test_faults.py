"""Bad input and failing parts in the loop: each ends in a defined way, and the next good tick works again."""

import numpy as np
import pinocchio as pin
import pytest
from closed_loop import Ruler, cartesian, drive, make_controller

from qpavoid import Avoidance, NumericalError, Obstacle, ReasonKind, Sample, Severity, Status, UnknownName
from qpavoid.config import Beta, Box, Sensing, Sphere
from qpavoid.model.sample import Pose

NAN, INF = float("nan"), float("inf")
TOOL = "panda_hand_tcp"
BALL = [0.50, 0.0, 0.75]


def panda_controller(panda, solver="qp", **fields):
    return make_controller(panda, [Obstacle.at("ball", Sphere(radius=0.05), BALL)], TOOL, solver, **fields)


def up(panda):
    """A target towards the ball."""
    return {TOOL: Sample.at([0.50, 0.05, 0.75])}


def with_(value, index, size=7):
    bad = np.zeros(size)
    bad[index] = value
    return bad


def sample(**parts):
    """A sample at (0.5, 0, 0.5), but for some parts, which may be anything."""
    return Sample.at([0.5, 0.0, 0.5])._replace(**parts)


def run(controller, q, ticks, calls=None):
    """A loop in which some ticks are called with other arguments; the velocities, and what was said at those ticks."""
    vs, said = [], {}
    for k in range(ticks):
        call = {"q": q, "t": 0.01 * k, "targets": up(None), **(calls or {}).get(k, {})}
        solution = controller.step(**call)
        vs.append(solution.v)
        if calls and k in calls:
            said[k] = solution
        q = pin.integrate(controller.scene.robot.model, q, 0.01 * solution.v)
    return np.array(vs), said, q


# --- numbers that cannot be true --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("call", "subject"),
    [
        ({"q": np.full(7, NAN)}, ("q",)),
        ({"q": with_(INF, 6)}, ("q",)),
        ({"q": with_(17.0, 3)}, ("q", "panda_joint4")),
        ({"v": with_(NAN, 2)}, ("v",)),
        ({"v": with_(2e4, 0)}, ("v",)),
        ({"t": NAN}, ("t",)),
        ({"t": 1.7e15}, ("t",)),
        ({"targets": {TOOL: sample(position=np.array([0.5, NAN, 0.5]))}}, ("target", TOOL)),
        ({"targets": {TOOL: sample(position=np.array([0.5, 2e6, 0.5]))}}, ("target", TOOL)),
        ({"targets": {TOOL: sample(linear=np.full(3, INF))}}, ("target", TOOL)),
        ({"targets": {TOOL: sample(angular=np.full(3, 2e3))}}, ("target", TOOL)),
        ({"targets": {TOOL: sample(rotation=np.diag([1.0, -1.0, 1.0]))}}, ("target", TOOL)),
        ({"targets": {TOOL: Pose(np.array([0.5, 0.0, 0.5]), 0.5 * np.eye(3))}}, ("target", TOOL)),
    ],
)
def test_implausible_argument_brakes_the_robot_for_a_step(panda, call, subject):
    """The stop is the start of a braking motion: every joint slowed alike, by no more than its acceleration."""
    vs, said, _ = run(panda_controller(panda), panda.home, 30, {12: call})
    assert said[12].status is Status.STOPPED
    reason = said[12].reasons[0]
    assert reason.kind is ReasonKind.IMPLAUSIBLE and reason.severity is Severity.ALARM and reason.subject == subject
    before, at, step = vs[11], vs[12], 0.01 * panda.bounds().acceleration
    assert np.abs(before).max() > 0.1
    shares = at / before
    np.testing.assert_allclose(shares, shares[0], rtol=1e-9)
    assert 0.0 <= shares[0] < 1.0 and (np.abs(at - before) <= step + 1e-12).all()
    assert np.max(np.abs(at - before) / step) == pytest.approx(1.0)
    good, _, _ = run(panda_controller(panda), panda.home, 30)
    assert np.abs(vs[29] - good[29]).max() < 0.1  # it is on its way again
    assert (np.abs(np.diff(vs, axis=0)) <= step + 1e-9).all()


def test_nan_at_rest_changes_nothing_after_it(panda):
    clean, poisoned = panda_controller(panda), panda_controller(panda)
    for k in range(5):
        solution = poisoned.step(np.full(7, NAN), 0.01 * k, up(panda), v=np.full(7, NAN))
        assert solution.status is Status.STOPPED and not solution.v.any()
    expected, _, end = run(clean, panda.home, 40)
    got, _, same = run(poisoned, panda.home, 40)
    np.testing.assert_array_equal(got, expected)
    np.testing.assert_array_equal(same, end)


def test_stop_without_q_ends_inside_the_joint_limits(panda):
    """q is NaN from the moment on at which a joint has just enough room left to brake."""
    controller, q = make_controller(panda, avoidance=Avoidance(d1=0.02, d2=0.1)), panda.home.copy()
    upper, command = panda.model.upperPositionLimit, np.r_[2.0, np.zeros(5), -1.0]
    blind = None
    for k in range(400):
        q_given = np.full(7, NAN) if blind is not None else q
        solution = controller.filter(q_given, command)
        if blind is None and solution.v[0] < 1.5 and q[0] > 2.0:
            blind = k
        q = q + 0.01 * solution.v
        assert q[0] <= upper[0] + 1e-12
    assert blind is not None and not solution.v.any()


# --- malformed calls -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("call", "name"),
    [
        ({"q": np.zeros(6)}, "q: shape"),
        ({"q": "home"}, "q: not"),
        ({"v": np.zeros((7, 1))}, "v: shape"),
        ({"t": "now"}, "t: not a number"),
        ({"t": np.zeros(2)}, "t: not a number"),
        ({"q": [10**400] * 7}, "q: not an array"),
        ({"targets": [TOOL]}, "targets: give a mapping"),
        ({"v": np.ones(7), "obstacles": {"ball": Pose.at([0.4, 0, 0.5]), "typo": Pose.at([1, 0, 0])}}, "no obstacle"),
        ({"t": 99.0, "v": np.ones(7), "targets": {"typo": Pose.at([1, 0, 0])}}, "no target"),
        ({"obstacles": "ball"}, "obstacles: give a mapping"),
        ({"obstacles": {"ball": Sample.at([1, 0, 0], t="now")}}, "obstacle 'ball': t: not a number"),
        ({"obstacles": {"ball": Sample.at([1, 0, 0], linear=[1, 0, 0], at_rest=True)}}, "obstacle 'ball': at_rest"),
        ({"targets": {TOOL: np.eye(3)}}, f"target '{TOOL}': neither"),
        ({"targets": {TOOL: np.triu(np.ones((4, 4))).T}}, f"target '{TOOL}': a 4x4 matrix whose last row"),
        ({"obstacles": {"ball": "there"}}, "obstacle 'ball': neither"),
    ],
)
def test_malformed_step_names_its_argument_and_changes_nothing(panda, call, name):
    touched, clean = panda_controller(panda), panda_controller(panda)
    for k in range(5):
        with pytest.raises((NumericalError, UnknownName), match=f"^{name}"):
            touched.step(**{"q": panda.home, **call})
        got, expected = (c.step(panda.home, 0.01 * k, up(panda)) for c in (touched, clean))
        np.testing.assert_array_equal(got.v, expected.v)


# --- states that jump or lie outside ---------------------------------------------------------------------------


def test_joint_outside_its_limits_is_brought_back(panda):
    controller = make_controller(panda, frame=TOOL)
    q = panda.home.copy()
    q[0], q[3] = panda.model.upperPositionLimit[0] + 0.1, panda.model.lowerPositionLimit[3] - 0.05
    out = [np.inf]
    bounds = panda.bounds()
    for tick in drive(controller, q, 200):
        left = np.maximum(tick.state.q - bounds.upper, bounds.lower - tick.state.q).max(initial=0.0)
        assert left <= out[-1] + 1e-9
        assert (np.abs(tick.solution.v) <= bounds.velocity + 1e-9).all()
        out.append(left)
        said = {reason.subject: reason.amount for reason in tick.solution.assumptions}
        assert all(reason.kind is ReasonKind.LIMIT_RECOVERY for reason in tick.solution.assumptions)
        assert bool(said) == (left > 1e-6) and set(said) <= {("panda_joint1",), ("panda_joint4",)}
        assert max(map(abs, said.values()), default=0.0) == pytest.approx(left, abs=1e-6)
    assert out[1] == pytest.approx(0.1) and out[-1] < 1e-6


def test_configuration_in_degrees_is_a_stop(panda):
    q, bounds = np.rad2deg(panda.home), panda.bounds()
    solution = make_controller(panda, frame=TOOL).step(q)
    assert solution.status is Status.STOPPED and not solution.v.any()
    beyond = np.maximum(q - bounds.upper, bounds.lower - q)
    expected = {("q", f"panda_joint{i + 1}"): beyond[i] for i in np.flatnonzero(beyond > 2 * np.pi)}
    assert {reason.subject: reason.amount for reason in solution.reasons} == pytest.approx(expected)
    assert len(expected) > 2 and {(r.kind, r.unit) for r in solution.reasons} == {(ReasonKind.IMPLAUSIBLE, "rad")}


@pytest.mark.parametrize("seed", range(2))
def test_jumps_of_the_state_keep_to_the_limits(panda, seed):
    """One radian in every joint, again and again: whatever it lands in, also deep in obstacles."""
    rng = np.random.default_rng(seed)
    boxes = [Obstacle.at(f"box{i}", Box(size=(0.3, 0.3, 0.3)), rng.uniform(-0.6, 0.8, 3)) for i in range(4)]
    controller, bounds = make_controller(panda, boxes, TOOL), panda.bounds()
    q, last = panda.home, np.zeros(7)
    for k in range(150):
        solution = controller.step(q, 0.01 * k, up(panda))
        assert np.isfinite(solution.v).all() and (np.abs(solution.v) <= bounds.velocity + 1e-9).all()
        room = np.array([q - bounds.lower, bounds.upper - q])
        outward, before = np.array([-solution.v, solution.v]), np.array([-last, last])
        # a joint that lands outside while it moves outwards brakes as fast as it can
        braking = np.maximum(before - 0.01 * bounds.acceleration, 0.0)
        assert (0.01 * outward <= np.maximum(room, 0.01 * braking * (room < 0.0)) + 1e-9).all()
        last = solution.v
        q = q + 0.01 * last if k % 10 else np.clip(q, bounds.lower, bounds.upper) + rng.uniform(-1.0, 1.0, 7)


# --- obstacles without news ------------------------------------------------------------------------------------


def test_stale_obstacle_moves_on_grows_and_stops_the_robot(tmp_path):
    robot = cartesian(tmp_path)
    sensing = Sensing(stale_after=0.2, stop_after=0.5)
    controller = make_controller(
        robot, [Obstacle.at("ball", Sphere(radius=0.05), [0.0, 3.0, 0.0])], "z", sensing=sensing
    )
    coming = np.array([-0.1, 0.0, 0.0])

    def news(t):  # two times, then silence until 1 s
        sample = Sample.at(np.array([0.5, 0.0, 0.0]) + coming * t, linear=coming)
        return {"ball": sample} if t < 0.015 or t > 0.995 else None

    stopped = []
    for k, tick in enumerate(drive(controller, np.zeros(3), 150, target=[0.0, 0.0, 0.0], obstacles=news)):
        age = 0.01 * (k - 1) if k < 100 else 0.0
        margin = 0.1 * max(age - 0.2, 0.0)
        if age > 0.2 + 1e-9:
            (stale,) = tick.solution.assumptions
            assert stale.kind is ReasonKind.STALE and stale.subject == ("ball",) and stale.severity is Severity.WARNING
            assert stale.amount == pytest.approx(age)
        gap = np.linalg.norm(tick.state.q - [0.5 - 0.001 * k, 0.0, 0.0]) - 0.1
        if len(tick.proximity.pair):
            assert gap > 0.0198
            assert tick.proximity.distance[0] == pytest.approx(gap, abs=1e-9)
            assert tick.problem.avoidance.d[0] == pytest.approx(gap - margin, abs=1e-9)
            assert tick.proximity.feedforward[0] <= 0.0
        stopped.append(tick.solution.status is Status.STOPPED)
        assert stopped[-1] == (age > 0.5 + 1e-9)
        if stopped[-1]:
            (late,) = tick.solution.reasons
            assert late.kind is ReasonKind.STALE and late.severity is Severity.ALARM
            assert late.amount == pytest.approx(age)
    assert sum(stopped) == 48 and not stopped[100]


def test_nan_from_an_obstacle_counts_as_no_update(tmp_path):
    robot, coming = cartesian(tmp_path), Sample.at([0.3, 0.0, 0.0], linear=[-0.2, 0.0, 0.0])
    loops = []
    for bad in (None, {"ball": Sample(np.full(3, NAN), np.eye(3), np.zeros(3), np.zeros(3))}):
        controller = make_controller(robot, [Obstacle.at("ball", Sphere(radius=0.05), [0.3, 0.0, 0.0])], "z")

        def updates(t, bad=bad):
            return {"ball": coming} if t < 0.005 else bad

        ticks = drive(controller, np.zeros(3), 100, target=[0.1, 0.0, 0.0], obstacles=updates)
        loops.append(np.array([tick.solution.v for tick in ticks]))
    np.testing.assert_array_equal(*loops)
    assert loops[0].min() < -0.15  # pushed back by where it is expected


# --- ticks that are held too long or too short -----------------------------------------------------------------


@pytest.mark.parametrize("seed", range(2))
def test_jitter_of_the_period_costs_no_more_than_a_step(panda, seed):
    rng = np.random.default_rng(seed)
    wall = Obstacle.at("wall", Box(size=(0.02, 1.0, 1.0)), [0.50, 0.0, 0.5])
    tight = Avoidance(d1=0.02, d2=0.1, row=Beta(gain=20.0, near_speed=10.0))
    controller = make_controller(panda, [wall], TOOL, avoidance=tight)
    ruler, bounds = Ruler(controller.scene), panda.bounds()
    least, fastest = np.inf, 0.0
    for tick in drive(
        controller, panda.home, 250, target=[0.65, 0.0, 0.5], hold=lambda k: 0.01 * rng.uniform(0.5, 1.5)
    ):
        least = min(least, ruler.distances(tick.state.q).min())
        out = np.maximum(tick.state.q - bounds.upper, bounds.lower - tick.state.q).max()
        assert out <= 0.005 * bounds.velocity.max()
        if len(tick.proximity.J):
            fastest = max(fastest, -float(np.min(tick.proximity.J @ tick.solution.v)))
    assert 0.02 - 0.01 * fastest < least < 0.021
    assert fastest < 0.6 and tick.proximity.distance.min() > 0.018
