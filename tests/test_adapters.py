"""Programs of other libraries that are made safe: Pink, mink and roboplan, run for real.

Where one of them is missing, its tests are skipped; in CI, where all are installed, that is a failure.
"""

import importlib
import os
import re
from pathlib import Path

import mujoco
import numpy as np
import pinocchio as pin
import pytest
from closed_loop import Ruler

import qpavoid
from qpavoid import Avoidance, ConfigError, Controller, Obstacle, Robot, Sample, UnknownName, build_scene
from qpavoid.adapters.joints import JointMap
from qpavoid.adapters.velocities import RowLimit, VelocityFilter
from qpavoid.config import Sphere

ADAPTERS = Path(qpavoid.__file__).parent / "adapters"
TOOL, DT, D1 = "panda_hand_tcp", 0.01, 0.03


def adapter(name):
    """The adapter of a library."""
    if not os.environ.get("CI"):
        pytest.importorskip(name)
    return importlib.import_module(f"qpavoid.adapters.{name}")


def ball_at(t):
    """A ball that goes up and down across the way of the hand."""
    return Sample.at([0.5, 0.0, 0.45 + 0.1 * np.sin(t)], linear=[0.0, 0.0, 0.1 * np.cos(t)])


def shift_at(t):
    return np.array([0.1, 0.2 * np.sin(t), 0.0])


def sphere_scene(robot, radius=0.06):
    return build_scene(robot, [Obstacle.at("ball", Sphere(radius=radius), [0.5, 0.0, 0.45])])


def make_controller(scene, dt=DT):
    return Controller(scene, [], dt=dt, avoidance=Avoidance(d1=D1, d2=0.15))


def least_distance(scene, qs, ball=ball_at):
    """Least distance to the ball along configurations, one a control period [m]."""
    ruler, of = Ruler(scene), scene.obstacle_of[scene.pairs[:, 1]] >= 0
    return min(ruler.distances(q, {0: ball(k * DT)})[of].min() for k, q in enumerate(qs))


def bare(robot):
    """The URDF of a robot without its shapes."""
    return re.sub(r"(?s)<(visual|collision)\b.*?</\1>", "", robot.urdf.read_text())


class PinkLoop:
    """Pink's own loop with a task for the hand, in a model with two finger joints that the robot has locked."""

    def __init__(self, robot, controller):
        import pink

        self.adapter, self.pink = adapter("pink"), pink
        model = pin.buildModelFromUrdf(str(robot.urdf))
        self.configuration = pink.Configuration(model, model.createData(), np.append(robot.home, [0.02, 0.02]))
        self.tasks = pink.FrameTask(TOOL, 1.0, 0.5), pink.PostureTask(cost=1e-3)
        self.tasks[1].set_target_from_configuration(self.configuration)
        self.start = self.configuration.get_transform_frame_to_world(TOOL)

    def aim(self, shift):
        self.tasks[0].set_target(pin.SE3(self.start.rotation, self.start.translation + shift))

    def solve(self):
        return self.pink.solve_ik(self.configuration, self.tasks, DT, solver="daqp", safety_break=False)


class MinkLoop(PinkLoop):
    """The same with mink, whose hand is the link before it: MuJoCo merges what does not move."""

    def __init__(self, robot, controller):
        import mink

        self.adapter, self.mink, tool = adapter("mink"), mink, "panda_link7"
        self.configuration = mink.Configuration(
            mujoco.MjModel.from_xml_string(bare(robot)), np.append(robot.home, [0.02, 0.02])
        )
        self.tasks = mink.FrameTask(tool, "body", 1.0, 0.5), mink.PostureTask(self.configuration.model, 1e-3)
        self.tasks[1].set_target_from_configuration(self.configuration)
        self.start = self.configuration.get_transform_frame_to_world(tool, "body")

    def aim(self, shift):
        self.tasks[0].set_target(self.mink.SE3.from_translation(shift).multiply(self.start))

    def solve(self):
        return self.mink.solve_ik(self.configuration, self.tasks, DT, solver="daqp")


def run(loop_type, robot, way, ball=ball_at, shift=shift_at, steps=500):
    """Configurations (N, 7) of a loop alone, with its velocity filtered, or with the rows inside its QP."""
    controller = make_controller(sphere_scene(robot))
    loop = loop_type(robot, controller)
    safe = loop.adapter.velocity_filter(controller, loop.configuration)
    limit, qs = loop.adapter.AvoidanceLimit(controller, loop.configuration), []
    for k in range(steps):
        qs.append(loop.configuration.q[:7].copy())
        loop.aim(shift(k * DT))
        if way == "rows":
            limit.obstacles = {"ball": ball(k * DT)}
            v = loop.adapter.solve_ik(loop.configuration, loop.tasks, DT, limit)
        else:
            v = loop.solve()
        if way == "filter":
            v = safe(loop.configuration.q, v, obstacles={"ball": ball(k * DT)})
        loop.configuration.integrate_inplace(v, DT)
    return np.array(qs)


