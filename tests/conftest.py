"""Robots, random scenes and finite differences shared by the tests."""

import ctypes.util
import functools
import os
import sys
import warnings

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import settings

from qpavoid import Controller, Obstacle, Robot, Sample, build_scene, build_tasks, config, load_scenario
from qpavoid.cli import main
from qpavoid.config.shipped import example_robot_data
from qpavoid.control.assembler import RowAssembler
from qpavoid.control.distances import DistanceQuery
from qpavoid.control.obstacle_states import ObstacleStates
from qpavoid.control.row_layout import lay_out
from qpavoid.control.settings import ControlSettings
from qpavoid.control.tasks import in_order
from qpavoid.kernels.cache import FOLDER
from qpavoid.model.kinematics import ForwardKinematics
from qpavoid.model.limits import JointBounds, limit_layout
from qpavoid.model.notes import RobotWarning
from qpavoid.model.trajectory import build_motion
from qpavoid.problem import Proximity

# MuJoCo reads it when it is imported; pictures need no display
os.environ.setdefault("MUJOCO_GL", "osmesa" if ctypes.util.find_library("OSMesa") else "egl")
settings.register_profile("patient", deadline=None)  # the first call of a compiled function may wait for the compiler
settings.load_profile("patient")

EXAMPLES = example_robot_data() / "example-robot-data" / "robots"
SPHERE = config.Sphere(type="sphere", radius=0.06)
CAPSULE = config.Capsule(type="capsule", radius=0.04, length=0.3)
BOX = config.Box(type="box", size=(0.2, 0.3, 0.1))
CYLINDER = config.Cylinder(type="cylinder", radius=0.07, length=0.25)


@pytest.fixture(scope="session", autouse=True)
def compiled_kernels():
    """All kernels of a controller are on disk before any test: none finds on stderr that they are compiled."""
    if not (FOLDER / "complete").exists():
        Controller.from_scenario(load_scenario("situation1"))


class Result:
    """What a command left behind."""

    def __init__(self, status: int, stdout: str, stderr: str) -> None:
        self.status, self.stdout, self.stderr = status, stdout, stderr

    @property
    def lines(self) -> list[str]:
        """Lines on stderr, without the progress bar."""
        return [line for line in self.stderr.splitlines() if line.strip() and "━" not in line]


@pytest.fixture
def cli(monkeypatch, capfd, tmp_path):
    """Runs a command in this process, in a folder of its own, and lets every other exception through."""
    monkeypatch.chdir(tmp_path)

    def cli(*args: object) -> Result:
        monkeypatch.setattr(sys, "argv", ["qpavoid", *map(str, args)])
        with warnings.catch_warnings(), pytest.raises(SystemExit) as exit_:
            warnings.simplefilter("default")
            main()
        captured = capfd.readouterr()  # what C++ prints counts as well
        return Result(exit_.value.code, captured.out, captured.err)

    return cli


@pytest.fixture(scope="session")
def paper():
    return Robot.load("paper-dual-arm")


@pytest.fixture(scope="session")
def panda():
    """The Panda with capsules: pairs have closed forms, and cost little."""
    return Robot.load("panda-capsules")


@pytest.fixture(scope="session")
def panda_convex():
    with pytest.warns(RobotWarning, match="home .*: touch there"):  # stretched, as the file alone has it
        return Robot.from_urdf(EXAMPLES / "panda_description/urdf/panda.urdf", bodies="convex")


@pytest.fixture(scope="session")
def solo():
    """A quadruped on a floating base, with a capsule for the trunk and one for each shank."""
    trunk = {"name": "trunk", "frame": "base_link", "shape": CAPSULE, "rpy": (0.0, np.pi / 2, 0.0)}
    shank = {"shape": {"type": "capsule", "radius": 0.015, "length": 0.16}, "position": (0.0, 0.0, -0.08)}
    shanks = [{"name": leg, "frame": f"{leg}_LOWER_LEG", **shank} for leg in ("FL", "FR", "HL", "HR")]
    urdf = EXAMPLES / "solo_description/robots/solo12.urdf"
    limits = {"velocity": {"root_joint": 10.0}}
    return Robot.from_urdf(urdf, root_joint="free_flyer", bodies=[trunk, *shanks], limits=limits)


