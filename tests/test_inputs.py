"""What a control step is given: time, stamps, who has to update, laws, and calls that are refused."""

import copy
import pickle

import numpy as np
import pinocchio as pin
import pytest
from closed_loop import cartesian, changed, drive, make_controller

from qpavoid import (
    Avoidance,
    ConfigError,
    Controller,
    NumericalError,
    Obstacle,
    Points,
    Pose,
    Reason,
    ReasonKind,
    Robot,
    Sample,
    Sensing,
    Severity,
    Solution,
    Solver,
    Status,
    build_scene,
    build_tasks,
    kernels,
    make_solver,
)
from qpavoid.config import (
    AlignTask,
    ComTask,
    DampingTask,
    HalfSpace,
    Limits,
    LookAtTask,
    PointCloud,
    PostureTask,
    Sphere,
    Task,
)
from qpavoid.control.distances import DistanceQuery
from qpavoid.control.inputs import Clock

TOOL = "panda_hand_tcp"
BALL = Obstacle.at("ball", Sphere(radius=0.05), [0.6, 0.0, 0.5])


def keys(solution):
    return {reason.key for reason in (*solution.reasons, *solution.assumptions)}


def of_kind(solution, kind):
    return [reason for reason in (*solution.reasons, *solution.assumptions) if reason.kind is kind]


# --- time ---------------------------------------------------------------------------------------------------------


def test_time_left_out_is_a_period_after_the_step_before(panda):
    controller = make_controller(panda, frame=TOOL)
    for k in range(50):
        tick = controller.tick(panda.home)
        assert tick.state.t == pytest.approx(k * controller.dt, abs=1e-9)
        assert not of_kind(tick.solution, ReasonKind.TIMING)


@pytest.mark.parametrize(
    ("step", "off", "severity"),
    [(0.0149, None, None), (0.0051, None, None), (0.02, 0.01, Severity.WARNING), (0.002, -0.008, Severity.INFO),
     (-3.0, -3.01, Severity.INFO), (2.0, 1.99, Severity.WARNING)],
)  # fmt: skip
@pytest.mark.parametrize("begin", [0.0, 1.7e9])
def test_time_off_by_more_than_half_a_period_is_a_reason(panda, begin, step, off, severity):
    controller = make_controller(panda, frame=TOOL)
    assert not controller.step(panda.home, begin).assumptions
    said = controller.step(panda.home, begin + step).assumptions
    if off is None:
        assert not said
    else:
        (reason,) = said
        assert reason.key == ("TIMING", ("t",)) and reason.unit == "s" and reason.severity is severity
        assert reason.amount == pytest.approx(off, abs=1e-6)
    assert not controller.step(panda.home, begin + step + 0.01).assumptions


@pytest.mark.parametrize(("pause", "rests"), [(0.02, False), (0.099, False), (0.11, True), (2.0, True), (-1.0, True)])
def test_velocity_after_a_gap_starts_from_rest(panda, pause, rests):
    """The first command is one acceleration away from rest, not from what was commanded before the pause."""
    controller, limit = make_controller(panda), 0.01 * panda.bounds().acceleration
    v = np.zeros(7)
    for k in range(20):
        v = controller.filter(panda.home, np.full(7, 0.8), 0.01 * k).v
    assert (v > 2.0 * limit).any()
    after = controller.filter(panda.home, np.full(7, 0.8), 0.19 + pause).v
    from_rest = np.abs(after) <= limit + 1e-12
    assert from_rest.all() if rests else not from_rest.all()
    measured = np.full(7, 0.3)
    again = controller.filter(panda.home, np.full(7, 0.8), 9.0, v=measured).v
    assert (np.abs(again - measured) <= limit + 1e-12).all()


@pytest.mark.parametrize("dt", [1e-4, 1e-3, 0.01, 1.0])
def test_clock_refuses_times_that_do_not_resolve_a_period(dt):
    clock = Clock(dt)
    assert bool(clock.read(1.7e9).faults) == (dt < 2e-4)
    assert not clock.read(1e3).faults and clock.read(1e3).t == 1e3
    for t in (1.7e15, 1e300, np.inf, np.nan, 10**400):
        times = clock.read(t)
        assert times.faults[0].key == ("IMPLAUSIBLE", ("t",)) and times.t == 0.0
    clock.set(5.0)
    assert clock.read(np.nan).t == 5.0 + dt  # it goes on
    for t in ("5", [1.0, 2.0], 1j, {}):
        with pytest.raises(NumericalError, match=r"^t: not a number"):
            clock.read(t)


