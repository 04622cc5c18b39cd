"""The process of a library, and the connection to it."""

from __future__ import annotations

import os
import pickle
import subprocess
import weakref
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

WORKER = Path(__file__).parent / "foreign" / "worker.py"
START_TIMEOUT = 120.0
"""Time for imports and the set-up of a scene [s]."""
STEP_TIMEOUT = 10.0
"""Time for the answer to a control step [s]; after that the process is ended, and every later step fails."""
ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS", "NUMBA_NUM_THREADS"), "1"
)


class LibraryError(RuntimeError):
    """What a library raised."""


class WorkerEnded(LibraryError):
    """The process of a library has ended."""


class Process:
    """Process of a library; it ends with this object."""

    def __init__(self, python: Path | str, module: str, path: str = "") -> None:
        """Start the process.

        Args:
            python: interpreter that has the library.
            module: of the adapter.
            path: folders that are searched for modules before its own.
        """
        self._connection, there = Pipe()
        environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
        environment |= {**ONE_THREAD, **({"PYTHONPATH": path} if path else {})}
        try:
            self.process = subprocess.Popen(
                [str(python), str(WORKER), str(there.fileno()), module],
                pass_fds=[there.fileno()],
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )
        finally:
            there.close()
        self.close = weakref.finalize(self, _close, self.process, self._connection)

    def ask(self, command: str, *arguments: Any, timeout: float = START_TIMEOUT) -> Any:
        """Return the answer to a request."""
        return self.timed(command, *arguments, timeout=timeout)[0]

    def timed(self, command: str, *arguments: Any, timeout: float = STEP_TIMEOUT) -> tuple[Any, float]:
        """Return the answer to a request, and the time that it took there [s].

        Raises:
            WorkerEnded: it has ended, or does not answer within `timeout` [s] and has been ended for that.
            LibraryError: the library raised.
        """
        try:
            self._connection.send_bytes(pickle.dumps((command, arguments), protocol=4))
            if not self._connection.poll(timeout):
                self.close()
                raise WorkerEnded(f"the process did not answer within {timeout:g} s, and was ended")
            answer, message, seconds = pickle.loads(self._connection.recv_bytes())
        except (EOFError, OSError) as error:
            raise WorkerEnded(f"the process has ended, with code {self.process.wait(STEP_TIMEOUT)}") from error
        if message:
            raise LibraryError(message)
        return answer, seconds


def _close(process: subprocess.Popen[bytes], connection: Connection) -> None:
    connection.close()
    process.kill()
    process.wait()