def random_q(robot, rng, spread=1.0):
    """A configuration around the home pose, on the manifold."""
    return pin.integrate(robot.model, robot.home, rng.uniform(-spread, spread, robot.model.nv))


def obstacle(name, shape, position, rpy=(0.0, 0.0, 0.0)):
    fixed = config.Fixed(type="fixed", position=tuple(position), rpy=tuple(rpy))
    return Obstacle(name, shape, build_motion(fixed, None, None))


def random_scene(robot, rng, shapes):
    """The robot among obstacles at random poses within 0.8 m of the origin."""
    return build_scene(
        robot,
        [
            obstacle(f"o{i}", shape, rng.uniform(-0.8, 0.8, 3), rng.uniform(-3.0, 3.0, 3))
            for i, shape in enumerate(shapes)
        ],
    )


class Bench:
    """Tasks, rows and limits of a scene, without a solver."""

    def __init__(self, scene, tasks=(), avoidance=None, position_gain=0.5, dt=0.01):
        self.scene, self.robot, self.tasks = scene, scene.robot, tuple(tasks)
        limits = config.Limits(position_gain=position_gain)
        settings = ControlSettings(scene, scene.robot.bounds(), avoidance or config.Avoidance(), limits, dt)
        self.assembler = RowAssembler(settings, tasks)
        self.query = self.assembler.query

    def place(self, samples):
        """Obstacles at other samples, by number; all others where they are at time 0."""
        place(self.query, self.scene, samples)

    def compute(self, q, targets=None, reach=np.inf, v_desired=None):
        """Proximity and problem at q, of the tasks or of a velocity, as they are until the next call."""
        self.assembler.influence_distance = float(reach)
        self.query.set_influence_distance(float(reach))
        targets = targets or [task.motion.sample(0.0) for part in in_order(self.tasks) for task in part]
        for row, target in zip(self.assembler.targets, targets, strict=False):
            row[:] = target.row
        self.assembler.compute(np.asarray(q), targets, v_desired)
        return self.assembler.proximity(), self.assembler.problem()

    def rows(self, q, targets=None):
        """A and b of the tasks at q, copied."""
        tracking = self.compute(q, targets, reach=-1.0)[1].tracking
        return tracking.A.copy(), tracking.b.copy()


def place(query, scene, samples, margin=0.0):
    """Obstacles of a query at other samples, by number; all others where they are at time 0."""
    all_samples = [samples.get(i, obstacle.motion.sample(0.0)) for i, obstacle in enumerate(scene.obstacles)]
    query.place(ObstacleStates.of(all_samples, margin))


def task_bench(robot, *blocks, **settings):
    """Tasks of a robot without anything else around them."""
    return Bench(build_scene(robot), build_tasks(blocks, robot, robot.home), **settings)


_DATA = {}


def frames(robot, names, q):
    """Placements (SE3) of some frames, on data of their own: making these takes longer than using them."""
    if robot.name not in _DATA or _DATA[robot.name][0] is not robot.model:
        _DATA[robot.name] = robot.model, robot.model.createData()
    model, data = _DATA[robot.name]
    pin.framesForwardKinematics(model, data, q)
    return [data.oMf[robot.model.getFrameId(name)].copy() for name in names]


def lay_out_step(scene, avoidance=None):
    """Memory of a control step, as a controller lays it out, and the kinematics and distances that it looks into."""
    kinematics, query, limits = ForwardKinematics(scene.robot.model, []), DistanceQuery(scene), config.Limits()
    bounds, avoidance = scene.robot.bounds().within(limits), avoidance or config.Avoidance()
    settings = ControlSettings(scene, bounds, avoidance, limits, 0.01)
    return lay_out(settings, [], [], kinematics, query), kinematics, query