# --- time stamps ---------------------------------------------------------------------------------------------------


def drifts(controller, q, t, what):
    """Rates of the distances to obstacles, over what the normals say of a unit velocity along x."""
    tick = controller.tick(q, t, None, what)
    of_ball = controller.scene.pairs[tick.proximity.pair, 1] >= len(controller.scene.body_names)
    assert of_ball.any()
    return tick.proximity.feedforward[of_ball] / tick.proximity.normal[of_ball, 0], tick.solution


def test_time_stamps_of_obstacles_give_their_twists(panda):
    """Of a camera that is 30 ms late and comes every 25 ms: the twist is right, and the ball is where it is now."""
    controller, speed = make_controller(panda, [BALL], avoidance=Avoidance(d1=0.02, d2=0.6)), -0.1
    seen = None
    for k in range(60):
        t = 0.005 * k
        if k % 5 == 0:
            stamp = t - 0.03
            seen = {"ball": Pose.at([0.6 + speed * stamp, 0.0, 0.5], t=stamp)}
        found, solution = drifts(controller, panda.home, t, seen)
        if k % 5:
            assert ("IGNORED", ("ball",)) in keys(solution)  # of the same stamp: not used again, and said
        if k >= 5:
            np.testing.assert_allclose(found, speed, atol=1e-9)
            place = controller.obstacle_pose("ball").position
            np.testing.assert_allclose(place, [0.6 + speed * t, 0.0, 0.5], atol=1e-9)


def test_time_stamps_out_of_order_or_of_the_future_are_ignored(panda):
    controller = make_controller(panda, [BALL])
    controller.step(panda.home, 1.0, None, {"ball": Pose.at([0.6, 0.0, 0.5], t=0.95)})
    for stamp, kind in ((0.9, "IGNORED"), (0.95, "IGNORED"), (1.5, "IMPLAUSIBLE"), (np.nan, "IMPLAUSIBLE"),
                        (np.inf, "IMPLAUSIBLE"), (-np.inf, "IGNORED")):  # fmt: skip
        solution = controller.step(panda.home, 1.0, None, {"ball": Pose.at([0.4, 0.0, 0.5], t=stamp)})
        assert (kind, ("ball",)) in keys(solution) and solution.status is not Status.STOPPED
        np.testing.assert_array_equal(controller.obstacle_pose("ball").position, [0.6, 0.0, 0.5])
    solution = controller.step(panda.home, 1.01, None, {"ball": Pose.at([0.59, 0.0, 0.5], t=1.0)})
    np.testing.assert_allclose(controller.obstacle_pose("ball").position, [0.588, 0.0, 0.5], atol=1e-12)


def test_ages_increase_where_the_clock_is_set_back(panda):
    controller = make_controller(panda, [BALL], sensing=Sensing(stale_after=0.1))
    moving = {"ball": Sample.at([0.9, 0.0, 0.5], linear=[0.1, 0.0, 0.0])}
    controller.step(panda.home, 100.0, None, moving)
    ages = []
    for k in range(20):
        ages += [r.amount for r in of_kind(controller.step(panda.home, 0.01 * k), ReasonKind.STALE)]
    np.testing.assert_allclose(ages, 0.01 * np.arange(11, 21), atol=1e-9)
    np.testing.assert_allclose(controller.obstacle_pose("ball").position, [0.92, 0.0, 0.5], atol=1e-9)


def test_poses_too_far_apart_are_implausible(panda):
    controller = make_controller(panda, [BALL], dt=0.001)
    controller.step(panda.home, 0.0, None, {"ball": Pose.at([0.6, 0.0, 0.5])})
    solution = controller.step(panda.home, 0.001, None, {"ball": Pose.at([2.6, 0.0, 0.5])})
    assert ("IMPLAUSIBLE", ("ball",)) in keys(solution)
    np.testing.assert_array_equal(controller.obstacle_pose("ball").position, [0.6, 0.0, 0.5])


