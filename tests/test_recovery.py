"""Recovery: robots rest at home; what is too near parts slowly, unless something comes."""

import numpy as np
import pinocchio as pin
import pytest
from closed_loop import accelerations, cartesian, drive, make_controller
from conftest import EXAMPLES

from qpavoid import (
    Avoidance,
    Controller,
    Limits,
    Obstacle,
    Pose,
    ReasonKind,
    Robot,
    Sample,
    Status,
    build_scene,
    build_tasks,
)
from qpavoid.config import Box, HalfSpace, Sphere, Task
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


def is_said(solution):
    """Whether a step is RELAXED, with what the robot recovers from as a reason."""
    kinds = {reason.kind for reason in solution.reasons}
    return solution.status is Status.RELAXED and bool(
        kinds & {ReasonKind.BELOW_SAFETY_DISTANCE, ReasonKind.LIMIT_RECOVERY}
    )


def chatter(solutions, steps):
    """Mean of Σ|Δv| over the last steps [rad/s]."""
    return np.abs(np.diff([solution.v for solution in solutions[-steps - 1 :]], axis=0)).sum(axis=1).mean()


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
    beyond = (accelerations([s.v for s in solutions], 0.01) > panda.bounds().acceleration + 1e-3).any(axis=1)
    for k in np.flatnonzero(beyond):  # before contact, and said
        assert ReasonKind.ACCELERATION_RELAXED in {reason.kind for reason in solutions[k].reasons}


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


# --- whatever is wrong at the start -------------------------------------------------------------------------------


def bad_start(robot, rng):
    """A configuration in self-penetration or with a joint outside its limits, and a ball or box in the tool, or not."""
    bounds, q = robot.bounds(), robot.home.copy()
    kind = rng.choice(["itself", "limit", "obstacle", "limit and obstacle"])
    if kind == "itself":
        data, bodies = robot.model.createData(), robot.bodies.createData()
        low, high = np.maximum(bounds.lower, -2.5), np.minimum(bounds.upper, 2.5)
        while True:
            q[bounds.q_index] = rng.uniform(low, high)
            pin.computeDistances(robot.model, data, robot.bodies, bodies, q)
            if -0.02 < min(result.min_distance for result in bodies.distanceResults) < 0.0:
                return q, []
    if "limit" in kind:
        joint = rng.choice([0, len(bounds.q_index) - 1])
        side = rng.choice([-1, 1])
        edge = (bounds.upper if side > 0 else bounds.lower)[joint]
        q[bounds.q_index[joint]] = edge + side * 10.0 ** rng.uniform(-2.5, -0.7)
    if "obstacle" not in kind:
        return q, []
    shape = [Sphere(radius=0.06), Box(size=(0.1, 0.3, 0.1))][rng.integers(2)]
    way = tool(robot, robot.end_effectors[0], q) * [1.0, 1.0, 0.0]
    place = tool(robot, robot.end_effectors[0], q) + 0.07 * way / np.linalg.norm(way) + np.array([0.0, 0.0, -0.02])
    return q, [Obstacle.at("it", shape, place)]


@pytest.mark.parametrize("name", ["panda", "ur5"])
@pytest.mark.parametrize(
    "limits",
    [Limits(), Limits(acceleration=5.0), Limits(acceleration=5.0, jerk=50.0)],
    ids=["speed", "acceleration", "jerk"],
)
def test_bad_starts_are_left_slowly_and_it_is_said(name, limits):
    """While a pair is nearer than 2 mm below d1 or a joint 2 mrad outside: no joint is faster than 0.2 rad/s, and each
    step says it. After that the robot is clear and at rest, by steps of its accelerations.
    """
    robot, rng = Robot.load(name), np.random.default_rng(3)
    for _ in range(5):
        q, obstacles = bad_start(robot, rng)
        solutions, _, d = stay(robot, q, 600, obstacles, avoidance=Avoidance(d1=D1, d2=0.1), limits=limits)
        outside = [
            any(r.kind is ReasonKind.LIMIT_RECOVERY and abs(r.amount) > 2e-3 for r in (*s.reasons, *s.assumptions))
            for s in solutions
        ]
        bad = (d < D1 - 2e-3) | np.array(outside)
        assert bad[0] and not bad[-100:].any()
        assert speeds(solutions)[bad].max() <= (0.2 + 1e-9 if limits.jerk is None else 0.205)
        assert all(is_said(solution) for solution, is_bad in zip(solutions, bad, strict=True) if is_bad)
        assert solutions[-1].status is Status.SOLVED and chatter(solutions, 50) <= 0.05


