"""Common parts of the figures: colours, units, grids, legends, and the levels of distance."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from qpavoid.problem import Array
from qpavoid.run.log import Log

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#333333")
"""Colour-blind-safe (Okabe and Ito), without the yellow that fades on white."""
DASHES: tuple[Any, ...] = (
    "-",
    (0, (5, 2)),
    (0, (1, 1.2)),
    (0, (6, 2, 1, 2)),
    (0, (3, 1, 1, 1, 1, 1)),
    (0, (10, 3)),
    (0, (2, 2)),
    (0, (1, 3)),
)
COLLISION, D1, D2 = "#C62F2F", "#7A4B9A", "#8A8A8A"
OBSTACLES = ((0.90, 0.42, 0.25), (0.90, 0.62, 0.10), (0.70, 0.45, 0.75), (0.35, 0.62, 0.45), (0.55, 0.55, 0.60))
"""Colours of obstacles, in turn."""
PLAN = "#1A9E9E"
"""Colour of what is of a plan that is followed."""
MOVING, AT_REST, GROUND, TOOL_PATH = "#6BA3D6", "#C4C4C4", "#EFE3C8", "#007A56"


def rgb(colour: str) -> tuple[float, ...]:
    """Return red, green and blue, 0 to 1, of a colour such as `#0072B2`."""
    return tuple(int(colour[i : i + 2], 16) / 255.0 for i in (1, 3, 5))


def distance_colours(d: Array, d1: float, d2: float) -> Array:
    """Return colours (k, 3), 0 to 1, of distances (k,) [m]: green at d2, red at d1 and below."""
    red = np.clip((d2 - d) / max(d2 - d1, 1e-9), 0.0, 1.0)
    return np.stack((0.85 * red, 0.65 * (1.0 - red), np.full_like(red, 0.15)), axis=1)


def units(log: Log, per: str = "") -> str:
    """Return the unit of the coordinates, `rad`, `m`, or `rad or m` where a robot has both, `per` behind each."""
    return " or ".join(unit + per for unit in ("rad", "m") if unit in log.meta["units"])


def spans(flags: Any) -> list[tuple[int, int]]:
    """Return the first step and the last one of each span in which a flag (N,) is set."""
    edges = np.diff(np.r_[False, flags, False].astype(np.int8))
    starts, ends = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1) - 1
    return list(zip(starts.tolist(), ends.tolist(), strict=True))


def add_grid(ax: Any) -> None:
    """Add a pale grid behind the lines, which run from edge to edge."""
    ax.grid(True, color="#E4E4E4", linewidth=0.6)
    ax.set_axisbelow(True)
    ax.margins(x=0.0)


def add_legend(ax: Any, handles: Sequence[Any]) -> None:
    """Add a legend beside the panel, where it hides nothing."""
    style = {"fontsize": 8, "frameon": False, "borderaxespad": 0.0}
    ax.legend(handles=handles, loc="upper left", bbox_to_anchor=(1.01, 1.0), **style)


def draw_levels(ax: Any, log: Log) -> list[Any]:
    """Draw d2, d1 and collision, all between surfaces.

    Returns:
        The lines, for a legend.
    """
    avoidance = log.meta["config"]["avoidance"]
    offset = avoidance["offset"]
    levels = (
        ("$d_2$ = {:g} m", avoidance["d2"], D2, DASHES[1]),
        ("$d_1$ = {:g} m", avoidance["d1"], D1, DASHES[3]),
        ("collision", offset, COLLISION, DASHES[0]),
    )
    return [
        ax.axhline(
            d - offset, color=colour, linestyle=dash, linewidth=1.1, zorder=2, label=label.format(round(d - offset, 9))
        )
        for label, d, colour, dash in levels
    ]


def label_distances(ax: Any, *distances: Array, name: str = "distance ") -> None:
    """Label and extend the axis of distances between surfaces, and shade collision.

    Args:
        ax: panel that has its lines already.
        distances: the distances of the lines [m].
        name: what is shown.
    """
    ax.set_ylabel(f"{name}between surfaces [m]")
    add_grid(ax)
    finite = [d[np.isfinite(d)] for d in distances]
    lowest = min((float(np.min(d)) for d in finite if d.size), default=0.0)
    bottom, top = ax.get_ylim()
    bottom = min(lowest, 0.0) - 0.04 * top
    ax.axhspan(bottom, 0.0, color=COLLISION, alpha=0.08, linewidth=0, zorder=0)
    ax.set_ylim(bottom, top)