def make_layout(nv, pairs=0, obstacles=0, **fields):
    """Memory of a control step with other limits and pairs than its robot's: n coordinates without any limit.

    Kernels of joint limits and of rows read what is replaced here, and nothing else.

    Args:
        nv: number of coordinates.
        pairs: number of pairs, all of them near.
        obstacles: number of obstacles.
        fields: of `RowLayout`, in place of those.
    """
    infinite, none = np.full(nv, np.inf), np.zeros(0, dtype=np.intp)
    joints = JointBounds(infinite, none, none, np.zeros(0), np.zeros(0), infinite, infinite)
    rows = {name: np.full(pairs, np.nan) for name in ("d", "rhs", "rhs_contact")}
    given = {
        **limit_layout(joints, 0.5, 0.01), **rows, "near_pairs": np.arange(pairs), "closest": np.zeros((pairs, 10)),
        "J": np.ones((pairs, nv)), "feedforward": np.zeros(pairs), "twist_row": np.full(pairs, obstacles),
        "margin": np.zeros(obstacles + 1), "distance_allowance": np.zeros(pairs), "v_tracking": np.zeros(nv), **fields,
    }  # fmt: skip
    if not given["acceleration_limited"]:
        given["hard_lower"], given["hard_upper"] = given["lower"], given["upper"]
    elif given["hard_lower"] is given["lower"]:
        given["hard_lower"], given["hard_upper"] = np.zeros(nv), np.zeros(nv)
    return _layout_of_a_robot()._replace(**given)


@functools.cache
def _layout_of_a_robot():
    avoidance = config.Avoidance(d1=0.1, d2=0.3, row={"type": "beta", "gain": 5.0}, recovery_speed=0.2)
    return lay_out_step(build_scene(Robot.load("paper-dual-arm")), avoidance)[0]


def look(scene, q, samples=None, reach=np.inf, bench=None):
    """Proximity of a scene at q, with obstacles (by index) moved to `samples`."""
    bench = bench or Bench(scene)
    if samples:
        bench.place(samples)
    return Proximity(*[array.copy() for array in bench.compute(q, reach=reach)[0]])


def moved(sample, t):
    """Where a body is after t seconds at the sample's constant twist about its origin."""
    return Sample.at(sample.position + t * sample.linear, pin.exp3(t * sample.angular) @ sample.rotation)


def differences(f, robot, q, step=1e-6):
    """Central differences of f (m,) along every velocity coordinate: (m, nv)."""
    eye = np.eye(robot.model.nv)
    ahead, behind = ([f(pin.integrate(robot.model, q, s * step * e)) for e in eye] for s in (1.0, -1.0))
    return (np.array(ahead) - np.array(behind)).T / (2.0 * step)


def write_chain(folder, joints=3, joint_type="revolute", shape='<cylinder radius="0.03" length="0.2"/>'):
    """A URDF of links 0.3 m long in a row along z, that turn about x; each carries one collision shape."""
    parts = []
    for i in range(joints + 1):
        collision = f'<collision><origin xyz="0 0 0.15"/><geometry>{shape}</geometry></collision>'
        parts.append(f'<link name="link{i}">{collision}</link>')
        if i:
            parts.append(
                f'<joint name="joint{i}" type="{joint_type}"><parent link="link{i - 1}"/><child link="link{i}"/>'
                f'<origin xyz="0 0 0.3"/><axis xyz="1 0 0"/>'
                '<limit lower="-2" upper="2" velocity="1.5" effort="1"/></joint>'
            )
    path = folder / "chain.urdf"
    path.write_text(f'<robot name="chain">{"".join(parts)}</robot>')
    return path


def instructions(call):
    """How many bytecode instructions a call executes: any loop in Python over the pairs shows in it."""
    count = 0

    def trace(frame, event, arg):
        nonlocal count
        frame.f_trace_opcodes = True
        count += event == "opcode"
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        call()
    finally:
        sys.settrace(before)
    return count