# --- who has to be updated -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("dt", [0.002, 0.01, 0.3])
def test_stale_obstacle_stops_the_robot(panda, dt):
    controller = make_controller(panda, [BALL], dt=dt)
    far, first = Sample.at([2.0, 0.0, 0.5]), {}
    for k in range(600):
        solution = controller.step(panda.home, k * dt, None, {"ball": far} if k == 0 else None)
        for kind, said in (("stale", solution.assumptions), ("stop", solution.reasons)):
            if ("STALE", ("ball",)) in {reason.key for reason in said}:
                first.setdefault(kind, k * dt)
        assert (solution.status is Status.STOPPED) == ("stop" in first)
    stale, stop = max(0.1, 3 * dt), max(0.5, 3 * dt)
    assert stale < first["stale"] <= stale + dt + 1e-9 and stop < first["stop"] <= stop + dt + 1e-9
    assert controller.step(panda.home, 600 * dt, None, {"ball": far}).status is Status.SOLVED


@pytest.mark.parametrize(
    "what",
    [Sample.at([2.0, 0.0, 0.5], at_rest=True), Pose.at([2.0, 0.0, 0.5], at_rest=True),
     Points(np.full((3, 3), 2.0), at_rest=True), Points(np.zeros((1, 3)), Sample.at([2.0, 0.0, 0.5], at_rest=True))],
)  # fmt: skip
def test_obstacle_given_at_rest_is_never_stale(panda, what):
    shape = PointCloud() if isinstance(what, Points) else Sphere(radius=0.05)
    controller = make_controller(panda, [Obstacle.at("it", shape, [3.0, 0.0, 0.5])])
    for t in (0.0, 0.01, 5.0, 100.0):
        solution = controller.step(panda.home, t, None, {"it": what} if t == 0.0 else None)
        assert solution.status is Status.SOLVED and not of_kind(solution, ReasonKind.STALE)
    moving = (
        Points(np.zeros((1, 3)), Sample.at([2.0, 0.0, 0.5])) if isinstance(what, Points) else Sample.at([2, 0, 0.5])
    )
    controller.step(panda.home, 101.0, None, {"it": moving})  # from now on it has to be updated
    assert controller.step(panda.home, 103.0).status is Status.STOPPED


def test_obstacles_of_the_scene_are_never_stale(panda):
    controller, q = Controller.from_scenario(changed("moving_sphere"))
    for t in (0.0, 0.5, 50.0):
        assert not of_kind(controller.step(q, t), ReasonKind.STALE)
    rest = make_controller(panda, [BALL])
    assert rest.step(panda.home, 0.0).status is rest.step(panda.home, 50.0).status is Status.SOLVED


def test_sensing_without_stale_after_has_no_stale_obstacle(panda):
    controller = make_controller(panda, [BALL], sensing=Sensing(stale_after=None))
    assert controller.step(panda.home, 0.0, None, {"ball": Sample.at([2, 0, 0.5])}).status is Status.SOLVED
    solution = controller.step(panda.home, 500.0)
    assert solution.status is Status.SOLVED and not of_kind(solution, ReasonKind.STALE)
    assert Sensing(stale_after=0.2).stop_after == 1.0 and Sensing(stale_after=None).stop_after is None
    assert Sensing().stop_after == 0.5 and Sensing(stale_after=0.2, stop_after=None).stop_after is None
    assert Sensing.model_validate(Sensing(stale_after=2.0).model_dump()) == Sensing(stale_after=2.0)


def test_external_obstacle_is_a_reason_until_it_is_given(panda):
    with pytest.raises(ValueError, match="external obstacle has no motion"):
        motion = {"type": "line", "start": [2, 0, 1], "end": [3, 0, 1], "speed": 1}
        changed("panda_line", obstacles=[{"name": "ball", "shape": {"type": "sphere", "radius": 0.05},
                                          "source": "external", "motion": motion}])  # fmt: skip
    ball = Obstacle.at("ball", Sphere(radius=0.05), [2.0, 0.0, 0.5], external=True)
    controller = make_controller(panda, [ball])
    for _ in range(2):
        for k in range(60):
            solution = controller.step(panda.home, 7.0 + 0.01 * k)
            (reason,) = [r for r in solution.assumptions if r.kind is ReasonKind.NEVER_UPDATED]
            assert reason.subject == ("ball",) and reason.amount == pytest.approx(0.01 * k, abs=1e-9)
            assert (solution.status is Status.STOPPED) == (k > 50)
            if k > 50:
                (stop,) = solution.reasons
                assert stop.key == ("NEVER_UPDATED", ("ball",)) and stop.severity is Severity.ALARM
        given = controller.step(panda.home, 7.6, None, {"ball": Sample.at([2.0, 0.0, 0.5])})
        assert given.status is Status.SOLVED and not of_kind(given, ReasonKind.NEVER_UPDATED)
        controller.reset()


