"""Messages of the service: msgpack maps of bounded size, checked field by field; what is wrong is refused by name."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import Enum
from functools import partial
from typing import Annotated, Any

import msgpack
import numpy as np
import pinocchio as pin
from pydantic import Field, ValidationError

from qpavoid.config import Shape
from qpavoid.config.base import LARGEST, Block
from qpavoid.config.explain import explain
from qpavoid.errors import QpavoidError, nearest
from qpavoid.model.cloud import Points
from qpavoid.model.sample import Pose, Sample
from qpavoid.problem import Array, Solution

VERSION = 1
"""Of the messages: a server answers none of another version."""
MAX_MESSAGE = 64 * 1024
"""Largest message [bytes]: its entries, at most one a byte, are read within a millisecond or two."""
MAX_POINTS = 30_000
"""Points of a cloud, at most: sorting them takes some milliseconds of a control step."""
MAX_CLOUDS = 4
"""Frames with points that may follow a message."""
MAX_FRAME = 12 * MAX_POINTS
"""Largest frame [bytes]: points of three 32-bit numbers."""
_MAX_TEXT = 500
"""Characters of an error's text."""


class Fault(str, Enum):
    """Why a message is refused; nothing was changed by it."""

    OVERSIZED = "OVERSIZED"
    """It, or points that follow it, are larger than allowed."""
    MALFORMED = "MALFORMED"
    """It is no msgpack map, or a field is missing, unknown, of a wrong type, NaN or infinite: `text` names it."""
    VERSION = "VERSION"
    """It is of another version of the messages."""
    REFUSED = "REFUSED"
    """The controller refuses it: a wrong number of joints, a name that does not exist."""
    BUSY = "BUSY"
    """Another client is in control."""
    HALTED = "HALTED"
    """The robot was stopped since steps did not come in time: a `reset` begins anew; or since the server ends."""
    SUPERSEDED = "SUPERSEDED"
    """A later step of the same client was there already."""
    LATE = "LATE"
    """Its deadline had passed."""


class Refusal(Exception):
    """A message that is refused."""

    def __init__(self, fault: Fault, text: str, seq: int | None = None) -> None:
        """Say what is wrong, and with which message."""
        super().__init__(text)
        self.fault, self.seq = fault, seq


Real = Annotated[float, Field(strict=True, ge=-LARGEST, le=LARGEST)]
Vector = Annotated[list[Real], Field(max_length=1000)]
Three = tuple[Real, Real, Real]
Quaternion = tuple[Real, Real, Real, Real]
Name = Annotated[str, Field(strict=True, min_length=1, max_length=200)]


class Place(Block):
    """Where something is, or should be; every other field may be left out."""

    position: Three | None = None
    """[m]."""
    quaternion: Quaternion | None = None
    """x, y, z, w [-]."""
    linear: Three | None = None
    """Velocity of the origin, world axes [m/s]."""
    angular: Three | None = None
    """Angular velocity, world axes [rad/s]."""
    t: Real | None = None
    """Time stamp, on the clock of the steps [s]."""
    at_rest: Annotated[bool, Field(strict=True)] = False
    """Of an obstacle: it stays there until it is given again."""

    def sample(self, rotation: Array | None = None) -> Any:
        """Return the form that `Controller.step` takes; a quaternion that is left out is `rotation` (3, 3)."""
        bare = self.linear is None and self.angular is None
        if self.position is None:
            if self.quaternion is None:
                raise ValueError("give a position or a quaternion")
            return Pose.at(np.zeros(3), self._rotation(), self.t, self.at_rest)
        if bare and self.quaternion is None and self.t is None and not self.at_rest:
            return np.array(self.position) if rotation is None else Pose.at(self.position, rotation)
        turn = rotation if self.quaternion is None else self._rotation()
        if bare and not self.at_rest:
            return Pose.at(self.position, turn, self.t)
        return Sample.at(self.position, turn, self.linear, self.angular, self.t, self.at_rest)

    def _rotation(self) -> Any:
        assert self.quaternion is not None
        quaternion = np.array(self.quaternion)
        length = np.linalg.norm(quaternion)
        if abs(length - 1.0) > 1e-3:
            raise ValueError(f"quaternion of length {length:.4g}, expected 1")
        return pin.Quaternion(quaternion / length).toRotationMatrix()


