"""The tracking law: its curvature by differences, the whole law by plain definitions, and rest beyond reach."""

import numpy as np
import pinocchio as pin
import pytest
from closed_loop import planar
from conftest import EXAMPLES, differences, frames, random_q

from qpavoid import Avoidance, Controller, Limits, Obstacle, Robot, Sample, build_scene, build_tasks, config
from qpavoid.config import Box, PostureTask, Sphere, Task
from qpavoid.control.distances import DistanceQuery
from qpavoid.control.row_layout import lay_out
from qpavoid.control.settings import ControlSettings
from qpavoid.control.tasks import in_order
from qpavoid.kernels import add_curvature, frame_rows, pack, tracking_law
from qpavoid.model.kinematics import ForwardKinematics

DT = 0.01
TOOLS = {"panda": "panda_hand_tcp", "paper": "left_tool", "solo": "FL_FOOT", "fingers": "l_gripper_r_finger_tip"}


@pytest.fixture(scope="module")
def fingers():
    """Baxter's fingers come in pairs: one of each mimics the other one; both are prismatic."""
    return Robot.from_urdf(EXAMPLES / "baxter_description/urdf/baxter.urdf", bodies=[])


@pytest.fixture(scope="module")
def ur5():
    """The arm alone, without bodies that could meet."""
    return Robot.from_urdf(EXAMPLES / "ur_description/urdf/ur5_robot.urdf", bodies=[], home=UR5_HOME)


@pytest.fixture(scope="module")
def bare_panda(panda):
    home = dict(zip(panda.coordinate_names, panda.home.tolist(), strict=True))
    urdf = EXAMPLES / "panda_description/urdf/panda.urdf"
    return Robot.from_urdf(urdf, bodies=[], home=home, lock={"panda_finger_joint1": 0.0, "panda_finger_joint2": 0.0})


UR5_HOME = {"shoulder_lift_joint": -1.2, "elbow_joint": 1.8, "wrist_1_joint": -2.1, "wrist_2_joint": -1.57}


