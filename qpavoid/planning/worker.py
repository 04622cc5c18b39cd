"""Where looks ahead are computed: in the step that asks for one, or in a process of their own, which no step waits for.

Not in a thread: it would share the interpreter with the control loop, whose slowest steps then take twenty times as
long. Threads only wait here, on the pipes of the process.
"""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
from collections.abc import Sequence
from copy import deepcopy
from queue import SimpleQueue
from threading import Thread
from typing import Any, BinaryIO, NamedTuple, Protocol

from qpavoid.config import Planning, SolverConfig
from qpavoid.control.contacts import ContactRows
from qpavoid.control.settings import ControlSettings
from qpavoid.control.tasks import RowTask
from qpavoid.control.tasks.com import Com
from qpavoid.errors import ConfigError
from qpavoid.planning.candidates import Candidates, Outcome, is_sound
from qpavoid.planning.forecast import Forecaster, Snapshot
from qpavoid.planning.planner import Planner, PlannerSettings

_NICE = 10
"""By how much the process lets others go first, the control loop above all, where cores are scarce."""
_SERVE = "from qpavoid.planning.worker import serve; serve()"
"""What the process runs."""


class Parts(NamedTuple):
    """What a controller is made of, as far as forecasts need it."""

    settings: ControlSettings
    tasks: Sequence[RowTask]
    """Frames first."""
    contacts: ContactRows | None
    law: SolverConfig
    config: Planning


class Question(NamedTuple):
    """A look ahead that is asked for."""

    number: int
    start: Snapshot
    is_moving: bool
    """Whether obstacles move whose motion is not known."""
    is_noisy: bool
    """Whether what is known of them is too noisy for anything but the law."""
    seed: int
    """Of the planner: the number of looks since everything was reset."""


class Answer(NamedTuple):
    """What became of it."""

    number: int
    """Of the question."""
    outcome: Outcome | None
    """None where it failed."""
    failure: str = ""
    """Why."""
    no_paths: str = ""
    """Why no paths are planned, if they are wanted and there are none of this robot."""
    is_checked: bool = False
    """Whether the outcome was found to be sound already, by the thread that read it."""


class Worker(Protocol):
    """Who computes looks ahead."""

    def ask(self, question: Question) -> None:
        """Ask for a look ahead; one at a time."""

    def has_answer(self) -> bool:
        """Return whether `poll` has anything to say."""

    def poll(self) -> Answer | None:
        """Return an answer, if there is one; never wait."""

    def change(self, method: str, *arguments: Any) -> None:
        """Call a method of the forecaster: the scene or the law has changed."""


class InlineWorker:
    """Computes a look ahead when it is asked for: runs are reproducible, and that step takes as long as it takes."""

    def __init__(self, parts: Parts) -> None:
        """Lay the memory out."""
        config = parts.config
        self._forecaster = Forecaster(parts.settings, parts.tasks, parts.contacts, parts.law, config)
        planner, self._no_paths = _make_planner(self._forecaster, parts)
        self._candidates = Candidates(self._forecaster, planner, config)
        self._answer: Answer | None = None

    def ask(self, question: Question) -> None:
        """See `Worker`."""
        try:
            outcome = self._candidates.look(*question[1:])
        except Exception as error:  # whatever a plan may run into costs no more than the plan
            self._answer = Answer(question.number, None, f"{type(error).__name__}: {error}")
        else:
            self._answer = Answer(question.number, outcome, no_paths=self._no_paths)

    def has_answer(self) -> bool:
        """See `Worker`."""
        return self._answer is not None

    def poll(self) -> Answer | None:
        """See `Worker`."""
        answer, self._answer = self._answer, None
        return answer

    def change(self, method: str, *arguments: Any) -> None:
        """See `Worker`."""
        getattr(self._forecaster, method)(*arguments)