class Target(Place):
    """What a task should reach: a place; or one of the fields below."""

    q: Vector | None = None
    """Of a posture (nq,) [rad, m]."""
    direction: Three | None = None
    """Of an axis."""

    def sample(self, rotation: Array | None = None) -> Any:
        """See `Place.sample`."""
        if self.q is not None:
            return np.array(self.q)
        return np.array(self.direction) if self.direction is not None else super().sample(rotation)


class Update(Place):
    """Where an obstacle is; or the points of a cloud."""

    points: Annotated[int, Field(strict=True, ge=0, lt=MAX_CLOUDS)] | None = None
    """Number of the frame, after the message, that has x, y, z of each point in little-endian 32-bit numbers [m]."""

    def points_of(self, frames: Sequence[bytes]) -> Points:
        """Return the points of a cloud."""
        assert self.points is not None
        if self.points >= len(frames):
            raise ValueError(f"points: no frame {self.points} after the message")
        frame = frames[self.points]
        if len(frame) % 12:
            raise ValueError(f"points: {len(frame)} bytes, which are no points of three 32-bit numbers")
        array = np.frombuffer(frame, "<f4").reshape(-1, 3).astype(np.float64)
        return Points(array, None if self.position is None else self.sample(), self.t, self.at_rest)


class Request(Block):
    """Fields of every request."""

    version: Annotated[int, Field(strict=True)]
    type: str
    seq: Annotated[int, Field(strict=True, ge=0, lt=2**53)] = 0
    """Number that comes back with the answer."""


class Hello(Request):
    """Ask what is served."""


class Status(Request):
    """Ask for counts and times."""


class Reset(Request):
    """Take control, or take it again after a halt: the steps before are forgotten."""

    v: Vector | None = None
    """Velocity (nv,) as measured; that of the last command if left out [rad/s, m/s]."""


class Step(Request):
    """A control step: the answer is the velocity for the next dt."""

    q: Vector
    """(nq,) as measured [rad, m]."""
    t: Real | None = None
    """Time [s]; one dt after the last step if left out."""
    v: Vector | None = None
    """(nv,) as measured, see `Controller.step` [rad/s, m/s]."""
    deadline: Real | None = None
    """Time of this machine's monotonic clock from which on the answer is of no use [s]."""
    targets: dict[Name, Target] = Field(default_factory=dict)
    obstacles: dict[Name, Update] = Field(default_factory=dict)


class Filter(Step):
    """A step that follows a velocity in place of the tasks."""

    v_desired: Vector
    """(nv,) [rad/s, m/s]."""


class AddObstacle(Request):
    """Put an obstacle into a spare slot of the scenario."""

    name: Name
    shape: Shape
    position: Three
    quaternion: Quaternion = (0.0, 0.0, 0.0, 1.0)
    graspable: Annotated[bool, Field(strict=True)] = False
    uncertainty: Annotated[float, Field(strict=True, ge=0.0, le=LARGEST)] = 0.0


class RemoveObstacle(Request):
    """Take one out again."""

    name: Name


class Attach(Request):
    """Attach a graspable obstacle to a frame."""

    name: Name
    frame: Name


class Release(Request):
    """Release an attached obstacle."""

    name: Name


REQUESTS: Mapping[str, type[Request]] = {
    "hello": Hello, "status": Status, "reset": Reset, "step": Step, "filter": Filter, "add_obstacle": AddObstacle,
    "remove_obstacle": RemoveObstacle, "attach": Attach, "release": Release,
}  # fmt: skip