@pytest.mark.parametrize("how", ["added", "first seen"])
@pytest.mark.parametrize("name", ["panda", "ur5"])
def test_obstacle_that_turns_up_too_near_is_left_slowly(name, how):
    """An obstacle comes out of nowhere, 16 mm from the tool or in it: the robot does not lurch, and says why."""
    robot, dt = Robot.load(name), 0.01
    frame = robot.end_effectors[0]
    tasks = build_tasks([Task(frame=frame)], robot, robot.home)
    place = tool(robot, frame, robot.home) + np.array([0.07, 0.0, -0.03])
    unseen = [] if how == "added" else [Obstacle.at("ball", BALL, [5.0, 0.0, 0.0])]
    controller, q, solutions = Controller(build_scene(robot, unseen, spare_obstacles=1), tasks, dt=dt), robot.home, []
    for k in range(500):
        if k == 20 and how == "added":
            controller.add_obstacle(Obstacle.at("ball", BALL, place))
        update = {"ball": Pose.at(place)} if k >= 20 and how == "first seen" else None
        tick = controller.tick(q, k * dt, obstacles=update)
        if k == 20:
            assert tick.proximity.distance.min() < 0.016
        if k >= 20 and tick.proximity.distance.min() < 0.03 - 2e-3:
            assert is_said(tick.solution) and np.abs(tick.solution.v).max() <= 0.2 + 1e-9
        solutions.append(tick.solution)
        q = pin.integrate(robot.model, q, dt * tick.solution.v)
    assert tick.proximity.distance.min() > 0.03 - 1e-3 and solutions[-1].status is Status.SOLVED
    assert chatter(solutions, 50) <= 0.05


def test_ball_that_jitters_is_left_slowly_too():
    """Poses of a ball at rest with 1 mm of noise, at 30 Hz, are no motion that has to be evaded at full speed."""
    robot, rng, dt = Robot.load("ur5"), np.random.default_rng(5), 0.01
    place = tool(robot, "tool0", robot.home) + np.array([0.05, 0.0, -0.03])
    controller, q, worst = make_controller(robot, [Obstacle.at("ball", BALL, place)], "tool0"), robot.home, 0.0
    for k in range(300):
        seen = int(30 * k * dt + 1e-9) > int(30 * (k - 1) * dt + 1e-9) or k == 0
        update = {"ball": Pose.at(place + 1e-3 * rng.normal(size=3))} if seen else None
        tick = controller.tick(q, k * dt, obstacles=update)
        if tick.proximity.distance.min() < D1 - 2e-3:
            worst = max(worst, np.abs(tick.solution.v).max())
        q = pin.integrate(robot.model, q, dt * tick.solution.v)
    assert 0.1 < worst < 0.6 and tick.proximity.distance.min() > D1 - 5e-3


def test_floor_that_no_joint_leaves_slows_nothing_down(tmp_path):
    """A tool on rails 10 mm above a table: round a ball it is as fast as without it, and has nothing to say."""
    robot, runs = cartesian(tmp_path, axes="xy"), []
    ball = Obstacle.at("ball", BALL, [0.3, 0.02, 0.0])
    table = Obstacle.at("table", HalfSpace(), [0.0, 0.0, -0.06])
    for obstacles in ([ball], [ball, table]):
        controller = make_controller(robot, obstacles, "y", avoidance=Avoidance(d1=D1, d2=0.1))
        ticks = list(drive(controller, robot.home, 300, target=[0.6, -0.1, 0.0]))
        assert {tick.solution.status for tick in ticks} == {Status.SOLVED}
        runs.append([tick.solution.v for tick in ticks])
    assert ticks[-1].proximity.distance.min() < D1 - 5e-3 and np.abs(runs[0]).max() > 0.4
    np.testing.assert_allclose(runs[1], runs[0], atol=1e-6)
