"""The loop of the service: one answer to each request, commands to all who listen, a stop where steps stay out."""

from __future__ import annotations

import time
from collections import Counter, deque
from enum import Enum
from importlib.metadata import version
from typing import Any

import numpy as np
import zmq

from qpavoid.config import ScenarioConfig
from qpavoid.controller import Controller
from qpavoid.errors import ConfigError, QpavoidError
from qpavoid.model.scene import Obstacle
from qpavoid.problem import Status
from qpavoid.reason import ReasonKind
from qpavoid.service import messages
from qpavoid.service.holding import HeldObstacles, HeldTargets, without_motions
from qpavoid.service.messages import Fault, Refusal, Request
from qpavoid.solvers import Solver

_QUEUE = 32
"""Messages that wait, of each client and to each listener: older commands are dropped, further requests not taken."""
_DROPPED = 4 * 2**20
"""Frames from which on a client is disconnected without an answer [bytes]."""
_BATCH = 64
"""Requests that are read before any is answered: of more steps of a client, the last one counts."""
_TIMED = 1000
"""Answers whose times are remembered [-]."""
_IDLE = 0.2
"""Time after which the loop looks whether it has to end [s]."""
_STANDSTILL = 1e-9
"""Speed from which on a robot stands [rad/s, m/s]."""
_LONGEST_STOP = 10.0
"""Time for the stop of a robot when the service ends [s]."""
_STOPS = {
    "HEARTBEAT_LOST": "no step came in time: braking, then at rest until a reset",
    "SERVER_ENDS": "the server was asked to end: braking, then at rest; no further command comes",
}
"""Kinds of the reason of a stop that no step asked for, in words."""


def _stop(kind: str) -> dict[str, Any]:
    """Return the reason of a stop."""
    return {"kind": kind, "subject": [], "amount": None, "unit": "", "severity": "ALARM", "text": _STOPS[kind]}


class _State(str, Enum):
    READY = "READY"
    """No client is in control; the first step takes it."""
    RUNNING = "RUNNING"
    """Steps come in time."""
    HALTED = "HALTED"
    """They did not, or the server ends: braking, then at rest."""