@pytest.mark.parametrize("loop_type", [PinkLoop, MinkLoop])
def test_another_ik_keeps_its_distance(panda, loop_type):
    """Alone it comes nearer than d1; the velocity filtered, or the rows in its own QP, it does not."""
    adapter("pink" if loop_type is PinkLoop else "mink")
    scene = sphere_scene(panda)
    assert least_distance(scene, run(loop_type, panda, "alone")) < 0.5 * D1
    for way in ("filter", "rows"):
        qs = run(loop_type, panda, way)
        assert least_distance(scene, qs) > D1 - 1e-3
        speeds = np.abs(np.diff(qs, axis=0)) / DT
        assert (speeds <= panda.bounds().velocity + 1e-6).all()
        assert (np.abs(np.diff(speeds, axis=0)) / DT <= panda.bounds().acceleration + 1e-3).all()


@pytest.mark.parametrize("loop_type", [PinkLoop, MinkLoop])
def test_rows_follow_where_nothing_is_near(panda, loop_type):
    """Far from the ball the rows change nothing: the hand is where the other program has it, to what it accelerates."""
    adapter("pink" if loop_type is PinkLoop else "mink")

    def far(t):
        return Sample.at([-1.5, 0.0, 0.5])

    def slow(t):
        return np.array([0.0, 0.05 * (1.0 - np.cos(t)), 0.0])

    alone, rows = (run(loop_type, panda, way, far, slow, 300) for way in ("alone", "rows"))
    np.testing.assert_allclose(rows, alone, atol=1e-5)


def test_a_qp_without_a_solution_is_a_safe_stop(panda):
    """A ball flies at the hand at 0.8 m/s: Pink's QP has no solution then, and the command goes out of its way."""
    adapter("pink")

    def fly(t):
        return Sample.at([1.4 - 0.8 * t, 0.0, 0.5], linear=[-0.8, 0.0, 0.0])

    def hold(t):
        return np.zeros(3)

    scene, at = sphere_scene(panda), 130
    alone = least_distance(scene, run(PinkLoop, panda, "alone", fly, hold, at), fly)
    assert alone < 0.0
    for way in ("filter", "rows"):
        assert least_distance(scene, run(PinkLoop, panda, way, fly, hold, at), fly) > 0.01


def test_oink_of_roboplan_keeps_its_distance(panda):
    roboplan = adapter("roboplan")
    from roboplan import core
    from roboplan.optimal_ik import FrameTask, FrameTaskOptions, Oink, PositionLimit

    scene, other = sphere_scene(panda), core.Scene("panda", core.loadUrdfSceneDescriptionFromXml(bare(panda)))

    def loop(is_filtered):
        safe, oink = roboplan.velocity_filter(make_controller(scene), other), Oink(other)
        q = other.getCurrentJointPositions()
        q[other.getJointPositionIndices(panda.joint_names)] = panda.home
        start, goal = other.forwardKinematics(q, TOOL), core.CartesianConfiguration()
        goal.base_frame, goal.tip_frame, goal.tform = "panda_link0", TOOL, start
        task, limit = FrameTask(oink, other, goal, FrameTaskOptions(1.0, 0.5, 1.0, 0.01)), PositionLimit(oink, 1.0)
        delta_q, qs = np.zeros(oink.num_variables), []
        for k in range(500):
            qs.append(q[:7])
            target = start.copy()
            target[:3, 3] += shift_at(k * DT)
            task.setTargetFrameTransform(np.asfortranarray(target))
            oink.solveIk(q, [task], [limit], [], delta_q, 1e-6)
            v = delta_q / DT
            q = other.integrate(q, DT * (safe(q, v, obstacles={"ball": ball_at(k * DT)}) if is_filtered else v))
        return qs

    assert least_distance(scene, loop(False)) < 0.5 * D1
    assert least_distance(scene, loop(True)) > D1 - 1e-3


def test_joints_in_another_order_among_others(panda):
    rng, controller = np.random.default_rng(0), make_controller(sphere_scene(panda))
    names = ["gripper", *reversed(panda.joint_names), "rail"]
    joints = JointMap.of_names(panda, names)
    q, v = np.append(0.5, np.append(panda.home[::-1], 0.7)), rng.normal(size=9)
    np.testing.assert_array_equal(joints.q(q), panda.home)
    np.testing.assert_array_equal(joints.v(v), v[7:0:-1])
    limit, own = RowLimit(controller, joints), make_controller(sphere_scene(panda))
    G, h = limit.inequalities(q, DT)
    problem = own.rows(panda.home)
    np.testing.assert_allclose(G[14] @ v - h[14] / DT, problem.avoidance.b[0] - problem.avoidance.J[0] @ joints.v(v))
    assert not G[:, [0, 8]].any() and len(G) == len(problem.avoidance.b) + 14
    assert not joints.merged(np.zeros(7), np.full(9, np.nan)).any()  # a NaN that is not the robot's is rest
    out = VelocityFilter(own, joints)(q, 0.01 * v)
    np.testing.assert_array_equal(out, 0.01 * v)  # it is safe; what is no joint of the robot stays as it is
    with pytest.raises(UnknownName, match=r"joint 'panda_joint1' of panda-capsules is not there"):
        JointMap.of_names(panda, ["gripper", "joint7"])
    with pytest.raises(ConfigError, match=r"dt: 0\.02 s, but the controller has 0\.01 s"):
        limit.inequalities(q, 0.02)


