"""Figures of robots with motors: torques between their limits, contact forces in their friction cones, slip."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from qpavoid.problem import Array
from qpavoid.run.log import Log
from qpavoid.viz.style import COLLISION, COLOURS, D1, DASHES, add_grid

_FAINT = 0.15
"""Opacity of what lies beyond limits."""


def torque_figures(log: Log) -> dict[str, Figure]:
    """Return the figures that a run with motors has beside those of every run, by the names of their files."""
    figures = {"torques": torques_figure(log)} if log.torque.size else {}
    return {**figures, **({"contacts": contacts_figure(log)} if log.contact_force.size else {})}


def panels_figure(
    t: Array, values: Array, names: Sequence[str], limits: Sequence[Sequence[float]], what: str, unit: str
) -> Figure:
    """Draw values over time, a panel each, and what lies beyond their limits.

    Args:
        t: times (n,) [s].
        values: (n, m) in `unit`.
        names: m titles.
        limits: m times the lower limit and the upper one, if there are any.
        what: name of the values.
        unit: their unit.
    """
    columns = 4 if len(names) <= 16 else 6
    rows = max(-(-len(names) // columns), 1)
    figure = Figure(figsize=(2.6 * columns, 1.8 * rows + 0.8), layout="constrained")
    for i, name in enumerate(names):
        ax = figure.add_subplot(rows, columns, i + 1)
        ax.plot(t, values[:, i], color=COLOURS[0], linewidth=1.4)
        ax.set_title(name, fontsize=9)
        ax.tick_params(labelsize=8)
        add_grid(ax)
        finite = [limit for limit in limits[i] if np.isfinite(limit)]
        for limit in finite:
            ax.axhline(limit, color=COLLISION, linewidth=0.8)
        bottom, top = ax.get_ylim()
        for limit in finite:
            outer = bottom if limit == limits[i][0] else top
            ax.axhspan(limit, outer, color=COLLISION, alpha=_FAINT, linewidth=0)
        ax.set_ylim(bottom, top)
        if i + columns >= len(names):
            ax.set_xlabel("time [s]", fontsize=9)
    figure.supylabel(f"{what} [{unit}]", fontsize=10)
    beyond = Patch(color=COLLISION, alpha=2.0 * _FAINT, label="beyond limits")
    handles = [Line2D([], [], color=COLOURS[0], label=what.split()[-1]), beyond]
    figure.legend(handles=handles, loc="outside lower center", ncols=2, fontsize=9, frameon=False)
    return figure


def torques_figure(log: Log) -> Figure:
    """Draw the torques of the motors over time, a panel each, between their limits."""
    count = log.torque.shape[1]
    limits = [(np.nan, np.nan) if limit is None else (-limit, limit) for limit in log.meta["torque_limit"]]
    used = log.meta["units"][-count:]
    unit = " or ".join(torque for unit, torque in (("rad", "Nm"), ("m", "N")) if unit in used)
    return panels_figure(log.t, log.torque, log.meta["coordinates"][-count:], limits, "motor torque", unit)


def contacts_figure(log: Log) -> Figure:
    """Draw what the floor does to a robot that stands: how much each foot bears, forces within cones, and slip."""
    points, config = log.meta["contact_points"], log.meta["config"]
    frames = [contact["frame"] for contact in config["contacts"]]
    figure = Figure(figsize=(11.0, 7.2), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1.5, 1.0), squeeze=False)[0]
    grid = left.get_subplotspec().subgridspec(2, 1)
    left.remove()
    bearing, slip = figure.add_subplot(grid[0]), figure.add_subplot(grid[1])
    normal = log.contact_force[:, :, 2]
    across = np.linalg.norm(log.contact_force[:, :, :2], axis=2)
    for rank, frame in enumerate(frames):
        own = [i for i, point in enumerate(points) if point.rpartition(" ")[0] == frame]
        style = {"color": COLOURS[rank % len(COLOURS)], "linestyle": DASHES[rank // len(COLOURS)]}
        bearing.plot(log.t, normal[:, own].sum(axis=1), linewidth=1.2, label=frame, **style)
        for i in own:
            slip.plot(log.t, 1e3 * log.slip[:, i], linewidth=0.9, color=style["color"])
        right.plot(normal[:, own].ravel(), across[:, own].ravel(), ".", markersize=1.5, color=style["color"])
    _draw_cones(right, config, float(normal.max(initial=1.0)), float(across.max(initial=1.0)))
    bearing.set_ylabel("normal force of all corners [N]")
    slip.set_ylabel("way of each corner along the floor [mm]")
    slip.set_xlabel("time [s]")
    for ax in (bearing, slip):
        add_grid(ax)
        ax.set_ylim(bottom=0.0)
    figure.legend(handles=bearing.get_lines(), loc="outside lower left", ncols=2, fontsize=9, frameon=False)
    return figure


def _draw_cones(ax: Any, config: dict[str, Any], normal: float, across: float) -> None:
    """Draw the edges of the friction cones up to some forces [N], and label the panel.

    Args:
        ax: panel with a force along the floor for each normal force.
        config: of the run.
        normal: largest normal force.
        across: largest force along the floor.
    """
    edges = [(f"cone of the contacts, μ = {mu:g}", mu, COLLISION, DASHES[1]) for mu in _frictions(config)]
    if config["plant"] is not None:
        floor = config["plant"]["floor_friction"]
        edges.append((f"friction of the floor, μ = {floor:g}", floor, D1, DASHES[3]))
    for label, mu, colour, dash in edges:
        ax.plot([0.0, 1.05 * normal], [0.0, 1.05 * mu * normal], color=colour, linestyle=dash, label=label)
    ax.set_xlim(0.0, 1.05 * normal)
    ax.set_ylim(0.0, 2.5 * across)
    ax.set_xlabel("normal force of a corner [N]")
    ax.set_ylabel("its force along the floor [N]")
    add_grid(ax)
    ax.legend(loc="upper right", fontsize=8, frameon=False)


def _frictions(config: dict[str, Any]) -> list[float]:
    return sorted({contact["friction"] for contact in config["contacts"]})