# --- rotations and configurations -----------------------------------------------------------------------------------

BAD = {"zeros": np.zeros((3, 3)), "half": 0.5 * np.eye(3), "mirrored": np.diag([1.0, -1.0, 1.0])}


@pytest.mark.parametrize("kind", BAD)
def test_obstacle_without_a_rotation_is_stale(panda, kind):
    controller = make_controller(panda, [Obstacle.at("box", Sphere(radius=0.05), [0.6, 0.0, 0.5])])
    controller.step(panda.home, 0.0, None, {"box": Sample.at([0.6, 0.0, 0.5])})
    for k in range(1, 100):
        bad = Sample.at([0.1, 0.0, 0.5], BAD[kind])
        solution = controller.step(panda.home, 0.01 * k, None, {"box": bad})
        (reason,) = of_kind(solution, ReasonKind.IMPLAUSIBLE)
        assert reason.subject == ("box",) and ("left-handed" in reason.detail) == (kind == "mirrored")
        np.testing.assert_array_equal(controller.obstacle_pose("box").position, [0.6, 0.0, 0.5])
        assert (solution.status is Status.STOPPED) == (k > 50)
    with pytest.raises(ConfigError, match="rotation"):
        Obstacle.at("box", Sphere(radius=0.05), [0, 0, 0], BAD[kind])


def test_rotation_with_round_off_is_normalised(panda):
    """A target and an obstacle that are off by less than 1e-3 count as the rotations next to them."""
    nearly = pin.exp3(np.array([0.1, 0.2, 0.3]))
    off = nearly @ (np.eye(3) + np.diag([4e-4, 0.0, 0.0]))
    loops = []
    for R in (nearly, off):
        tasks = build_tasks([Task(frame=TOOL, type="pose")], panda, panda.home)
        controller = Controller(build_scene(panda, [Obstacle.at("half", HalfSpace(), [0, 0, -1])]), tasks)
        tick = controller.tick(panda.home, 0.0, {TOOL: Sample.at([0.5, 0.1, 0.5], R)},
                               {"half": Sample.at([0, 0, -0.2], R)})  # fmt: skip
        said = {r.subject: r.amount for r in of_kind(tick.solution, ReasonKind.NORMALISED)}
        subjects = (("half",), ("target", TOOL))
        amount = np.abs(off.T @ off - np.eye(3)).max()
        assert said == ({} if R is nearly else pytest.approx(dict.fromkeys(subjects, amount)))
        assert tick.solution.status is not Status.STOPPED
        loops.append((tick.solution.v, tick.proximity.distance))
    for a, b in zip(*loops, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-9)


def robots():
    """With a quaternion, and with cosine and sine of a planar base: where these stand in q."""
    yield Robot.load("g1"), slice(3, 7), "root_joint"
    tiago = Robot.load("tiago")
    for joint, name in zip(tiago.model.joints, tiago.model.names, strict=True):
        if joint.shortname() == "JointModelPlanar":
            yield tiago, slice(joint.idx_q + 2, joint.idx_q + 4), name


def test_quaternion_of_q_is_normalised_or_refused():
    count = 0
    for robot, part, name in robots():
        controller, q, count = make_controller(robot), robot.home.copy(), count + 1
        good = controller.step(q)
        assert good.status is not Status.STOPPED
        controller.reset()
        q[part] *= 1.0005
        near = controller.step(q)
        (reason,) = of_kind(near, ReasonKind.NORMALISED)
        assert reason.subject == ("q", name) and reason.amount == pytest.approx(5e-4)
        np.testing.assert_allclose(near.v, good.v, atol=1e-9)
        assert np.linalg.norm(q[part]) > 1.0004  # the caller's own is left alone
        for factor in (0.5, 0.0, 1.002):
            q = robot.home.copy()
            q[part] *= factor
            stop = controller.step(q)
            assert stop.status is Status.STOPPED
            assert stop.reasons[0].key == ("IMPLAUSIBLE", ("q", name))
        assert controller.step(robot.home).status is not Status.STOPPED
    assert count >= 2