def test_a_joint_without_limits_is_an_angle(tmp_path):
    path = tmp_path / "turntable.urdf"
    path.write_text(
        '<robot name="turntable"><link name="a"/><link name="b"/><joint name="turn" type="continuous">'
        '<parent link="a"/><child link="b"/><axis xyz="0 0 1"/><limit velocity="2" effort="1"/></joint></robot>'
    )
    robot = Robot.from_urdf(path, bodies=[])
    np.testing.assert_allclose(JointMap.of_names(robot, ["turn"]).q([0.7]), [np.cos(0.7), np.sin(0.7)])
    own = JointMap.of_pinocchio(robot, robot.model)
    np.testing.assert_array_equal(own.q([0.6, 0.8]), [0.6, 0.8])


def test_a_floating_base_is_that_of_mujoco(solo):
    """Configurations after the same motion agree, integrated by MuJoCo and by Pinocchio; so do rates of rows."""
    spec = mujoco.MjSpec.from_string(bare(solo))
    spec.worldbody.first_body().add_freejoint()
    model, rng = spec.compile(), np.random.default_rng(1)
    joints = JointMap.of_mujoco(solo, model)
    qpos, velocity = np.zeros(model.nq), rng.normal(size=model.nv)
    mujoco.mj_integratePos(model, model.qpos0.copy(), rng.normal(size=model.nv), 0.5)
    start = model.qpos0.copy()
    mujoco.mj_integratePos(model, start, rng.normal(size=model.nv), 0.5)
    qpos[:] = start
    q, v = joints.q(start).copy(), joints.v(velocity)
    mujoco.mj_integratePos(model, qpos, velocity, 1e-3)
    np.testing.assert_allclose(joints.q(qpos), pin.integrate(solo.model, q, 1e-3 * v), atol=1e-6)
    joints.q(start)
    np.testing.assert_allclose(joints.merged(v, np.zeros(model.nv)), velocity, atol=1e-12)
    J = rng.normal(size=(3, solo.model.nv))
    columns = np.empty((3, model.nv))
    joints.write_columns(J, columns)
    np.testing.assert_allclose(columns @ velocity, J @ v, atol=1e-12)


def test_two_halves_of_a_step_are_the_filter(panda):
    """Bit for bit, from a robot that comes near and stays there; a half that is left out counts as motion to q."""
    whole, halves = (make_controller(sphere_scene(panda)) for _ in range(2))
    q = panda.home
    for k in range(300):
        command, now = 0.5 * np.sin(0.01 * k + np.arange(7.0)), {"ball": ball_at(k * DT)}
        v = whole.filter(q, command, obstacles=now).v
        problem = halves.rows(q, obstacles=now)
        assert problem.avoidance.J.shape == (len(problem.avoidance.b), 7)
        assert halves.command(command).v.tobytes() == v.tobytes()
        q = q + DT * v
    halves.rows(q)
    q = q + DT * v
    bounds = [controller.rows(q) for controller in (whole, halves)]
    np.testing.assert_allclose(bounds[0].upper, bounds[1].upper, atol=1e-9)
    with pytest.raises(ConfigError, match=r"call `rows` before it"):
        make_controller(sphere_scene(panda)).command(v)


def test_a_half_step_with_a_command_that_cannot_be_true_is_a_stop(panda):
    controller = make_controller(sphere_scene(panda))
    controller.rows(panda.home)
    solution = controller.command(np.full(7, np.nan))
    assert solution.status.value == "STOPPED" and solution.reasons[0].key == ("IMPLAUSIBLE", ("v_desired",))


def test_page_of_adapters_runs(capsys):
    """Its blocks in their order, as somebody copies them one after the other."""
    adapter("pink")
    page = (ADAPTERS.parents[1] / "docs" / "adapters.md").read_text(encoding="utf-8")
    names: dict[str, object] = {}
    for block in re.findall(r"```python\n(.*?)```", page, re.S):
        exec(compile(block, "adapters.md", "exec"), names)
    assert "SOLVED" in capsys.readouterr().out


def test_adapters_stay_short():
    files = {path.name: len(path.read_text(encoding="utf-8").splitlines()) for path in ADAPTERS.glob("*.py")}
    assert len(files) > 4
    assert {name: lines for name, lines in files.items() if lines > 150} == {}
