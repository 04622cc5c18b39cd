"""Record of a run: one row a tick, saved as .npz together with the configuration and the versions that made it."""

from __future__ import annotations

import json
import os.path
import platform
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import numpy as np
import numpy.typing as npt

from qpavoid.errors import ConfigError
from qpavoid.problem import Array, IntArray, Status
from qpavoid.reason import Severity
from qpavoid.run import machine
from qpavoid.run.metrics import run_metrics

STATUSES = tuple(Status)
"""Status of each code in `Log.status`."""
_FORMAT = 5
_LARGEST = 2_000_000_000
"""What a log may take in memory [bytes]; a small file can unpack to a thousand times its size."""
_SHAPES = {
    "t": "N", "q": "N nq", "v": "N nv",
    "target": "N k 3", "tool": "N k 3", "tool_rotation": "N k 3 3", "turn_error": "N k",
    "task_error": "N s",
    "body_distance": "N b", "closest_pair": "N", "alpha": "N", "beta": "N", "status": "N",
    "slack": "N", "saturation": "N", "build_time": "N", "solve_time": "N", "command_scale": "N", "stalled": "N",
    "severity": "N",
    "body_ends": "N b 2 3", "obstacle_position": "N o 3", "obstacle_rotation": "N o 3 3",
}  # fmt: skip
"""Array: its sides; a letter is the same number wherever it stands."""
_KINDS = {"closest_pair": "i", "status": "i", "stalled": "b", "severity": "i"}
"""Array: kind of its numbers, where it is not floating point."""
_META = {"scenario": str, "solver": str, "completed": bool, "pairs": list, "config": dict}


