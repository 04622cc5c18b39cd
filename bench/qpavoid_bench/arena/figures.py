"""Figures of the arena's report: safety and success against error, time and family."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, StrMethodFormatter

from qpavoid.problem import Array
from qpavoid.viz.style import COLOURS, add_grid
from qpavoid_bench.arena.results import Results
from qpavoid_bench.arena.statistics import Interval, mean, pareto, rate

_LABEL_HEIGHT = 0.24
"""Smallest distance of two labels [in]: a line of their font and some space."""
_MARKERS = "osD^v<>"
"""Markers; with the colours, enough for 49 entrants to look different."""


def safety_against_tracking(results: Results) -> Figure:
    """Draw the rate of runs without contact over the mean tracking error."""
    x = [mean(1e3 * values) for values in results.table("tracking_error").T]
    y = [_percent(rate(~values)) for values in results.table("collided").astype(bool).T]
    return _scatter(results, x, y, "mean tracking error [mm]", "runs without contact [%]")


def success_against_time(results: Results) -> Figure:
    """Draw the rate of runs that succeed over the median time of a control step."""
    low, middle, high = np.quantile(results.table("tick_p50"), [0.25, 0.5, 0.75], axis=0)
    x = [Interval(*values) for values in zip(middle, low, high, strict=True)]
    y = [_percent(rate(values)) for values in results.table("success").astype(bool).T]
    figure = _scatter(results, x, y, "median tick [µs], with quartiles over runs", "runs that succeed [%]")
    axis = figure.axes[0]
    axis.set_xscale("log")
    left, right = axis.get_xlim()
    axis.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if right > 8.0 * left else range(1, 10)))
    axis.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axis.xaxis.set_minor_formatter("")
    return figure


def success_by_family(results: Results) -> Figure:
    """Draw the rate of runs that succeed by entrant, best first, and family."""
    families, entrants = results.families, list(results.ranking())
    runs = results.common.assign(success=100.0 * results.common["success"])
    success = runs.pivot_table("success", "entrant", "family").reindex(index=entrants, columns=families).to_numpy()
    figure = Figure(figsize=(1.8 + 0.62 * len(families), 1.6 + 0.34 * len(entrants)), layout="constrained")
    ax = figure.subplots()
    image = ax.imshow(success, cmap="viridis", vmin=0.0, vmax=100.0, aspect="auto")
    ax.set_xticks(range(len(families)), families, rotation=45, ha="right", fontsize=8, parse_math=False)
    ax.set_yticks(range(len(entrants)), entrants, fontsize=8, parse_math=False)
    for i, j in np.argwhere(np.isfinite(success)):
        colour = "black" if success[i, j] > 60.0 else "white"
        ax.text(j, i, f"{success[i, j]:.0f}", ha="center", va="center", fontsize=7, color=colour)
    figure.colorbar(image, ax=ax, label="runs that succeed [%]", fraction=0.04)
    return figure


def _percent(interval: Interval) -> Interval:
    return Interval(*(100.0 * value for value in interval))


def _scatter(results: Results, x: list[Interval], y: list[Interval], x_label: str, y_label: str) -> Figure:
    """Draw a point for each entrant with its intervals.

    Points of the Pareto front are full, and joined by a line.
    """
    count = len(results.entrants)
    figure = Figure(figsize=(9.0, max(5.6, 1.2 + _LABEL_HEIGHT * count)), layout="constrained")
    ax = figure.subplots()
    xs, ys = np.array([point.value for point in x]), np.array([point.value for point in y])
    front = pareto(xs, ys)
    for i in range(count):
        colour, marker = COLOURS[i % len(COLOURS)], _MARKERS[i // len(COLOURS) % len(_MARKERS)]
        style: dict[str, Any] = {
            "color": colour,
            "fmt": marker,
            "mfc": colour if front[i] else "white",
            "ms": 6,
            "elinewidth": 0.8,
        }
        ax.errorbar(xs[i], ys[i], yerr=_error_bar(y[i]), xerr=_error_bar(x[i]), **style)
    best = np.flatnonzero(front)[np.argsort(xs[front])]
    ax.step(xs[best], ys[best], where="post", color="#333333", linewidth=0.8, linestyle=(0, (4, 3)), zorder=0)
    ax.set_xlabel(x_label)
    ax.set_ylabel(y_label)
    add_grid(ax)
    ax.margins(x=0.04, y=0.08)
    _label(ax, results.entrants, xs, ys)
    return figure


def _error_bar(interval: Interval) -> Array:
    """Return the extents (2, 1) of an interval below and above its value.

    Round-off is clipped to 0.
    """
    value, low, high = interval
    return np.array([[max(value - low, 0.0)], [max(high - value, 0.0)]])


def _label(ax: Any, names: list[str], xs: Array, ys: Array) -> None:
    """Write names at the right-hand edge without overlap, with a thin line to each point."""
    bottom, top = ax.get_ylim()
    gap = _LABEL_HEIGHT / ax.figure.get_figheight()
    order = np.argsort(ys, kind="stable")
    heights = (ys[order] - bottom) / (top - bottom)
    for i in range(1, len(heights)):
        heights[i] = max(heights[i], heights[i - 1] + gap)
    heights[-1] = min(heights[-1], 1.0)
    for i in range(len(heights) - 2, -1, -1):
        heights[i] = min(heights[i], heights[i + 1] - gap)
    for i, height in zip(order.tolist(), heights.tolist(), strict=True):
        colour = COLOURS[i % len(COLOURS)]
        # to the middle of the name's left edge: to its centre, a steep line would cross it out
        line = {"arrowstyle": "-", "color": colour, "linewidth": 0.5, "linestyle": ":", "relpos": (0.0, 0.5)}
        place = {
            "xytext": (1.03, height),
            "textcoords": "axes fraction",
            "va": "center",
            "fontsize": 8,
            "parse_math": False,
        }
        ax.annotate(names[i], (xs[i], ys[i]), **place, color=colour, arrowprops=line, annotation_clip=False)
