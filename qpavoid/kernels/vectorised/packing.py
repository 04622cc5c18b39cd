"""The layout of a tick as the numpy kernels see it."""

from __future__ import annotations

from qpavoid.kernels.layout import RowLayout
from qpavoid.kernels.workspace import Workspace


def pack(layout: RowLayout) -> Workspace:
    """The layout in the form that the kernels take."""
    return Workspace(layout)