class ProcessWorker:
    """Has looks ahead computed in another process, which ends with this object."""

    def __init__(self, parts: Parts) -> None:
        """Start the process, and wait until it is ready, or has failed."""
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
        self.process = subprocess.Popen([sys.executable, "-c", _SERVE], **pipes)  # type: ignore[call-overload]
        self._messages, self._answers = SimpleQueue[Any](), SimpleQueue[Answer]()
        Thread(target=_write, args=(self.process.stdin, self._messages, self._answers), daemon=True).start()
        model = parts.settings.scene.robot.model
        Thread(target=_read, args=(self.process, self._answers, model), daemon=True).start()
        self._messages.put(parts)
        first = self._answers.get()
        if first.number < 0:
            self._answers.put(first)

    def ask(self, question: Question) -> None:
        """See `Worker`."""
        self._messages.put(question)

    def has_answer(self) -> bool:
        """See `Worker`."""
        return not self._answers.empty()

    def poll(self) -> Answer | None:
        """See `Worker`."""
        return None if self._answers.empty() else self._answers.get()

    def change(self, method: str, *arguments: Any) -> None:
        """See `Worker`."""
        self._messages.put((method, deepcopy(arguments)))  # as they are now

    def __del__(self) -> None:
        self._messages.put(None)  # closes the pipe, at whose end the process ends


def make_worker(parts: Parts) -> Worker:
    """Return the worker that is configured."""
    return ProcessWorker(parts) if parts.config.worker == "process" else InlineWorker(parts)


def serve() -> None:
    """Answer questions from standard input on standard output until the end of it: what the process runs."""
    if hasattr(os, "nice"):
        os.nice(_NICE)
    source, answers = sys.stdin.buffer, os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what else is printed must not get between the answers
    worker = InlineWorker(pickle.load(source))
    answer: Answer | None = Answer(0, None)  # it is ready
    while True:
        try:
            if answer is not None:
                pickle.dump(answer, answers)
                answers.flush()
            message = pickle.load(source)
        except (EOFError, BrokenPipeError):  # the pipe is closed at its other end
            os._exit(0)
        if isinstance(message, Question):
            worker.ask(message)
        else:
            worker.change(message[0], *message[1])
        answer = worker.poll()


def _write(pipe: BinaryIO, messages: SimpleQueue[Any], answers: SimpleQueue[Answer]) -> None:
    """Write messages to a process until one is None, or it is no more; they are pickled here, not in a step."""
    try:
        with pipe:
            while (message := messages.get()) is not None:
                try:
                    text = pickle.dumps(message)
                except Exception as error:  # a task of the user's own may not be pickled
                    answers.put(Answer(-1, None, f"it cannot be sent: {type(error).__name__}: {error}"))
                    continue
                pipe.write(text)
                pipe.flush()
    except OSError:
        pass  # the reader says so


def _read(process: subprocess.Popen[bytes], answers: SimpleQueue[Answer], model: Any) -> None:
    """Read and check answers of a process, of a robot's model, until it is no more; no step does either."""
    assert process.stdout is not None
    try:
        with process.stdout as pipe:
            while True:
                answer: Answer = pickle.load(pipe)
                is_fine = answer.outcome is not None and is_sound(answer.outcome, model)
                answers.put(answer._replace(is_checked=is_fine))
    except Exception as error:  # a process that ends in the middle of an answer leaves anything
        answers.put(Answer(-1, None, f"the process has ended: {type(error).__name__}"))
    process.wait()


def _make_planner(forecaster: Forecaster, parts: Parts) -> tuple[Planner | None, str]:
    """Return a planner in the scene of forecasts; None where none is wanted, or there are no paths, and why."""
    config = parts.config
    if not config.clearances:
        return None, ""
    if parts.contacts is not None:
        return None, "paths do not hold contacts"
    if any(isinstance(task, Com) for task in parts.tasks):
        return None, "paths do not hold the centre of mass, which a task has"
    settings = PlannerSettings(parts.settings.safety_distance, config.clearances, velocity_scale=config.speed)
    try:
        planner, home = Planner(forecaster.scene, settings, forecaster.distances()), forecaster.scene.robot.home
        planner.plan(home, home, max_nodes=2)  # it is compiled now
    except ConfigError as error:
        return None, str(error)
    return planner, ""
