"""Recovery: robots rest at home; what is too near parts slowly, unless something comes."""

import numpy as np
import pinocchio as pin
import pytest
from closed_loop import accelerations, make_controller
from conftest import EXAMPLES

from qpavoid import Obstacle, ReasonKind, Robot, Sample, Status
from qpavoid.config import Sphere
from qpavoid.model.notes import NoteKind, RobotWarning

SHIPPED = ["panda", "ur5", "baxter", "g1", "tiago", "paper-dual-arm"]
BARE = {
    "ur10": "ur_description/urdf/ur10_robot.urdf",
    "so101": "so_arm_description/urdf/so101.urdf",
    "xarm7": "xarm_description/urdf/xarm7.urdf",
}
"""Of example-robot-data: their zero or middle pose is nearer to itself than the default d1."""
BALL = Sphere(radius=0.06)
D1 = 0.02


def bare(name):
    """A URDF as it is, and what is said of it."""
    with pytest.warns(RobotWarning) as caught:
        robot = Robot.from_urdf(EXAMPLES / BARE[name])
    return robot, " | ".join(str(warning.message) for warning in caught)


def stay(robot, q, ticks, obstacles=(), given=None, dt=0.01, **fields):
    """Solutions of a loop from rest at q whose task is to stay there, where it ends, and the distances [m]."""
    frame = robot.end_effectors[0]
    controller = make_controller(robot, obstacles, frame, dt=dt, **fields)
    place = tool(robot, frame, q)
    solutions, nearest = [], []
    for k in range(ticks):
        now = None if given is None else given(k * dt)
        tick = controller.tick(q, k * dt, {frame: Sample.at(place)}, now)
        nearest.append(tick.proximity.distance.min(initial=np.inf))
        solutions.append(tick.solution)
        q = pin.integrate(robot.model, q, dt * tick.solution.v)
    return solutions, q, np.array(nearest)


def tool(robot, frame, q):
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, q)
    return data.oMf[robot.model.getFrameId(frame)].translation.copy()


def speeds(solutions):
    """Largest speed of a joint in each control step."""
    return np.abs([solution.v for solution in solutions]).max(axis=1)


# --- home --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [*SHIPPED, *BARE])
def test_robots_rest_at_home(name):
    """With defaults: neither the first step nor any other one moves a joint."""
    robot = bare(name)[0] if name in BARE else Robot.load(name)
    solutions, *_ = stay(robot, robot.home, 100, avoidance=None)
    assert speeds(solutions).max() < 1e-3
    assert {solution.status for solution in solutions} == {Status.SOLVED}


def test_what_is_near_at_home_is_named_and_keeps_that_distance():
    """A warning names the pairs of a bare URDF, whose safety distances are a millimetre less than at home."""
    robot, said = bare("ur10")
    near = robot.near_at_home(0.03)
    assert [round(1e3 * d) for *_, d in near] == [19, 19, 20]
    for a, b, d in near:
        assert f"{a} - {b} ({1e3 * d:.1f} mm)" in said
        assert robot.safety_distance(a, b, 0.03) == robot.safety_distance(b, a, 0.03) == pytest.approx(d - 1e-3)
        assert robot.safety_distance(a, b, 0.01) == 0.01
    assert robot.near_at_home(0.01) == []
    g1 = Robot.load("g1")  # whose home pose was chosen: no warning, but a note
    (note,) = [note for note in g1.notes if note.kind is NoteKind.HOME]
    assert note.severity == "note" and len(note.subject) == len(g1.near_at_home(0.03)) == 4


# --- pairs that are too near -------------------------------------------------------------------------------------


def ball_near(robot, frame, gap):
    """A ball below the tool whose surface is `gap` from the nearest body at home."""
    place, low, high = tool(robot, frame, robot.home), 0.05, 0.3
    for _ in range(30):
        middle = 0.5 * (low + high)
        ball = Obstacle.at("ball", BALL, place + np.array([middle, 0.0, 0.0]))
        d = make_controller(robot, [ball]).tick(robot.home).proximity.distance.min(initial=1.0)
        low, high = (middle, high) if d < gap else (low, middle)
    return Obstacle.at("ball", BALL, place + np.array([high, 0.0, 0.0]))


@pytest.mark.parametrize("gap", [0.002, 0.010])
@pytest.mark.parametrize(("name", "frame"), [("panda", "panda_hand_tcp"), ("ur5", "tool0")])
def test_recovery_from_what_rests_is_slow(name, frame, gap):
    """The ball lies there at the start: no joint is faster than 0.2 rad/s while it is nearer than 2 mm below d1."""
    robot = Robot.load(name)
    ball = ball_near(robot, frame, gap)
    solutions, _, d = stay(robot, robot.home, 300, [ball])
    deep = d < D1 - 2e-3
    assert deep[:20].all() and speeds(solutions)[deep].max() <= 0.2 + 1e-9
    assert d.min() == pytest.approx(gap, abs=1e-4) and d[-1] == pytest.approx(D1, abs=1e-3)
    slowed = [solution for solution in solutions if solution.command_scale < 1.0]
    assert len(slowed) > 10
    for solution in slowed:
        assert solution.status is Status.RELAXED
        assert ReasonKind.BELOW_SAFETY_DISTANCE in {reason.kind for reason in solution.reasons}


def test_what_comes_is_evaded_at_full_speed(panda):
    """The same ball, coming at 0.3 m/s: the arm leaves as fast as it can, beyond the speed of recovery."""
    ball = ball_near(panda, "panda_hand_tcp", 0.010)
    start = ball.motion.sample(0.0).position

    def given(t):
        return {"ball": Sample.at(start - [0.3 * t, 0.0, 0.0], linear=[-0.3, 0.0, 0.0])}

    solutions, _, d = stay(panda, panda.home, 60, [ball], given)
    assert speeds(solutions).max() > 0.5 and d.min() > 0.0
    assert accelerations([s.v for s in solutions], 0.01).max() <= panda.bounds().acceleration.max() + 1e-6


# --- joints beyond their limits ----------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "dt"), [("panda", 0.01), ("ur5", 0.01), ("ur5", 0.002)])
@pytest.mark.parametrize("side", [-1, 1])
def test_a_joint_outside_its_limit_comes_back_slowly(name, dt, side):
    """3° outside, with a task that holds the tool: while it is 2 mrad outside or more, no joint exceeds 0.2 rad/s."""
    robot = Robot.load(name)
    bounds, q = robot.bounds(), robot.home.copy()
    joint, edge = bounds.q_index[0], (bounds.upper if side > 0 else bounds.lower)[0]
    q[joint] = edge + side * np.radians(3.0)
    solutions, q_end, _ = stay(robot, q, round(3.0 / dt), dt=dt)
    excess = [
        max([abs(r.amount) for r in (*s.reasons, *s.assumptions) if r.kind is ReasonKind.LIMIT_RECOVERY], default=0.0)
        for s in solutions
    ]
    outside = np.array(excess) > 2e-3
    assert outside[0] and not outside[-1]
    assert speeds(solutions)[outside].max() <= 0.2 + 1e-9
    assert side * (q_end[joint] - edge) <= 1e-6
    recovering = [s for s, is_outside in zip(solutions, outside, strict=True) if is_outside]
    assert all(s.command_scale == 1.0 or s.status is Status.RELAXED for s in recovering)
