"""What takes part: qpavoid, this one or another, and the libraries beside it."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import qpavoid
from qpavoid_bench import libraries
from qpavoid_bench.libraries.process import Process

PACKAGE = Path(__file__).resolve().parents[1]


@dataclass(frozen=True)
class Ours:
    """A qpavoid."""

    name: str
    settings: str
    """What differs from its defaults."""
    packages: tuple[str, ...]
    """Packages whose versions are reported."""
    closing_gain: float
    """ξ of its rows ḋ >= -(1 - β(d)) ξ (d - d_min), which its velocities are checked to respect [1/s]."""
    path: str | None = None
    """Folder whose `qpavoid` is run in place of this one."""


Library = Ours | libraries.Library

LIBRARIES: dict[str, Library] = {
    "qpavoid": Ours(
        "qpavoid",
        "Controller at its defaults; Task.gain = 1/dt, which is the dead beat that the others have by default; d1 = "
        "d_min, d2 = influence distance",
        ("qpavoid", "pin", "coal", "daqp", "numpy", "numba"),
        5.0,
    ),
    **libraries.LIBRARIES,
    "embodik-velocity": replace(
        libraries.LIBRARIES["embodik"],
        name="embodik-velocity",
        settings="as embodik, but solve_velocity alone: no check of the step, no integration",
        options={**libraries.LIBRARIES["embodik"].options, "call": "solve_velocity"},
        environment="embodik",
    ),
}
"""In the order in which they take turns."""


def start(library: Library) -> Process:
    """Start the process of a library.

    Raises:
        ConfigError: its environment cannot be made.
    """
    if isinstance(library, libraries.Library):
        return Process(library.interpreter(), library.module)
    own = library.path or str(Path(qpavoid.__file__).parents[1])
    path = os.pathsep.join([own, str(PACKAGE.parent), *filter(None, [os.environ.get("PYTHONPATH")])])
    return Process(sys.executable, "qpavoid_bench.tick.ours", path)
