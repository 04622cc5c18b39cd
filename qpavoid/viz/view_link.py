"""Link between a control loop and its view in another process: datagrams that are dropped where they do not fit."""

from __future__ import annotations

import json
import pickle
import socket
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from qpavoid.config import Avoidance
from qpavoid.control.tasks import RowTask, in_order
from qpavoid.control.tick import Tick
from qpavoid.errors import ConfigError
from qpavoid.model.robot import Robot
from qpavoid.model.scene import Scene
from qpavoid.problem import Array, IntArray
from qpavoid.viz.meshes import Mesh, decimated

MAX_WITNESSES = 64
"""Pairs within the influence distance whose witness points are sent: the closest ones."""
_QUEUE = 1 << 18
"""Memory of the link in each direction [bytes]; a datagram takes 1 to 20 kB."""
_HEADER = 10
"""Numbers at the start of a frame: time, and how many there are of each part."""
MAX_GHOSTS = 4
"""Poses of the backup trajectory that are shown."""
BACKUP = 0
"""Number of the ghosts of a backup trajectory; those of the other runs begin at 1."""


class Frame(NamedTuple):
    """What the view shows of one control step."""

    t: float
    """Time [s]."""
    q: Array
    """(nq,) configuration."""
    v: Array
    """(nv,) commanded velocity [rad/s or m/s]."""
    witnesses: Array
    """(k, 8) of each pair in range: distance between surfaces, two witness points [m], number of the obstacle, -1
    between two bodies of the robot."""
    tools: Array
    """(f, 3) positions of the frames with tasks [m]."""
    targets: Array
    """(f, 12) their targets: rotation by columns, then position [m]."""
    obstacles: Array
    """(o, 12) poses of the obstacles, as those of the targets."""
    levels: Array
    """(2,) d1 and d2, between surfaces [m]."""
    ghosts: Array
    """(g, 2 + nq) robots that are shown translucent: BACKUP or number of the run, its least distance [m],
    configuration."""
    touching: Array
    """(b,) numbers of the robot's bodies that touch something."""
    text: str = ""
    """Status, in HTML; empty where it is the one before."""


@dataclass
class PageSetup:
    """What does not change while a page is shown."""

    title: str
    model: Any
    """Pinocchio model of the robot."""
    urdf: Path
    package_dirs: tuple[str, ...]
    bodies: list[tuple[int, Any, Mesh]]
    """Joint, placement on it and mesh of each collision body."""
    obstacles: list[tuple[str, Mesh]]
    targets: list[tuple[str, bool]]
    """Names of the frame tasks whose targets may be dragged, and whether they may be turned, too."""
    joint_names: list[str]
    speed_limits: Array
    """(nv,) [rad/s or m/s]."""
    camera: tuple[Array, Array]
    """Where the page is looked at from at first, and the point in its middle (3,) [m]."""
    planned: list[Array] = field(default_factory=list)
    """Paths (n, 3) that the tools are to follow [m]."""
    others: list[str] = field(default_factory=list)
    """Names of the other runs that are shown as ghosts."""
    controls: dict[str, Any] = field(default_factory=dict)
    """Choices and values of the controls of a run; none where empty."""
    host: str = "127.0.0.1"
    port: int = 8080
    rate: float = 30.0
    """Frames shown, at most [1/s]."""
    quality: str = "high"
    """`high`, or `low` for machines without a graphics processor."""
    waiting: str = ""
    """What is shown, with the seconds that have gone by, until the first frame has a status; in plain text."""
    parent: int = 0
    """Process whose end ends the page."""


class SlotChange(NamedTuple):
    """An obstacle that came, or went."""

    slot: int
    name: str
    """Empty of an empty slot."""
    mesh: Mesh


def make_link() -> tuple[socket.socket, socket.socket]:
    """Make the two ends of a link; neither ever waits.

    Raises:
        ConfigError: the system has no such sockets.
    """
    if not hasattr(socket, "AF_UNIX"):
        raise ConfigError("the live view needs AF_UNIX sockets, which this system does not have; use qpavoid render")
    ends = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    for end in ends:
        end.setblocking(False)
        end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _QUEUE)
        end.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _QUEUE)
    return ends


def send(link: socket.socket, datagram: bytes) -> bool:
    """Send a datagram; return False where it does not fit, or no process is at the other end."""
    try:
        link.send(datagram)
    except OSError:
        return False
    return True


def received(link: socket.socket) -> Iterator[bytes]:
    """Yield the datagrams that have come."""
    while True:
        try:
            yield link.recv(_QUEUE)
        except OSError:
            return


def send_event(link: socket.socket, **event: Any) -> bool:
    """Send an event as JSON; see `send`."""
    return send(link, json.dumps(event).encode())