def read_request(frames: Sequence[bytes]) -> Request:
    """Check a message.

    Args:
        frames: the message, then points.

    Raises:
        Refusal: naming what is wrong with it.
    """
    seq, kind = None, ""
    try:
        if not frames or len(frames[0]) > MAX_MESSAGE:
            raise Refusal(Fault.OVERSIZED, f"a message of more than {MAX_MESSAGE} bytes")
        data = msgpack.unpackb(frames[0], raw=False, strict_map_key=True)
        if not isinstance(data, dict):
            raise Refusal(Fault.MALFORMED, f"a {type(data).__name__}, not a map")
        seq = _as_seq(data.get("seq", 0))
        if len(frames) > 1 + MAX_CLOUDS or max(map(len, frames)) > MAX_FRAME:
            raise Refusal(Fault.OVERSIZED, f"more than {MAX_CLOUDS} clouds, or {MAX_POINTS} points in one", seq)
        if data.get("version") != VERSION:
            raise Refusal(Fault.VERSION, f"version {data.get('version')!r:.40}; this server has {VERSION}", seq)
        kind = str(data.get("type"))[:60]
        if kind not in REQUESTS:
            raise Refusal(Fault.MALFORMED, f"type {kind!r}{nearest(kind, REQUESTS)}", seq)
        return REQUESTS[kind].model_validate(data)
    except Refusal:
        raise
    except ValidationError as error:
        raise Refusal(Fault.MALFORMED, explain(error, REQUESTS[kind], data), seq) from None
    except (ValueError, TypeError, OverflowError, RecursionError, msgpack.UnpackException) as error:
        seq = _seq_before_fault(frames[0]) if seq is None else seq
        raise Refusal(Fault.MALFORMED, f"no msgpack: {type(error).__name__}: {error}", seq) from None


def _as_seq(given: Any) -> int | None:
    return given if type(given) is int and 0 <= given < 2**53 else None


def _seq_before_fault(message: bytes) -> int | None:
    """Return the `seq` of a message that cannot be read as a whole; None where it does not come before the fault."""
    unpacker = msgpack.Unpacker(raw=True, strict_map_key=False)
    unpacker.feed(message)
    try:
        for _ in range(unpacker.read_map_header()):
            if unpacker.unpack() == b"seq":
                return _as_seq(unpacker.unpack())
            unpacker.skip()
    except (ValueError, TypeError, OverflowError, RecursionError, msgpack.UnpackException):
        pass
    return None


def targets_of(step: Step, rotations: Mapping[str, Array]) -> dict[str, Any]:
    """Return the targets of a step; `rotations` are those (3, 3) in place of quaternions that are left out.

    Raises:
        Refusal: naming one.
    """
    return {
        name: _named(f"targets.{name}", partial(target.sample, rotations.get(name)), step.seq)
        for name, target in step.targets.items()
    }


def obstacles_of(step: Step, frames: Sequence[bytes], rotations: Mapping[str, Array]) -> dict[str, Any]:
    """Return the obstacles of a step; `frames` are those with points, `rotations` as in `targets_of`.

    Raises:
        Refusal: naming one.
    """
    return {
        name: _named(
            f"obstacles.{name}",
            partial(update.sample, rotations.get(name)) if update.points is None else partial(update.points_of, frames),
            step.seq,
        )
        for name, update in step.obstacles.items()
    }


def rotation_of(request: AddObstacle) -> Any:
    """Return the orientation of an obstacle that is added.

    Raises:
        Refusal: no quaternion.
    """
    pose = _named("quaternion", Place(position=request.position, quaternion=request.quaternion).sample, request.seq)
    return pose.rotation


def _named(where: str, make: Any, seq: int) -> Any:
    try:
        return make()
    except (ValueError, QpavoidError) as error:
        raise Refusal(Fault.MALFORMED, f"{where}: {error}", seq) from None


def pack(kind: str, seq: int | None, **fields: Any) -> bytes:
    """Return an answer as bytes."""
    content: bytes = msgpack.packb({"version": VERSION, "type": kind, "seq": seq, **fields})
    return content


def pack_refusal(refusal: Refusal) -> bytes:
    """Return the answer to a message that is refused."""
    text = "".join(c if c.isprintable() else "?" for c in str(refusal))[:_MAX_TEXT]
    return pack("error", refusal.seq, error=refusal.fault.value, text=text)


def command_fields(solution: Solution, dt: float) -> dict[str, Any]:
    """Return a solution as the fields of a command."""
    return {
        "v": solution.v.tolist(),
        "dt": dt,
        "status": solution.status.value,
        "reasons": [reason.as_dict() for reason in solution.reasons],
        "stalled": [reason.as_dict() for reason in solution.stalled],
        "assumptions": [reason.as_dict() for reason in solution.assumptions],
        "command_scale": float(solution.command_scale),
        "step_time": float(solution.build_time + solution.solve_time),
    }