class Rows:
    """Memory of a control step of some tasks of a robot, without anything around it."""

    def __init__(self, robot, *blocks, dt=DT):
        tasks, _ = in_order(build_tasks(blocks, robot, robot.home))
        scene, limits = build_scene(robot), config.Limits()
        self.kinematics = ForwardKinematics(robot.model, [task.frame_id for task in tasks])
        self.query = DistanceQuery(scene)
        settings = ControlSettings(scene, robot.bounds().within(limits), config.Avoidance(), limits, dt)
        self.x = lay_out(settings, tasks, [], self.kinematics, self.query)

    def write(self, q, targets=None):
        """A and b at q, with frames at their targets (f, 18) or some target at all."""
        self.kinematics.compute(q)
        if targets is not None:
            self.x.targets[:] = targets
        frame_rows(pack(self.x))
        return self.x.A.copy(), self.x.b.copy()

    def curvature(self, w):
        """Σ w_r ∂²x_r/∂q² of all rows."""
        G = np.zeros((self.x.A.shape[1],) * 2)
        for part in range(len(w) // 3):
            add_curvature(pack(self.x), part, w[3 * part : 3 * part + 3], G)
        return G

    def law(self):
        """Velocity, feasible task velocity, and how far the rows bend."""
        x, v = self.x, np.empty(self.x.A.shape[1])
        bent = tracking_law(pack(x), x.A, x.b, v, x.b_feasible)
        return v, x.b_feasible.copy(), bent


@pytest.mark.parametrize("name", TOOLS)
def test_curvature_is_the_derivative_of_the_rows(request, name):
    """The symmetric part of ∂(wᵀA)/∂q: joints that turn and slide, that mimic others, a floating base, two parts."""
    robot, rng = request.getfixturevalue(name), np.random.default_rng(3)
    rows = Rows(robot, Task(frame=TOOLS[name], type="pose"), Task(frame=TOOLS[name], type="orientation", name="turn"))
    rows.x.targets[:, [0, 4, 8]] = 1.0
    for _ in range(3):
        q, w = random_q(robot, rng), rng.normal(size=9)
        D = differences(lambda q, w=w: w @ rows.write(q)[0], robot, q)
        rows.write(q)
        np.testing.assert_allclose(rows.curvature(w), 0.5 * (D + D.T), atol=1e-7)


def far_targets(robot, q, names, rng, distance):
    """Rows of targets (f, 18) about so far from where the frames are at q, and their feed-forward."""
    rows = []
    for pose in frames(robot, names, q):
        R = pin.exp3(min(distance, 1.0) * rng.normal(size=3)) @ pose.rotation
        position = pose.translation + distance * rng.normal(size=3)
        rows.append(Sample.at(position, R, 0.1 * rng.normal(size=3), 0.1 * rng.normal(size=3)).row)
    return np.array(rows)


def law_by_definition(rows, v_max):
    """The formulas of the module's docstring for one task of weight 1, by numpy's singular values."""
    x, b, f = rows.x, rows.x.b, rows.x.feedback
    U, s, Vt = np.linalg.svd(x.A, full_matrices=False)
    weak = 0.01 * np.linalg.norm(x.A @ x.A.T)
    limited = np.minimum(v_max, 10.0)
    plain = np.abs(Vt.T @ (s / np.maximum(s**2, weak) * (U.T @ b))) / limited
    W = x.A * limited
    gram = W @ W.T
    least = np.abs(W.T @ np.linalg.solve(gram + 0.01 * np.linalg.norm(gram) * np.eye(len(b)), b))
    g = max(1.0, min(plain.max(), least.max()))
    rate = np.max(np.abs(Vt.T @ (U.T @ b / np.where(s > 1e-12 * s[0], s, np.inf))) / g / limited)
    y, w = U.T @ b / g, (2.0 * DT * b + f / 20.0) / g
    G, size, v = rows.curvature(w), np.linalg.norm(w), np.zeros(len(v_max))
    for i in range(len(s)):
        turn = G @ Vt[i]
        c = max(0.0, 1.0 - s[i] ** 2 / (4.0 * size)) * max(0.0, -Vt[i] @ turn)
        lacking = max(0.0, 1.0 - 100.0 * s[i] ** 2 / weak) * (size - 50.0 * np.linalg.norm(turn))
        step = s[i] * y[i] / max(s[i] ** 2, c, lacking, 1e-12 * s[0] ** 2)
        weakness = max(0.0, 1.0 - s[i] ** 2 / weak) * np.clip(5.0 * (rate / 0.3 - 1.0), 0.0, 1.0)
        if weakness > 0.0:
            fastest = 0.3 / weakness * np.min(limited / np.maximum(np.abs(Vt[i]), 1e-12))
            step = np.clip(step, -fastest, fastest)
        near = (1.0 - s[i] ** 2 / max(Vt[i] @ turn, s[i] ** 2)) * max(0.0, 1.0 - s[i] ** 2 / weak)
        if near > 0.0:
            step *= 1.0 - 2.0 * near * np.clip(-10.0 * np.sign(y[i]) * (Vt[i] @ x.centering), 0.0, 1.0)
        v += step * Vt[i]
    return v, b / g, s, size


@pytest.mark.parametrize("kind", ["position", "pose"])
@pytest.mark.parametrize("name", ["panda", "paper", "ur5"])
def test_law_by_definition(request, name, kind):
    """Near and far targets, singular wrists and stretched arms among them; J⁺b, to round-off, where no direction is
    weak, all joints are fast enough, and σ_min² is above 4|w|.
    """
    robot, rng = request.getfixturevalue(name), np.random.default_rng(0)
    tool = {"panda": TOOLS["panda"], "paper": TOOLS["paper"], "ur5": "tool0"}[name]
    rows, exact, bent = Rows(robot, Task(frame=tool, type=kind)), 0, 0
    for k in range(200):
        q = random_q(robot, rng, 0.8)
        if k % 4 == 0:
            q[4 if name == "ur5" else 3] = rng.choice([0.0, 1e-3, 0.05])
        rows.x.centering[:] = rng.uniform(-1.0, 1.0, len(rows.x.centering))
        A, _ = rows.write(q, far_targets(robot, q, [tool], rng, 10.0 ** rng.uniform(-4.0, 0.5)))
        expected, feasible, s, size = law_by_definition(rows, rows.x.v_max)
        v, b_feasible, _ = rows.law()
        np.testing.assert_allclose(b_feasible, feasible, rtol=0, atol=1e-9)
        np.testing.assert_allclose(v, expected, rtol=0, atol=1e-6 * (1.0 + 1e-3 / s[-1]))
        if s[-1] > 0.1 * s[0] and s[-1] ** 2 > 4.0 * size:
            np.testing.assert_allclose(v, np.linalg.pinv(A) @ b_feasible, rtol=0, atol=1e-12)
            exact += 1
        bent += np.abs(v - np.linalg.pinv(A) @ b_feasible).max() > 1e-3
    assert (exact if kind == "position" else bent) > 20


def test_law_keeps_nan_and_knows_dependent_rows(panda):
    """The same task twice is done once, if both say the same; NaN stays NaN."""
    rng = np.random.default_rng(1)
    one, two = (Rows(panda, *[Task(frame=TOOLS["panda"], type="pose", name=n) for n in "ab"[:k]]) for k in (1, 2))
    q = random_q(panda, rng, 0.3)
    target = far_targets(panda, q, [TOOLS["panda"]], rng, 1e-3)
    v = []
    for rows in (one, two):
        rows.write(q, target)
        v.append(rows.law()[0])
    np.testing.assert_allclose(v[1], v[0], rtol=0, atol=1e-9)
    one.write(q, np.where(np.arange(18) == 9, np.nan, target))
    assert np.isnan(one.law()[0]).all()


def test_far_target_of_one_arm_leaves_the_other_arm_alone(paper):
    """One scale for each task: two arms that share no joint move as each does by itself."""
    rng, names = np.random.default_rng(2), ("left_tool", "right_tool")
    both, right = Rows(paper, *[Task(frame=n) for n in names]), Rows(paper, Task(frame="right_tool"))
    targets = far_targets(paper, paper.home, names, rng, 1e-3)
    targets[0, 9:12] += [3.0, 2.0, 1.0]
    both.write(paper.home, targets)
    right.write(paper.home, targets[1:])
    (v, b, _), (alone, b_alone, _) = both.law(), right.law()
    assert np.linalg.norm(b[:3]) < 0.7 * np.linalg.norm(both.x.b[:3])
    np.testing.assert_allclose(b[3:], b_alone, atol=1e-12)
    np.testing.assert_allclose(v[np.abs(alone) > 1e-9], alone[np.abs(alone) > 1e-9], atol=1e-9)


def test_posture_rows_are_solved_together_with_the_tool(panda):
    """Least squares of all rows, posture in the null space of the tool."""
    tasks = build_tasks([Task(frame=TOOLS["panda"], type="pose"), PostureTask(weight=1e-4)], panda, panda.home)
    controller = Controller(build_scene(panda), tasks)
    q = pin.integrate(panda.model, panda.home, 0.02 * np.arange(7))
    problem = controller.tick(q).problem
    expected = np.linalg.lstsq(problem.tracking.A, problem.tracking.b, rcond=None)[0]
    np.testing.assert_array_equal(problem.tracking.b, problem.tracking.b_feasible)
    np.testing.assert_allclose(problem.v_tracking, expected, rtol=0, atol=1e-8)


# --- rest beyond reach --------------------------------------------------------------------------------------------


def mimicking(folder):
    """A planar arm whose second elbow turns with the first one."""
    path = folder / "mimicking.urdf"
    planar(folder)
    text = (folder / "planar.urdf").read_text()
    limit = '<limit lower="-6" upper="6" velocity="2" effort="1"/></joint>'
    head, tail = text.split('<joint name="j3"')
    path.write_text(head + '<joint name="j3"' + tail.replace(limit, f'<mimic joint="j2" multiplier="0.5"/>{limit}', 1))
    return Robot.from_urdf(path, bodies=[], home={"j1": 0.3, "j2": 0.5})


ARMS = {"planar": ("tip", (0.0, 0.0, 0.0), 1.1), "mimicking": ("tip", (0.0, 0.0, 0.0), 1.1),
        "ur5": ("tool0", (0.0, 0.0, 0.089), 0.95), "bare_panda": (TOOLS["panda"], (0.0, 0.0, 0.333), 0.86)}  # fmt: skip
"""Tool, shoulder and reach of each arm [m]."""


def reach_case(seed):
    """Arm, direction, control period, gain, kind of the task, distance beyond reach, turn of the tool."""
    rng = np.random.default_rng(seed)
    arm = list(ARMS)[seed % 4]
    u = rng.normal(size=3)
    u[2] = 0.0 if arm in ("planar", "mimicking") else abs(u[2])
    dt = float(np.exp(rng.uniform(np.log(0.002), np.log(0.02))))
    gain = [2.0, 10.0, 1.0 / dt][rng.integers(3)]
    kind = "position" if u[2] == 0.0 else ["position", "pose"][rng.integers(2)]
    beyond = float(np.exp(rng.uniform(np.log(1e-3), np.log(2.0))))
    return arm, u / np.linalg.norm(u), dt, gain, kind, beyond, pin.exp3(0.7 * rng.normal(size=3))


def follow(controller, q, targets, seconds):
    """Velocities (N, nv) of a loop that follows every one of them exactly, and where it ends."""
    v = []
    for k in range(int(seconds / controller.dt)):
        v.append(controller.step(q, k * controller.dt, targets).v)
        q = pin.integrate(controller.scene.robot.model, q, v[-1] * controller.dt)
    return np.array(v), q


def chatter(v, steps):
    """Mean of Σ_j |Δv_j| over the last steps [rad/s]."""
    return np.abs(np.diff(v[-steps:], axis=0)).sum(axis=1).mean()


@pytest.mark.parametrize("acceleration", [None, 5.0])
@pytest.mark.parametrize("seed", [*range(4), *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(4, 100))])
def test_arm_rests_beyond_reach(request, tmp_path, seed, acceleration):
    """Planar arms, UR5, Panda; 1 mm to 2 m beyond; 2 to 20 ms; gains of 2, 10 and 1/dt; positions and poses. With
    accelerations of 5 rad/s², arms swing about any target, also within reach, at gains that ask for more.
    """
    arm, u, dt, gain, kind, beyond, turn = reach_case(seed)
    gain = gain if acceleration is None else min(gain, 10.0)
    makers = {"planar": planar, "mimicking": mimicking}
    robot = makers[arm](tmp_path) if arm in makers else request.getfixturevalue(arm)
    tool, shoulder, reach = ARMS[arm]
    (pose,) = frames(robot, [tool], robot.home)
    target = Sample.at(np.array(shoulder) + (reach + beyond) * u, turn @ pose.rotation)
    tasks = build_tasks([Task(frame=tool, type=kind, gain=gain)], robot, robot.home)
    controller = Controller(build_scene(robot), tasks, dt=dt, limits=Limits(acceleration=acceleration))
    v, q = follow(controller, robot.home, {tool: target}, 8.0)
    assert chatter(v, int(1.0 / dt)) <= 1e-3
    if kind == "position" and arm != "mimicking":
        (end,) = frames(robot, [tool], q)
        assert np.linalg.norm(end.translation - target.position) < beyond + 0.12


