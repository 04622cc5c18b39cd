"""Robots, random scenes and finite differences shared by the tests."""

import sys
import warnings

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import settings

from qpavoid import Controller, Obstacle, Robot, Sample, build_scene, config, load_scenario
from qpavoid.cli import main
from qpavoid.config.shipped import example_robot_data
from qpavoid.control.assembler import Assembly
from qpavoid.control.distances import DistanceQuery
from qpavoid.control.tasks.frames import in_order
from qpavoid.control.trajectories import as_samples, put
from qpavoid.kernels.cache import FOLDER
from qpavoid.kernels.layout import RowLayout
from qpavoid.model.kinematics import ForwardKinematics
from qpavoid.model.trajectory import build_motion

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
    return Robot.load("panda")


@pytest.fixture(scope="session")
def panda_convex():
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

    def __init__(self, scene, tasks=(), avoidance=None, position_gain=0.5, damping=0.0, dt=0.01, query=None):
        self.robot, self.tasks = scene.robot, tuple(tasks)
        self.kinematics = ForwardKinematics(
            scene.robot.model,
            [i for task in tasks for i in (task.frame_ids if hasattr(task, "frame_ids") else (task.frame_id,))],
        )
        self.query = query or DistanceQuery(scene)
        self.assembly = Assembly(
            scene, tasks, scene.robot.bounds(), self.kinematics, self.query, avoidance or config.Avoidance(),
            config.Limits(position_gain=position_gain), damping, dt,
        )  # fmt: skip

    def compute(self, q, targets=None, reach=np.inf):
        """Proximity and problem at q, as they are until the next call."""
        self.kinematics.compute(q)
        self.query.compute(self.kinematics.data, reach)
        targets = targets or [task.motion.sample(0.0) for part in in_order(self.tasks) for task in part]
        for view, target in zip(as_samples(self.assembly.targets), targets, strict=False):
            put(view, target)
        return self.assembly.compute(np.asarray(q), targets, self.query, reach)


def make_layout(nv, frames=0, turns=(), pairs=0, obstacles=0, joints=1, **fields):
    """Memory of a tick in which all inputs but `fields` are zero or without effect, and all outputs NaN."""
    rows = 3 * (frames + len(turns))
    row_wrenches = np.zeros((rows, 6))
    row_wrenches[: 3 * frames, :3] = np.tile(np.eye(3), (frames, 1))
    row_wrenches[3 * frames :, 3:] = np.tile(np.eye(3), (len(turns), 1))
    none = np.zeros(0, dtype=np.intp)
    inputs = {
        "J_world": np.zeros((6, nv), order="F"), "columns": np.arange(nv), "has_mimics": False,
        "unfolded_row": np.zeros(nv),
        "frame_poses": np.zeros((frames, 12)),
        "frame_ids": np.arange(frames), "targets": np.zeros((frames, 18)), "oriented": np.array(turns, dtype=np.intp),
        "gain": np.ones(frames), "cap": np.full(frames + len(turns), np.inf), "scale": np.ones(rows),
        "task_support": np.ones((rows, nv)), "row_wrenches": row_wrenches, "results": np.zeros((pairs, 10)),
        "support": np.ones((pairs, nv)), "twists": np.zeros((obstacles + 1, 6)),
        "twist_row": np.full(pairs, obstacles), "margin": np.zeros(obstacles + 1),
        "distance_allowance": np.zeros(pairs),
        "joint_poses": np.zeros((joints, 12)), "joint_radius": np.zeros(joints),
        "parents": np.maximum(np.arange(joints) - 1, 0), "column_joints": np.full(nv, joints - 1),
        "chain_rotation": np.ones((1, nv)), "chain_translation": np.zeros((1, nv)), "lever_arm": 1.0,
        "bodies": np.zeros((pairs, 2), dtype=np.intp), "body_poses": np.zeros((1, 12)), "boxes": np.zeros((1, 6)),
        "convex": np.zeros(pairs, dtype=bool),
        "moved_by": np.zeros((pairs, 2), dtype=np.intp), "speeds": np.zeros(joints + obstacles),
        "q_index": none, "v_index": none, "q_lower": np.zeros(0),
        "q_upper": np.zeros(0), "v_max": np.full(nv, np.inf), "v_step": np.full(nv, np.inf), "v_prev": np.zeros(nv),
        "dv_step": np.full(nv, np.inf), "dv_prev": np.zeros(nv), "jerk_limited": False, "looks_ahead": True,
        "damping": 0.0, "offset": 0.0, "safety_distance": 0.1, "row_gain": 5.0,
        "recovery_speed": 0.2, "beta": True, "d1": 0.1,
        "task_switching": False, "retreat_speed": 0.0, "alpha_cap": 50.0, "d2": 0.3, "position_rate": 50.0, "dt": 0.01,
        "acceleration_limited": False,
    }  # fmt: skip
    shapes = {
        "poses": (frames, 12), "A": (rows, nv), "b": rows, "closest": (pairs, 10), "J": (pairs, nv),
        "feedforward": pairs,
        "d": pairs, "rhs": pairs, "rhs_contact": pairs, "hard_lower": nv, "hard_upper": nv, "lower": nv, "upper": nv,
        "v_stop": nv, "v_tracking": nv, "omega": (joints, 3),
    }  # fmt: skip
    outputs = {"near_pairs": np.full(pairs, -1), **{name: np.full(shape, np.nan) for name, shape in shapes.items()}}
    given = {**inputs, **outputs, **fields}
    if not given["acceleration_limited"]:
        given["hard_lower"], given["hard_upper"] = given["lower"], given["upper"]
    return RowLayout(**given)


def look(scene, q, samples=None, reach=np.inf, query=None):
    """Proximity of a scene at q, with obstacles (by index) moved to `samples`."""
    bench = Bench(scene, query=query)
    for index, sample in (samples or {}).items():
        bench.query.place_obstacle(index, sample)
    return bench.compute(q, reach=reach)[0]


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
