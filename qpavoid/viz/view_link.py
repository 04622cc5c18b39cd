"""Link between a control loop and its view in another process: datagrams that are dropped where they do not fit."""

from __future__ import annotations

import json
import socket
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from qpavoid.control.tick import Tick
from qpavoid.errors import ConfigError
from qpavoid.problem import Array
from qpavoid.viz.meshes import Mesh

MAX_WITNESSES = 64
"""Pairs within the influence distance whose witness points are sent: the closest ones."""
_QUEUE = 1 << 18
"""Memory of the link in each direction [bytes]; a datagram takes 1 to 20 kB."""
_HEADER = 7
"""Numbers at the start of a datagram: time, and how many there are of each part."""


class Frame(NamedTuple):
    """What the view shows of one control step."""

    t: float
    """Time [s]."""
    q: Array
    """(nq,) configuration."""
    v: Array
    """(nv,) commanded velocity [rad/s or m/s]."""
    witnesses: Array
    """(k, 7) of each pair in range: distance between surfaces, two witness points [m]."""
    tools: Array
    """(f, 3) positions of the frames with tasks [m]."""
    targets: Array
    """(f, 12) their targets: rotation by columns, then position [m]."""
    obstacles: Array
    """(o, 12) poses of the obstacles, as those of the targets."""
    levels: Array
    """(2,) d1 and d2, between surfaces [m]."""
    text: str = ""
    """Status, in Markdown."""


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
    controls: dict[str, Any] = field(default_factory=dict)
    """Choices and values of the controls of a run; none where empty."""
    host: str = "127.0.0.1"
    port: int = 8080
    rate: float = 30.0
    """Frames shown, at most [1/s]."""
    quality: str = "high"
    """`high`, or `low` for machines without a graphics processor."""
    parent: int = 0
    """Process whose end ends the page."""


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


def frame_of(tick: Tick, text: str = "") -> Frame:
    """Return what is shown of a control step."""
    near, closest = tick.problem.avoidance, tick.proximity.closest
    # the gains take distances with an offset, the same of all pairs but for those with a safety distance of their own
    offset = float(np.median(near.d - closest[:, 0])) if 0 < len(near.d) == len(closest) else 0.0
    witnesses = closest[:, [0, 4, 5, 6, 7, 8, 9]]
    if len(witnesses) > MAX_WITNESSES:
        witnesses = witnesses[np.argsort(witnesses[:, 0])[:MAX_WITNESSES]]
    tools = tick.kinematics.position
    targets = np.array([target.row[:12] for target in tick.targets[: len(tools)]]).reshape(-1, 12)
    levels = np.array([near.d1 - offset, near.d2 - offset])
    return Frame(
        tick.state.t, tick.state.q, tick.solution.v, witnesses, tools, targets, tick.obstacles, levels, text
    )  # fmt: skip


def pack(frame: Frame) -> bytes:
    """Return a frame as a datagram."""
    counts = [len(part) for part in frame[1:7]]
    numbers = np.concatenate([(frame.t, *counts), *(np.ravel(part) for part in frame[1:8])])
    return bytes(numbers.tobytes() + frame.text.encode())


def unpack(datagram: bytes) -> Frame:
    """Return the frame of a datagram."""
    t, *counts = np.frombuffer(datagram, count=_HEADER).tolist()
    nq, nv, k, f, g, o = map(int, counts)
    parts: list[Any] = []
    place = _HEADER
    for shape in ((nq,), (nv,), (k, 7), (f, 3), (g, 12), (o, 12), (2,)):
        size = int(np.prod(shape))
        parts.append(np.frombuffer(datagram, count=size, offset=8 * place).reshape(shape))
        place += size
    q, v, witnesses, tools, targets, obstacles, levels = parts
    return Frame(t, q, v, witnesses, tools, targets, obstacles, levels, datagram[8 * place :].decode())