# --- calls that are refused, and what is not ours --------------------------------------------------------------------


def test_samples_refuse_what_is_no_position():
    for make in (Sample.at, Pose.at):
        for bad in ([0.0, 0.0], "here", [np.nan, 0.0, 0.0], [10**400, 0, 0]):
            with pytest.raises(NumericalError, match=r"^position"):
                make(bad)
    with pytest.raises(ConfigError, match="'ball': position"):
        Obstacle.at("ball", Sphere(radius=0.1), [0.0, 0.0])


def row_tasks():
    hand = "panda_hand"
    return [
        PostureTask(), DampingTask(joints=["panda_joint1"]), ComTask(),
        AlignTask(frame=hand, axis=(0, 0, 1), direction=(0, 0, -1)),
        LookAtTask(frame=hand, axis=(0, 0, 1), motion={"type": "fixed", "position": (0.6, 0.1, 0.1)}),
    ]  # fmt: skip


def test_controllers_may_share_tasks(panda):
    """Each follows its own targets, whenever the other one was made."""
    tasks, scene, rng = build_tasks(row_tasks(), panda, panda.home), build_scene(panda), np.random.default_rng(0)
    alone = [Controller(scene, build_tasks(row_tasks(), panda, panda.home)) for _ in range(2)]
    shared = [Controller(scene, tasks), Controller(scene, tasks)]
    for k in range(20):
        for a, b in zip(alone, shared, strict=True):
            q = panda.home + rng.uniform(-0.2, 0.2, 7)
            targets = {"posture": panda.home + rng.uniform(-0.5, 0.5, 7)}
            expected, found = (c.tick(q, 0.01 * k, targets) for c in (a, b))
            np.testing.assert_array_equal(found.solution.v, expected.solution.v)
            np.testing.assert_array_equal(found.problem.tracking.b, expected.problem.tracking.b)
            np.testing.assert_array_equal(found.errors, expected.errors)
    assert np.abs(expected.problem.tracking.b).max() > 0.05


def test_implausible_target_of_a_row_task_is_a_stop(panda):
    controller = Controller(build_scene(panda), build_tasks(row_tasks(), panda, panda.home))
    align = next(task.settings.label for task in controller.tasks if isinstance(task.settings, AlignTask))
    for name, target in (("posture", np.full(7, np.nan)), ("posture", np.full(7, 1e7)), (align, np.zeros(3)),
                         (align, np.array([0.0, np.inf, 0.0]))):  # fmt: skip
        solution = controller.step(panda.home, targets={name: target})
        assert solution.status is Status.STOPPED
        assert solution.reasons[0].key == ("IMPLAUSIBLE", ("target", name))


@pytest.mark.parametrize("bad", [np.nan, 1e9])
def test_measured_velocity_is_checked_in_each_step(bad):
    """Also in steps that go the short way, whose velocity level does not need it."""
    controller, q = Controller.from_scenario(changed("panda_line"))
    v = np.zeros(controller.scene.robot.model.nv)
    assert controller.step(q, 0.0, v=v).status is Status.SOLVED
    solution = controller.step(q, controller.dt, v=np.full_like(v, bad))
    assert solution.status is Status.STOPPED
    assert solution.reasons[0].kind is ReasonKind.IMPLAUSIBLE


def test_solver_is_checked_on_assignment():
    controller, _ = Controller.from_scenario(changed("humanoid_reach"))
    before = controller.solver
    with pytest.raises(ConfigError, match="contacts: solver 'eq10' cannot hold them"):
        controller.solver = make_solver("eq10")
    for bad in (None, object()):
        with pytest.raises(ConfigError, match=r"solver: .* derive it from"):
            controller.solver = bad
    assert controller.solver is before