def frame_of(tick: Tick, robot: Robot, obstacle_of_pair: IntArray, text: str = "") -> Frame:
    """Return what is shown of a control step.

    Args:
        tick: the step.
        robot: whose model moves the ghosts.
        obstacle_of_pair: see `obstacles_of_pairs`.
        text: status, in HTML.
    """
    near, closest = tick.problem.avoidance, tick.proximity.closest
    # the gains take distances with an offset, the same of all pairs but for those with a safety distance of their own
    offset = float(np.sort(near.d - closest[:, 0])[len(closest) // 2]) if 0 < len(near.d) == len(closest) else 0.0
    witnesses: Array = np.empty((len(closest), 8))
    witnesses[:, 0], witnesses[:, 1:7] = closest[:, 0], closest[:, 4:10]
    witnesses[:, 7] = obstacle_of_pair[tick.proximity.pair]
    if len(witnesses) > MAX_WITNESSES:
        witnesses = witnesses[np.argsort(witnesses[:, 0])[:MAX_WITNESSES]]
    tools = tick.kinematics.position
    targets = np.array([target.row[:12] for target in tick.targets[: len(tools)]]).reshape(-1, 12)
    levels = np.array([near.d1 - offset, near.d2 - offset])
    ghosts, q = np.empty((0, 2 + len(tick.state.q))), tick.state.q
    if len(tick.backup):
        configurations = []
        for part in np.array_split(tick.backup, MAX_GHOSTS):
            q = pin.integrate(robot.model, q, part.sum(axis=0))
            configurations.append((BACKUP, np.nan, *q))
        ghosts = np.array(configurations)
    return Frame(
        tick.state.t, tick.state.q, tick.solution.v, witnesses, tools, targets, tick.obstacles, levels, ghosts,
        _NONE, text,
    )  # fmt: skip


_NONE = np.zeros(0)


def still_frame(scene: Scene, tasks: Sequence[RowTask], q: Array, avoidance: Avoidance) -> Frame:
    """Return what is shown before there is a control step: the scene at t = 0, and no status."""
    targets = [task.motion.sample(0.0).row[:12] for task in in_order(tasks)[0]]
    obstacles = [obstacle.motion.sample(0.0).row[:12] for obstacle in scene.slots]
    return Frame(
        0.0, q, np.zeros(scene.robot.model.nv), np.zeros((0, 8)), np.zeros((0, 3)), np.reshape(targets, (-1, 12)),
        np.reshape(obstacles, (-1, 12)), np.array([avoidance.d1, avoidance.d2]), np.empty((0, 2 + len(q))), _NONE,
    )  # fmt: skip


def obstacles_of_pairs(scene: Scene) -> IntArray:
    """Return the number of the obstacle of each pair (m,), -1 between two bodies of the robot."""
    return np.asarray(scene.obstacle_of[scene.pairs].max(axis=1, initial=-1))


def bodies_in_contact(scene: Scene, pairs: IntArray, distances: Array) -> Array:
    """Return the numbers of the robot's bodies (b,) in pairs (k,) whose distances (k,) [m] are negative."""
    if not (distances < 0.0).any():
        return _NONE
    touching = np.unique(scene.pairs[pairs[distances < 0.0]])
    return touching[touching < len(scene.body_names)].astype(np.float64)


_FRAME, _CHANGE = b"f", b"c"


def pack(frame: Frame) -> bytes:
    """Return a frame as a datagram."""
    parts = frame[1:10]
    header = struct.pack(f"{_HEADER}d", frame.t, *(part.size for part in parts))
    return b"".join((_FRAME, header, *(part.tobytes() for part in parts), frame.text.encode()))


def pack_change(change: SlotChange) -> bytes:
    """Return a change of the scene as a datagram; a large mesh loses details until it fits."""
    mesh, cell = change.mesh, 0.005
    while len(datagram := _CHANGE + pickle.dumps(change._replace(mesh=mesh))) > _QUEUE // 4:
        mesh, cell = decimated(mesh, cell), 2.0 * cell
    return datagram


def unpack(datagram: bytes) -> Frame | SlotChange:
    """Return the frame or change of a datagram."""
    if datagram[:1] == _CHANGE:
        change: SlotChange = pickle.loads(datagram[1:])  # by this process's own parent
        return change
    t, *counts = np.frombuffer(datagram, count=_HEADER, offset=1).tolist()
    ends = np.cumsum([_HEADER, *counts]).astype(int)
    numbers = np.frombuffer(datagram, count=ends[-1], offset=1)
    q, v, *parts = [numbers[begin:end] for begin, end in pairwise(ends)]
    widths = (8, 3, 12, 12, 0, 2 + len(q), 0)
    shaped = (part.reshape(-1, width) if width else part for part, width in zip(parts, widths, strict=True))
    return Frame._make((t, q, v, *shaped, datagram[1 + 8 * ends[-1] :].decode()))
