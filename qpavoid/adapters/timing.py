"""The period of a control loop, and a watchdog for it, in plain Python."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from types import TracebackType


class Rate:
    """Periods of a control loop, on a fixed grid: lateness does not add up, and missed periods are not caught up."""

    def __init__(
        self, dt: float, clock: Callable[[], float] = time.perf_counter, sleep: Callable[[float], None] = time.sleep
    ) -> None:
        """Begin the first period now.

        Args:
            dt: period [s].
            clock: tells the time [s].
            sleep: waits for a time [s].
        """
        self.dt, self._clock, self._sleep = dt, clock, sleep
        self._start = self._next = clock()
        self.missed = 0
        """Number of periods that began late by more than a period, and were left out."""

    @property
    def t(self) -> float:
        """Time since the first period began [s], for `Controller.step`."""
        return self._clock() - self._start

    def wait(self) -> float:
        """Wait until the next period begins; return the time that was left [s], negative where the loop is late."""
        self._next += self.dt
        left = self._next - self._clock()
        if left > 0.0:
            self._sleep(left)
        elif left < -self.dt:
            periods = int(-left // self.dt)
            self.missed += periods
            self._next += periods * self.dt
        return left


class Watchdog:
    """Calls a function once if a loop gives no sign of life for some time, from a thread of its own.

    It sees a loop that hangs, waits or has ended. A call that holds Python's lock holds it up as well, so that the
    timeout of the drives has to stay as the last resort.
    """

    def __init__(self, timeout: float, expire: Callable[[], None], clock: Callable[[], float] = time.monotonic) -> None:
        """Begin to count with `start`, or with `with`.

        Args:
            timeout: time without a sign of life after which `expire` is called [s].
            expire: stops the robot; called from the thread of the watchdog, or by `check`.
            clock: tells the time [s].
        """
        self._timeout, self._expire, self._clock = timeout, expire, clock
        self._fed, self._stopped = clock(), threading.Event()
        self._thread: threading.Thread | None = None
        self.expired = False
        """Whether it has called `expire`."""

    def feed(self) -> None:
        """Give a sign of life."""
        self._fed = self._clock()

    def check(self) -> float:
        """Call `expire` if it is time, once; return the time that is left [s]."""
        left = self._fed + self._timeout - self._clock()
        if left <= 0.0 and not self.expired:
            self.expired = True
            self._expire()
        return left

    def start(self) -> Watchdog:
        """Begin to count, in a thread that ends with `stop` or with the program."""
        self.feed()
        self._thread = threading.Thread(target=self._watch, name="watchdog", daemon=True)
        self._thread.start()
        return self

    def stop(self) -> None:
        """End the thread."""
        self._stopped.set()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join()

    def _watch(self) -> None:
        while not self.expired and not self._stopped.wait(max(self.check(), 0.0)):
            pass

    def __enter__(self) -> Watchdog:
        return self.start()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()
