"""placo, through a process of its own: it needs an older pinocchio than this library."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
import weakref
from collections.abc import Mapping
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path
from time import perf_counter
from typing import Any

import coal
import numpy as np
import pinocchio as pin

from qpavoid.errors import ConfigError
from qpavoid.model.sample import Sample
from qpavoid.problem import Array, Solution
from qpavoid.run.mujoco import hinge_or_slide
from qpavoid_bench.arena.case import Case
from qpavoid_bench.arena.libraries.common import Adapter
from qpavoid_bench.arena.libraries.settings import DAMPING, PLACO, PLACO_PYTHON
from qpavoid_bench.arena.world import World

WORKER = Path(__file__).with_name("placo_worker.py")
START_TIMEOUT = 120.0
"""Time for imports and set-up of the process [s]."""
STEP_TIMEOUT = 10.0
"""Time for one answer [s]; after that the process is ended, and every later step fails."""
_NO_LIMIT = 1e6
"""Value in the URDF of a limit that a joint does not have [rad, m or their rates]."""


class Pilot(Adapter):
    """placo's solver for one case; obstacles are bodies that no joint moves.

    Its constraint knows no motion of obstacles.
    """

    seconds: float
    """Time that the last step took in placo's process and for its targets, without the transport [s]."""

    def __init__(self, case: Case, world: World) -> None:
        """Start the process and set placo up in it.

        Raises:
            ConfigError: the case has something that it cannot be given, or the interpreter has no placo.
        """
        super().__init__(case, world, "placo")
        setup = {
            "urdf": self._write_urdf(),
            "joints": list(world.scene.robot.model.names)[1:],
            "bodies": [self._describe_body(body) for body in world.scene.geometry.geometryObjects],
            "pairs": self.pairs.tolist(),
            "tasks": [
                (task.moves, task.turns, task.settings.weight, task.settings.orientation_weight)
                for task in self.frame_tasks
            ],
            "dt": self.dt,
            "regularization": DAMPING**2,
            "margin": self.d1,
            "trigger": self.d2,
            "priority": PLACO["priority"],
        }
        self.worker = Worker(os.environ.get(PLACO_PYTHON) or sys.executable)
        try:
            self.worker.ask("setup", setup, START_TIMEOUT)
        except WorkerEnded as error:
            raise ConfigError(
                f"{self.worker.python} cannot run placo: {error}; set {PLACO_PYTHON} to the Python interpreter of an "
                "environment with placo"
            ) from error
        except RuntimeError as error:
            raise ConfigError(f"{self.source}: placo cannot be set up: {error}") from error

    def step(self, q: Array, t: float, targets: Mapping[str, Sample], obstacles: Mapping[str, Sample]) -> Solution:
        """Compute the velocity for the next control period.

        Raises:
            RuntimeError: placo found none, or its process has ended; the robot is held then.
        """
        begin = perf_counter()
        try:
            poses, place_time = self._place(q, obstacles)
            placed = perf_counter()
            there = self.targets_after_step(targets, poses)
            target_time = perf_counter() - placed
            v, solve_time = self.worker.ask("solve", there, STEP_TIMEOUT)
        except Exception:
            self.seconds = perf_counter() - begin
            raise
        self.seconds = place_time + target_time + solve_time
        return Solution(np.asarray(v))

    def frames(self, q: Array, obstacles: Mapping[str, Sample]) -> Array:
        """Return the poses (f, 4, 4) of the tasks' frames by placo."""
        return np.asarray(self._place(q, obstacles)[0])

    def distances(self) -> Array:
        """Return the distances (k,) of the pairs by placo [m]."""
        return np.asarray(self.worker.ask("distances", None, STEP_TIMEOUT)[0])

    def _place(self, q: Array, obstacles: Mapping[str, Sample]) -> tuple[Any, float]:
        bodies = {geometry: placement.homogeneous for geometry, placement in self.placements(obstacles)}
        return self.worker.ask("place", {"q": q, "bodies": bodies}, STEP_TIMEOUT)

    def _describe_body(self, body: Any) -> tuple[int, str, Any, Array]:
        """Return joint, shape, sizes and placement (4, 4) of a geometry.

        Raises:
            ConfigError: a shape that cannot be described.
        """
        kind: str = type(body.geometry).__name__
        sizes: Any
        match body.geometry:
            case coal.Sphere() as shape:
                sizes = (shape.radius,)
            case coal.Capsule() | coal.Cylinder() | coal.Cone() as shape:
                sizes = (shape.radius, 2.0 * shape.halfLength)
            case coal.Box() as shape:
                sizes = tuple((2.0 * shape.halfSide).tolist())
            case coal.Ellipsoid() as shape:
                sizes = tuple(shape.radii.tolist())
            case coal.Halfspace() as shape:
                sizes = (np.array(shape.n), shape.d)
            case coal.ConvexBase() as shape:
                kind, sizes = "Convex", np.array(shape.points())
            case _:
                raise ConfigError(f"{self.source}: {body.name!r}: the adapter of placo knows no {kind}")
        return int(body.parentJoint), kind, sizes, np.array(body.placement.homogeneous)

    def _write_urdf(self) -> str:
        """Write joints of the robot and frames of its tasks as URDF, without geometry.

        It has one link a joint, and one on a fixed joint a frame.
        """
        model, bounds = self.scene.robot.model, self.bounds
        limits = np.clip(np.stack((bounds.lower, bounds.upper), axis=1), -_NO_LIMIT, _NO_LIMIT).tolist()
        ranges = dict(zip(bounds.q_index.tolist(), limits, strict=True))
        lines = ['<robot name="robot">', *(f'<link name="link {joint}"/>' for joint in range(model.njoints))]
        for index in range(1, model.njoints):
            joint = model.joints[index]
            slides, axis = hinge_or_slide(model, index)
            low, high = ranges.get(joint.idx_q, (-_NO_LIMIT, _NO_LIMIT))
            lines.append(
                f'<joint name="{model.names[index]}" type="{"prismatic" if slides else "revolute"}">'
                f'<parent link="link {model.parents[index]}"/><child link="link {index}"/>'
                f'{_origin(model.jointPlacements[index])}<axis xyz="{_numbers(axis)}"/>'
                f'<limit lower="{low!r}" upper="{high!r}" effort="1" '
                f'velocity="{min(float(bounds.velocity[joint.idx_v]), _NO_LIMIT)!r}"/></joint>'
            )
        for number, task in enumerate(self.frame_tasks):
            frame = model.frames[task.frame_id]
            lines.append(
                f'<link name="frame {number}"/><joint name="to frame {number}" type="fixed">'
                f'<parent link="link {frame.parentJoint}"/><child link="frame {number}"/>'
                f"{_origin(frame.placement)}</joint>"
            )
        return "\n".join([*lines, "</robot>"])