@dataclass(frozen=True)
class Log:
    """Arrays of a run with N ticks; n joints, k frames that follow motions, s other tasks, b bodies, o obstacles.

    Distances are between surfaces [m]. Everything is in world axes and SI units.
    """

    t: Array
    """(N,) time [s]."""
    q: Array
    """(N, nq) configuration at the start of the tick [rad or m]."""
    v: Array
    """(N, nv) commanded velocity [rad/s or m/s]."""
    target: Array
    """(N, k, 3) where each task's frame should be [m]; where it is, if only its orientation counts."""
    tool: Array
    """(N, k, 3) where it is [m]."""
    tool_rotation: Array
    """(N, k, 3, 3) orientation of each task's frame."""
    turn_error: Array
    """(N, k) angle between target and frame [rad]; 0 for position tasks."""
    task_error: Array
    """(N, s) how far each other task is from its target, in its unit; see `meta["tasks"]`."""
    body_distance: Array
    """(N, b) distance of each body to the nearest thing that it is paired with [m]; inf where there is none."""
    closest_pair: IntArray
    """(N,) index of the closest pair in `meta["pairs"]`; -1 where there are none."""
    alpha: Array
    """(N,) eq. 11 for the closest pair; 0 out of range."""
    beta: Array
    """(N,) eq. 12 for the closest pair; 0 out of range."""
    status: npt.NDArray[np.int8]
    """(N,) index in STATUSES."""
    slack: Array
    """(N,) largest slack of an avoidance row [m/s]."""
    command_scale: Array
    """(N,) share of the law's velocity that was left after looking ahead; the rest was a stop's."""
    stalled: npt.NDArray[np.bool_]
    """(N,) whether the tasks made no progress."""
    severity: npt.NDArray[np.int8]
    """(N,) worst severity of the step's reasons, see `qpavoid.reason.Severity`; 0 without reasons."""
    saturation: Array
    """(N,) largest change that the limits made to the raw law [rad/s or m/s]."""
    build_time: Array
    """(N,) time to set up the problem [s]."""
    solve_time: Array
    """(N,) time to solve it [s]."""
    body_ends: Array
    """(N, b, 2, 3) ends of the axis of each body, or of the capsule around it, for drawing [m]."""
    obstacle_position: Array
    """(N, o, 3) origin of each obstacle [m]."""
    obstacle_rotation: Array
    """(N, o, 3, 3) its orientation."""
    meta: dict[str, Any] = field(default_factory=dict)
    """Names, shapes, limits, the scenario's configuration, versions, and how the run ended."""

    @property
    def min_distance(self) -> Array:
        """(N,) smallest distance of any body at each tick [m]."""
        return np.asarray(np.min(self.body_distance, axis=1, initial=np.inf))

    def until(self, t: float) -> Log:
        """The part of the run before time t [s]."""
        count = int(np.searchsorted(self.t, t - 1e-9))
        return Log(**{name: array[:count] for name, array in self._arrays().items()}, meta=self.meta)

    def metrics(self) -> dict[str, Any]:
        """Key figures of the run; see `qpavoid.run.metrics.run_metrics`."""
        return run_metrics(self)

    def save(self, path: str | Path) -> Path:
        """Writes the log; the parent folder is made where it is missing.

        Returns:
            The file written, ending in .npz.
        """
        path = Path(path)
        path = path.with_name(path.name.removesuffix(".npz") + ".npz")
        path.parent.mkdir(parents=True, exist_ok=True)
        meta: Any = np.array(json.dumps({"format": _FORMAT, **self.meta}))
        with path.open("wb") as file:
            np.savez_compressed(file, allow_pickle=False, meta=meta, **self._arrays())
        return path

    @classmethod
    def load(cls, path: str | Path) -> Log:
        """Reads a log back.

        Raises:
            ConfigError: no such file, or not a whole log of this format.
        """
        if not os.path.isfile(path):  # reading a pipe or a device may never end
            raise ConfigError(f"{path}: no such file; give a log written by `qpavoid run`")
        try:
            with ZipFile(path) as archive:
                size = sum(member.file_size for member in archive.infolist())
            if size > _LARGEST:
                raise ConfigError(f"{path}: unpacks to {size} bytes; at most {_LARGEST} are read")
            with np.load(path, allow_pickle=False) as file:
                meta = json.loads(str(file["meta"]))
                if meta.pop("format") != _FORMAT:
                    raise ConfigError(f"{path}: written by another version of qpavoid; run the scenario again")
                log = cls(**{name: file[name] for name in file.files if name != "meta"}, meta=meta)
            log._check()
            return log
        except ConfigError:
            raise
        except Exception as error:  # zipfile, its decompressors, numpy and json raise a dozen kinds on damaged files
            what = str(error) or type(error).__name__
            raise ConfigError(f"{path}: not a qpavoid log: {what}; give one written by `qpavoid run`") from None

    def _check(self) -> None:
        """Raises ValueError where the arrays do not belong together, so that metrics and figures need not look."""
        sides: dict[str, int] = {"2": 2, "3": 3}
        for name, wanted in _SHAPES.items():
            array = getattr(self, name)
            if array.dtype.kind != _KINDS.get(name, "f"):
                raise ValueError(f"{name} holds {array.dtype}")
            letters = wanted.split()
            if len(letters) != array.ndim or any(
                sides.setdefault(letter, side) != side for letter, side in zip(letters, array.shape, strict=True)
            ):
                raise ValueError(f"{name} has shape {array.shape}; must be ({wanted})")
        for key, kind in _META.items():
            if not isinstance(self.meta.get(key), kind):
                raise ValueError(f"{key} is missing")
        for key in ("dt", "goal_tolerance", "thresholds"):
            if key not in self.meta["config"]:
                raise ValueError(f"config.{key} is missing")
        most = (("closest_pair", len(self.meta["pairs"])), ("status", len(STATUSES)), ("severity", len(Severity) + 1))
        for name, count in most:
            if np.any(getattr(self, name) >= count):
                raise ValueError(f"{name} points past the {count} that there are")

    def _arrays(self) -> dict[str, Any]:
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name != "meta"}


_SHAPING = ("qpavoid", "pin", "coal", "numpy", "qpsolvers", "daqp", "proxsuite", "osqp", "quadprog")


def versions() -> dict[str, str]:
    """Versions of everything that shapes a result."""
    return {"python": platform.python_version(), "machine": platform.machine(), **machine.versions(_SHAPING)}
