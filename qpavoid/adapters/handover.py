"""Updates from other threads, for the one thread that steps a controller."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any


class Handover:
    """What other threads have to say of obstacles (or of targets), until the control loop takes it.

    Of each name the newest value counts. No call waits for another thread: a loop is not stopped by a camera that
    has been interrupted in the middle of an update.
    """

    def __init__(self) -> None:
        self._values: dict[str, Any] = {}
        self._requests: deque[tuple[Future[Any], Callable[..., Any], tuple[Any, ...]]] = deque()

    def put(self, name: str, value: Any) -> None:
        """Give the newest value of a name, from any thread; stamp poses that are late: `Pose.at(place, t=stamp)`."""
        self._values[name] = value

    def ask(self, function: Callable[..., Any], *arguments: Any) -> Future[Any]:
        """Have the loop's thread call a function between two steps, such as `controller.add_obstacle`.

        Args:
            function: called by the next `take`.
            arguments: of the function.

        Returns:
            Future of what it returns or raises: `ask(…).result(timeout=1.0)`.
        """
        future: Future[Any] = Future()
        self._requests.append((future, function, arguments))
        return future

    def take(self) -> dict[str, Any]:
        """Answer all requests, and return the values given since the last call: by the loop's thread, before a step."""
        for _ in range(len(self._requests)):
            future, function, arguments = self._requests.popleft()
            if not future.set_running_or_notify_cancel():
                continue
            try:
                future.set_result(function(*arguments))
            except Exception as error:  # it is the asking thread's to handle
                future.set_exception(error)
        return {name: self._values.pop(name) for name in list(self._values)}
