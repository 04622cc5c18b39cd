"""Array work of a tick: compiled by numba where it is installed, else in numpy; one interface, one set of tests.

`QPAVOID_NUMBA=0` in the environment switches the compiled version off.
"""

from __future__ import annotations

import os
from importlib.util import find_spec
from typing import TYPE_CHECKING

from qpavoid.kernels import vectorised

ACCELERATED = os.environ.get("QPAVOID_NUMBA", "1") != "0" and find_spec("numba") is not None
"""Whether the compiled version is used."""

if TYPE_CHECKING or not ACCELERATED:
    from qpavoid.kernels.vectorised import *  # noqa: F403
else:
    from qpavoid.kernels.compiled import *  # noqa: F403

__all__ = ["ACCELERATED"]
__all__ += vectorised.__all__