@pytest.mark.parametrize("arm", ["ur5", "bare_panda"])
@pytest.mark.parametrize("weight", [1e-4, pytest.param(1e-3, marks=pytest.mark.slow)])
@pytest.mark.parametrize("dt", [0.01, pytest.param(0.005, marks=pytest.mark.slow)])
def test_arm_with_a_light_posture_rests_beyond_reach(request, arm, weight, dt):
    """The posture moves what the tool leaves free, where a stretched arm bends: it may not shake the tool back in."""
    robot, (tool, _, _) = request.getfixturevalue(arm), ARMS[arm]
    (pose,) = frames(robot, [tool], robot.home)
    target = Sample.at(pose.translation + np.array([1.0, -1.5, 0.3]), pose.rotation)
    tasks = build_tasks([Task(frame=tool), PostureTask(weight=weight)], robot, robot.home)
    controller = Controller(build_scene(robot), tasks, dt=dt)
    v, _ = follow(controller, robot.home, {tool: target}, 8.0)
    assert chatter(v, int(0.5 / dt)) <= 1e-3


@pytest.mark.parametrize(
    "seed", [3, 6, 9, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (0, 1, 2, 4, 5, 7, 8, 10, 11))]
)
def test_arm_follows_a_target_that_comes_back_into_reach(panda, seed):
    """Stretched out, an arm can fold to two sides; the wrong one ends at the limits of the joints."""
    rng = np.random.default_rng(seed)
    turn, rise, beyond = rng.uniform([-0.8, -0.1, 0.05], [0.8, 0.8, 0.3])
    (pose,) = frames(panda, [TOOLS["panda"]], panda.home)
    shoulder = np.array([0.0, 0.0, 0.333])
    out = np.array([np.cos(rise) * np.cos(turn), np.cos(rise) * np.sin(turn), np.sin(rise)])
    away = shoulder + (0.95 + beyond) * out
    tasks = build_tasks([Task(frame=TOOLS["panda"], gain=10.0)], panda, panda.home)
    controller, q = Controller(build_scene(panda), tasks, dt=0.01), panda.home
    for share in np.concatenate([np.linspace(0.0, 1.0, 200), np.ones(150), np.linspace(1.0, 0.0, 200), np.zeros(150)]):
        target = Sample.at(pose.translation + share * (away - pose.translation), pose.rotation)
        q = pin.integrate(panda.model, q, 0.01 * controller.step(q, targets={TOOLS["panda"]: target}).v)
    (end,) = frames(panda, [TOOLS["panda"]], q)
    assert np.linalg.norm(end.translation - pose.translation) < 1e-3