def test_solver_on_assignment_brings_its_look_ahead(panda):
    """The same velocities as those of a controller that was made with it, and no more looks."""
    looks = []
    for first in ("qp", "eq10"):
        controller = make_controller(panda, [BALL], TOOL, first)
        controller.solver = make_solver("qp")
        ticks = list(drive(controller, panda.home, 50, target=[0.35, 0.1, 0.5]))
        looks.append(([tick.problem.tracking_is_clear for tick in ticks], [tick.solution.v for tick in ticks]))
    assert any(looks[0][0])
    for a, b in zip(*looks, strict=True):
        np.testing.assert_array_equal(a, b)


class Remembers(Solver):
    """A law that counts what it is asked."""

    bounded, asked = True, 0

    def solve(self, problem):
        self.asked += 1
        return Solution(np.zeros(len(problem.lower)))


def test_solver_of_the_user_is_not_called_before_the_first_step(panda):
    law = Remembers()
    controller = make_controller(panda, [BALL], TOOL, law)
    assert law.asked == 0 and controller.solver is law
    controller.step(panda.home)
    assert law.asked == 1


@pytest.mark.parametrize(
    "answer",
    [
        lambda: Solution(np.full(7, 0.01), status="FINE"),
        lambda: Solution(np.full(7, 0.01), reasons=("so what",)),
        lambda: Solution(np.full(7, 0.01), reasons=Reason.of(ReasonKind.BACKUP)),
        lambda: Solution(np.full(7, 0.01), slack=np.zeros(100)),
        lambda: None,
    ],
)
def test_solver_answer_of_the_wrong_kind_is_a_stop(panda, answer):
    class Odd(Solver):
        bounded = True

        def solve(self, problem):
            return answer()

    solution = make_controller(panda, [BALL], TOOL, Odd()).step(panda.home)
    assert solution.status is Status.STOPPED and solution.reasons[0].kind is ReasonKind.SOLVER_FAILED


def test_controller_is_neither_copied_nor_pickled(panda):
    controller = make_controller(panda, [BALL], TOOL)
    for way in (copy.copy, copy.deepcopy, pickle.dumps):
        with pytest.raises(TypeError, match=r"`clone\(\)` gives another one"):
            way(controller)


def test_attach_after_a_reset_takes_the_last_configuration(panda):
    box = Obstacle.at("box", Sphere(radius=0.03), [0.4, 0.0, 0.45], graspable=True)
    poses = []
    for reset in (False, True):
        controller = make_controller(panda, [box], TOOL)
        controller.step(panda.home + 0.2)
        if reset:
            controller.reset()
        controller.attach("box", TOOL)
        poses.append(controller.obstacle_pose("box", panda.home).position)
    np.testing.assert_array_equal(*poses)
    with pytest.raises(NumericalError, match="degrees"):
        controller.attach("box", TOOL, np.rad2deg(panda.home))


# --- cost of a step ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("jerk", [None, 50.0])
def test_step_computes_distances_a_bounded_number_of_times(tmp_path, jerk, monkeypatch):
    """Whatever moves: also at speeds at which little time is left between two poses that could meet."""
    computed, compute, look_along = [], DistanceQuery.compute, kernels.look_along
    monkeypatch.setattr(DistanceQuery, "compute", lambda self, *args: computed.append(1) or compute(self, *args))
    monkeypatch.setattr(kernels, "look_along", lambda *args: computed.extend([1] * 49) or look_along(*args))
    obstacles = [Obstacle.at("ball", Sphere(radius=0.05), [0.3, 0.0, 0.0])]
    controller = make_controller(cartesian(tmp_path), obstacles, "z", limits=Limits(jerk=jerk))
    for speed in (0.0, 1.0, 999.0):
        for place in ([0.3, 0.0, 0.0], [0.2, 0.4, 0.0]):
            computed.clear()
            ball = Sample.at(place, linear=[-speed, 0.0, 0.0])
            controller.reset(np.array([0.9, 0.0, 0.0]))
            controller.step(np.zeros(3), obstacles={"ball": ball}, v=np.array([0.9, 0.0, 0.0]))
            assert 0 < len(computed) <= 1000


@pytest.mark.parametrize("speed", [1e-3, 1.0, 1e6])
def test_a_path_is_looked_along_in_49_poses_at_most(speed):
    t, poses = 0.0, 0
    while t < 2.0:
        later = kernels.next_pose_time(t, 0.0, 1 + poses, 2.0, 0.01, speed)
        assert t < later <= 2.0
        t, poses = later, poses + 1
    assert poses <= 49