class WorkerEnded(RuntimeError):
    """The process of placo has ended."""


class Worker:
    """Process of placo and the connection to it; it ends with this object."""

    def __init__(self, python: str) -> None:
        """Start the process with the interpreter `python`.

        Raises:
            ConfigError: there is no such interpreter.
        """
        self.python = python
        self._connection, there = Pipe()
        quiet = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
        try:
            self.process = subprocess.Popen(
                [python, str(WORKER), str(there.fileno())],
                pass_fds=[there.fileno()],
                env=quiet,  # its packages are its own
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )
        except OSError as error:
            raise ConfigError(f"{PLACO_PYTHON}: {python} cannot be run: {error.strerror}") from error
        finally:
            there.close()
        weakref.finalize(self, _close, self.process, self._connection)

    def ask(self, command: str, argument: Any, timeout: float) -> tuple[Any, float]:
        """Return the answer to a command, and the time that it took [s].

        Raises:
            WorkerEnded: it has ended, or does not answer within `timeout` [s] and has been ended for that.
            RuntimeError: it raised.
        """
        try:
            self._connection.send_bytes(pickle.dumps((command, argument), protocol=4))
            if not self._connection.poll(timeout):
                _close(self.process, self._connection)
                raise WorkerEnded(f"the process did not answer within {timeout:g} s, and was ended")
            answer, message, seconds = pickle.loads(self._connection.recv_bytes())
        except (EOFError, OSError) as error:
            raise WorkerEnded(f"the process has ended, with code {self.process.wait(STEP_TIMEOUT)}") from error
        if message:
            raise RuntimeError(message)
        return answer, seconds


def _close(process: subprocess.Popen[bytes], connection: Connection) -> None:
    connection.close()
    process.kill()
    process.wait()


def _origin(placement: Any) -> str:
    angles = pin.rpy.matrixToRpy(placement.rotation)
    return f'<origin xyz="{_numbers(placement.translation)}" rpy="{_numbers(angles)}"/>'


def _numbers(values: Any) -> str:
    return " ".join(repr(float(value)) for value in values)