TURNS = [turn for axis in np.eye(3) for turn in (0.3 * axis, -0.3 * axis)]


@pytest.mark.parametrize("joint", [0.0, 1e-3])
@pytest.mark.parametrize("turn", [*TURNS[4:], *(pytest.param(t, marks=pytest.mark.slow) for t in TURNS[:4])], ids=str)
def test_wrist_leaves_its_singularity(ur5, joint, turn):
    """The tool turns in place out of a straight wrist: within 3.2 s, without a burst."""
    q = ur5.home.copy()
    q[4] = joint
    (pose,) = frames(ur5, ["tool0"], q)
    tasks = build_tasks([Task(frame="tool0", type="pose")], ur5, q)
    controller = Controller(build_scene(ur5), tasks, dt=0.005, limits=Limits(acceleration=10.0))
    target = Sample.at(pose.translation, pin.exp3(turn) @ pose.rotation)
    v, q = follow(controller, q, {"tool0": target}, 3.2)
    (end,) = frames(ur5, ["tool0"], q)
    assert np.linalg.norm(end.translation - target.position) < 5e-3
    assert np.linalg.norm(pin.log3(end.rotation @ target.rotation.T)) < 1e-2
    assert np.abs(v).max() < 1.3


# --- no chatter at contact ----------------------------------------------------------------------------------------