class Service:
    """A controller behind two sockets: requests, and a stream of commands."""

    def __init__(
        self,
        scenario: ScenarioConfig,
        heartbeat: float = 0.1,
        host: str = "127.0.0.1",
        port: int = 5570,
        follows_motions: bool = False,
        law: Solver | None = None,
    ) -> None:
        """Build the scenario's controller, and bind the sockets.

        Args:
            scenario: whose robot, obstacles and tasks are served.
            heartbeat: time without a step after which the robot is stopped [s].
            host: address of this machine to be reached at.
            port: of requests; that of commands is the next one. 0: any that are free.
            follows_motions: whether targets and obstacles that a step leaves out move as the scenario has it; else
                targets are held, and obstacles stand.
            law: replaces the scenario's solver; None: it stays.

        Raises:
            ConfigError: an address or port that cannot be had, a heartbeat of less than two control periods.
        """
        scenario = scenario if follows_motions else without_motions(scenario)
        if not 2.0 * scenario.dt <= heartbeat <= 10.0:
            raise ConfigError(f"heartbeat: {heartbeat} s, expected {2.0 * scenario.dt:g} (two dt) to 10")
        controller, q0 = Controller.from_scenario(scenario)
        controller.solver = law or controller.solver
        self._controller, self._q0, self._heartbeat = controller, q0, heartbeat
        self._context = zmq.Context()
        self._requests, self._commands = self._context.socket(zmq.ROUTER), self._context.socket(zmq.PUB)
        for socket in (self._requests, self._commands):
            socket.setsockopt(zmq.LINGER, 200)
            socket.setsockopt(zmq.RCVHWM, _QUEUE)
            socket.setsockopt(zmq.SNDHWM, _QUEUE)
            socket.setsockopt(zmq.MAXMSGSIZE, _DROPPED)
        self.endpoint = self._bind(self._requests, host, port)
        """Address of requests."""
        self.commands_endpoint = self._bind(self._commands, host, port + 1 if port else 0)
        """Address of commands."""
        self.state = _State.READY
        self._client = b""
        self._last, self._next, self._published = 0.0, 0.0, 0
        self._v = np.zeros(controller.scene.robot.model.nv)  # commanded last
        self._counts, self._times = Counter[str](), deque[float](maxlen=_TIMED)
        self._halts, self._stop = 0, _stop("HEARTBEAT_LOST")
        self._is_ended = False
        robot = controller.scene.robot
        self._obstacles = HeldObstacles()
        self._targets = None if follows_motions else HeldTargets(scenario, robot)
        self._description: dict[str, Any] = {
            "qpavoid": version("qpavoid"),
            "robot": robot.name,
            "dt": controller.dt,
            "heartbeat": heartbeat,
            "q0": q0.tolist(),
            "positions": list(robot.position_names),
            "velocities": list(robot.coordinate_names),
            "units": list(robot.coordinate_units),
            "targets": [task.settings.label for task in controller.tasks],
            "commands": self.commands_endpoint,
        }

    def _bind(self, socket: Any, host: str, port: int) -> str:
        try:
            socket.bind(f"tcp://{host}:{port or '*'}")
        except zmq.ZMQError as error:
            self.close()
            raise ConfigError(f"tcp://{host}:{port}: {error}; give another --host or --port") from None
        return str(socket.getsockopt_string(zmq.LAST_ENDPOINT))

    def close(self) -> None:
        """Free the sockets."""
        self._context.destroy()

    def end(self) -> None:
        """Let `run` return, once the robot stands."""
        self._is_ended = True

    def run(self) -> None:
        """Answer until `end` is called; a robot that moves is stopped before."""
        while not self._is_ended:
            self._turn()
        end = time.monotonic() + _LONGEST_STOP
        if self.state is _State.RUNNING:
            self._halt("SERVER_ENDS")
            self._brake(self._next)
        while self._is_moving and time.monotonic() < end:
            self._turn()

    @property
    def _is_moving(self) -> bool:
        return self.state is not _State.READY and float(np.abs(self._v).max(initial=0.0)) > _STANDSTILL

    def _turn(self) -> None:
        """Wait for requests, at most until something is due; answer them; do what is due."""
        now = time.monotonic()
        due = {_State.READY: now + _IDLE, _State.RUNNING: self._last + self._heartbeat, _State.HALTED: self._next}
        wait = min(max(due[self.state] - now, 0.0), _IDLE)
        if self._requests.poll(int(np.ceil(1e3 * wait))):
            self._answer_all()
        now = time.monotonic()
        if self.state is _State.RUNNING and now >= self._last + self._heartbeat:
            self._halt("HEARTBEAT_LOST")
        if self.state is _State.HALTED and now >= self._next:
            self._brake(now)

    def _halt(self, why: str) -> None:
        self.state, self._client, self._next = _State.HALTED, b"", time.monotonic()
        self._stop, self._halts = _stop(why), self._halts + 1

    def _brake(self, now: float) -> None:
        """Command the next velocity of a stop, or zero.

        A step without a known configuration is one: the robot is taken to be where the last velocity has led it.
        """
        fields: dict[str, Any] = {"command_scale": 0.0, "step_time": 0.0}
        if self._is_moving:
            solution = self._controller.step(np.full(len(self._q0), np.nan))
            self._v = np.where(np.abs(solution.v) > _STANDSTILL, solution.v, 0.0)
            fields = messages.command_fields(solution, self._controller.dt)
        fields |= {
            "v": self._v.tolist(), "dt": self._controller.dt, "status": Status.STOPPED.value,
            "reasons": [self._stop], "stalled": [], "assumptions": [],
        }  # fmt: skip
        self._publish(None, fields)
        self._next = max(self._next + self._controller.dt, now)

    def _publish(self, seq: int | None, fields: dict[str, Any]) -> bytes:
        """Send a command to all who listen; return it."""
        self._published += 1
        command = messages.pack("command", seq, count=self._published, **fields)
        self._commands.send(command, zmq.NOBLOCK)
        return command

    def _answer_all(self) -> None:
        """Read the requests that have come, and answer each."""
        received, last_steps = [], dict[bytes, int]()
        for i in range(_BATCH):
            try:
                frames = self._requests.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                break
            arrived, client = time.monotonic(), frames[0]
            envelope = 2 if len(frames) > 2 and not frames[1] else 1  # of a REQ socket, an empty frame comes first
            try:
                request: Request | Refusal = messages.read_request(frames[envelope:])
            except Refusal as refusal:
                request = refusal
            if isinstance(request, messages.Step):
                last_steps[client] = i
            received.append((frames[:envelope], frames[envelope + 1 :], request, arrived))
        for i, (envelope_frames, clouds, request, arrived) in enumerate(received):
            client = envelope_frames[0]
            try:
                if isinstance(request, Refusal):
                    raise request
                if isinstance(request, messages.Step) and last_steps[client] != i:
                    raise Refusal(Fault.SUPERSEDED, "a later step was there already", request.seq)
                answer = self._answer(client, request, clouds)
            except Refusal as refusal:
                self._counts[refusal.fault.value] += 1
                answer = messages.pack_refusal(refusal)
            self._requests.send_multipart([*envelope_frames, answer], zmq.NOBLOCK)
            self._times.append(time.monotonic() - arrived)

    def _answer(self, client: bytes, request: Request, clouds: list[bytes]) -> bytes:
        """Return the answer to a request.

        Raises:
            Refusal: nothing was changed.
        """
        self._counts[request.type] += 1
        if isinstance(request, messages.Hello | messages.Status):
            fields = self._introduction() if isinstance(request, messages.Hello) else self._statistics()
            return messages.pack(request.type, request.seq, **fields)
        if self._is_ended:
            raise Refusal(Fault.HALTED, "the server ends", request.seq)
        if self.state is _State.RUNNING and client != self._client:
            raise Refusal(Fault.BUSY, "another client is in control", request.seq)
        try:
            if isinstance(request, messages.Step):
                return self._step(client, request, clouds)
            self._change(client, request)
        except QpavoidError as error:
            raise Refusal(Fault.REFUSED, str(error), request.seq) from None
        return messages.pack("done", request.seq)

    def _step(self, client: bytes, step: messages.Step, clouds: list[bytes]) -> bytes:
        if self.state is _State.HALTED:
            raise Refusal(Fault.HALTED, "steps did not come in time: send a reset", step.seq)
        if step.deadline is not None and time.monotonic() > step.deadline:
            raise Refusal(Fault.LATE, "its deadline has passed", step.seq)
        sent = messages.obstacles_of(step, clouds, self._obstacles.rotations)
        obstacles, last = self._obstacles.complete(sent), self._targets
        q, v = np.array(step.q), None if step.v is None else np.array(step.v)
        if isinstance(step, messages.Filter):
            messages.targets_of(step, {})  # they play no part, but have to be targets
            solution = self._controller.filter(q, np.array(step.v_desired), step.t, obstacles, v)
            if last is not None:
                last.forget()
        elif last is None or len(q) != len(self._q0):  # the controller refuses that
            solution = self._controller.step(q, step.t, messages.targets_of(step, {}), obstacles, v)
        else:
            last.begin(q)
            targets = messages.targets_of(step, last.rotations)
            solution = self._controller.step(q, step.t, last.complete(targets), obstacles, v)
            if not any(reason.kind is ReasonKind.IMPLAUSIBLE for reason in solution.reasons):
                last.keep(targets)
        self._obstacles.keep(sent)
        self.state, self._client, self._last, self._v = _State.RUNNING, client, time.monotonic(), solution.v
        return self._publish(step.seq, messages.command_fields(solution, self._controller.dt))

    def _change(self, client: bytes, request: Request) -> None:
        """Do what is neither a question nor a step.

        Raises:
            QpavoidError: the controller refuses it.
        """
        controller = self._controller
        match request:
            case messages.Reset():
                v = self._v if request.v is None else np.array(request.v)
                controller.reset(v)
                self._obstacles.after_reset()
                if self._targets is not None:
                    self._targets.forget()
                self._v, self.state, self._client = v, _State.RUNNING, client
                self._last = time.monotonic()
                if not self._is_moving:  # a robot at rest may wait for its first step
                    self.state, self._client = _State.READY, b""
            case messages.AddObstacle():
                controller.add_obstacle(
                    Obstacle.at(
                        request.name, request.shape, request.position, messages.rotation_of(request),
                        request.graspable, uncertainty=request.uncertainty,
                    )
                )  # fmt: skip
            case messages.RemoveObstacle():
                controller.remove_obstacle(request.name)
                self._obstacles.drop(request.name)
            case messages.Attach():
                controller.attach(request.name, request.frame)
                self._obstacles.drop(request.name)
            case messages.Release():
                controller.release(request.name)

    def _introduction(self) -> dict[str, Any]:
        """Return what a client has to know."""
        obstacles = list(self._controller.scene.obstacle_names)
        return {**self._description, "obstacles": obstacles, "state": self.state.value}

    def _statistics(self) -> dict[str, Any]:
        """Return counts of requests and refusals, and the time from a request to its answer [s]."""
        times = np.array(self._times) if self._times else np.zeros(1)
        return {
            "state": self.state.value,
            "counts": dict(self._counts),
            "halts": self._halts,
            "p50": float(np.median(times)),
            "p99": float(np.percentile(times, 99)),
        }