def pressed(panda, kind):
    """Obstacle, target and kind of task: behind a ball, in it, on the edge of a box, through a wall, beyond reach."""
    (pose,) = frames(panda, [TOOLS["panda"]], panda.home)

    def beside(x, y, z):
        return pose.translation + np.array([x, y, z])

    ball, box = Sphere(radius=0.08), Box(size=(0.2, 0.4, 0.2))
    obstacle, goal, task = {
        "ball": ((Sphere(radius=0.06), beside(0.16, 0.03, 0.0)), beside(0.26, 0.05, 0.0), "position"),
        "far ball": ((ball, beside(0.22, 0.01, 0.0)), beside(0.45, 0.0, 0.0), "pose"),
        "inside": ((ball, beside(0.22, 0.01, 0.0)), beside(0.22, 0.01, 0.0), "pose"),
        "edge": ((box, beside(0.25, 0.0, -0.15)), beside(0.25, 0.02, -0.1), "position"),
        "wall": ((Box(size=(0.1, 1.0, 1.0)), beside(0.3, 0.0, 0.0)), beside(0.3, 0.02, -0.1), "pose"),
        "beyond": ((ball, beside(0.0, 0.0, 1.0)), beside(1.0, 0.3, 0.2), "pose"),
    }[kind]
    return Obstacle.at("it", *obstacle), Sample.at(goal, pose.rotation), task


SCENES = ("ball", "far ball", "inside", "edge", "wall", "beyond")


@pytest.mark.parametrize("kind", SCENES)
@pytest.mark.parametrize(
    ("dt", "gain"),
    [(0.01, 2.0), (0.01, 100.0), *(pytest.param(*x, marks=pytest.mark.slow) for x in [(0.01, 10.0), (0.002, 500.0)])],
)
def test_tool_that_is_pressed_on_something_does_not_chatter(panda, kind, dt, gain):
    obstacle, target, task = pressed(panda, kind)
    tasks = build_tasks([Task(frame=TOOLS["panda"], type=task, gain=gain)], panda, panda.home)
    controller = Controller(build_scene(panda, [obstacle]), tasks, dt=dt, avoidance=Avoidance(d1=0.03, d2=0.1))
    v, _ = follow(controller, panda.home, {TOOLS["panda"]: target}, 4.0)
    assert chatter(v, int(0.5 / dt)) <= 0.05


@pytest.mark.parametrize("gain", [2.0, 100.0])
def test_two_arms_that_are_pressed_together_do_not_chatter(paper, gain):
    """Each tool is sent to the far side of the other one."""
    names = ("left_tool", "right_tool")
    left, right = frames(paper, names, paper.home)
    middle, across = 0.5 * (left.translation + right.translation), np.array([0.0, 0.1, 0.01])
    across *= np.sign(right.translation[1] - left.translation[1])
    targets = {names[0]: Sample.at(middle + across), names[1]: Sample.at(middle - across)}
    tasks = build_tasks([Task(frame=name, gain=gain) for name in names], paper, paper.home)
    controller = Controller(build_scene(paper), tasks, avoidance=Avoidance(d1=0.03, d2=0.1))
    v, _ = follow(controller, paper.home, targets, 4.0)
    assert chatter(v, 50) <= 0.05
