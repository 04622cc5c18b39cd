"""Figures of runs. Needs matplotlib: `pip install qpavoid[plots]`.

Every `*_figure` function returns a `matplotlib.figure.Figure` of its own: no display and no global state is used, so
they work headless and in threads.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from qpavoid.problem import Array, Status
from qpavoid.run.log import STATUSES, Log
from qpavoid.viz.compare import compare_time_figure, path_figure, solver_styles
from qpavoid.viz.motion import Sight, motion_figure, sight_of
from qpavoid.viz.style import (
    COLLISION,
    COLOURS,
    DASHES,
    PLAN,
    add_grid,
    add_legend,
    draw_levels,
    label_distances,
    spans,
    units,
)
from qpavoid.viz.torque_figures import panels_figure, torque_figures

__all__ = ["plot_compare", "plot_run", "sight_of"]
DPI = 130
ALPHA_SHOWN = 100.0
"""Upper end of the axis of α, which grows without bound as the distance goes to 0."""
_STATUS_COLOUR = {Status.RELAXED: "#F5C242", Status.STOPPED: "#C62F2F"}
_GREY = "#B8B8B8"
_MAX_PARTNERS = 2
"""Bodies that are named beside the one whose distance a line shows."""
_MAX_NAMED_LINES = 2 * len(COLOURS)
"""Lines of a panel that have a colour and a name; the legend of more would run out of the panel."""


def plot_run(log: Log, folder: str | Path, sight: Sight | None = None) -> list[Path]:
    """Write the figures of one run: motion, joints, distances, speeds, and of one with motors torques and contacts.

    Args:
        log: the run.
        folder: of the files.
        sight: what the pictures of the motion show; chosen for this run if left out.

    Returns:
        The files, `<scenario>_<solver>_<figure>.png`, in that order.
    """
    draw = {"joints": joints_figure, "distances": distances_figure, "speeds": speeds_figure}
    figures = {"motion": motion_figure(log, sight), **{name: make(log) for name, make in draw.items()}}
    figures |= torque_figures(log)
    for figure in figures.values():
        figure.suptitle(_title(log), fontsize=11)
    return _save(figures, folder, log.stem)


def plot_compare(logs: Sequence[Log], folder: str | Path) -> list[Path]:
    """Write the figures that lay several runs of one scenario over each other: time and path.

    Returns:
        The files, `<scenario>_compare_<figure>.png`, in that order.

    Raises:
        ValueError: no logs, or logs of different scenarios.
    """
    scenarios = {log.meta["scenario"] for log in logs}
    if len(scenarios) != 1:
        raise ValueError(f"needs logs of one scenario, got {sorted(scenarios)}")
    figures = {"time": compare_time_figure(logs), "path": path_figure(logs, solver_styles(logs))}
    return _save(figures, folder, f"{scenarios.pop()}_compare")


def _save(figures: dict[str, Figure], folder: str | Path, stem: str) -> list[Path]:
    """Write figures as `<stem>_<name>.png` into a folder; the folder is made where it is missing."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for name, figure in figures.items():
        paths.append(folder / f"{stem}_{name}.png")
        figure.savefig(paths[-1], dpi=DPI)
    return paths


def _title(log: Log) -> str:
    title = f"{log.meta['title'] or log.meta['scenario']}  —  solver: {log.meta['solver']}"
    return title if log.meta["completed"] else f"{title}\n(ended early: {log.meta['stopped_by'] or 'part of a run'})"


def joints_figure(log: Log) -> Figure:
    """Draw q over time, a panel each, with position limits (Figs. 7, 14 of the paper)."""
    limits = {name: (lower, upper) for name, lower, upper in log.meta["position_limits"]}
    names = log.meta["positions"]
    return panels_figure(log.t, log.q, names, [limits.get(name, ()) for name in names], "joint position", units(log))


def _draw_lines(
    ax: Any, t: Array, values: Array, names: Sequence[str], shown: Any, remaining: str, width: Any
) -> list[Any]:
    """Draw m lines (n, m) over times (n,), those `shown` with a name and a width, the others in grey.

    Returns:
        Legend entries; the others have one.
    """
    others = [i for i in range(len(names)) if i not in shown and np.isfinite(values[:, i]).any()]
    for i in others:
        ax.plot(t, values[:, i], color=_GREY, linewidth=0.7, zorder=1)
    for rank, (i, linewidth) in enumerate(zip(shown, width, strict=True)):
        style = {"color": COLOURS[rank % len(COLOURS)], "linestyle": DASHES[rank // len(COLOURS) % len(DASHES)]}
        ax.plot(t, values[:, i], label=names[i], linewidth=linewidth, zorder=3, **style)
    handles: list[Any] = ax.get_legend_handles_labels()[0]
    return handles + [Line2D([], [], color=_GREY, linewidth=0.7, label=f"{len(others)} {remaining}")] * bool(others)


def distances_figure(log: Log) -> Figure:
    """Draw distances of bodies, each with those that it comes near to, with d1 and d2 (Figs. 8, 11, 13 of the paper).

    Below them are α and β of the closest pair, where the law has them.
    """
    avoidance, distance, gains = log.meta["config"]["avoidance"], log.body_distance, gains_of(log)
    upper_distance = round(1.5 * (avoidance["d2"] - avoidance["offset"]), 9)
    figure = Figure(figsize=(10.5, 7.0 if gains else 5.2), layout="constrained")
    panels = figure.subplots(1 + bool(gains), 1, sharex=True, squeeze=False, height_ratios=(3, 1)[: 1 + bool(gains)])
    ax = panels[0, 0]
    nearest = np.min(distance, axis=0, initial=np.inf)
    order = np.argsort(nearest, kind="stable")[:_MAX_NAMED_LINES]
    near = np.sort(order[nearest[order] < (np.inf if distance.shape[1] <= len(COLOURS) else upper_distance)])
    # the two bodies of a pair may share their distance all the time: one line is enough
    near = np.array(
        [i for k, i in enumerate(near) if not any(np.array_equal(distance[:, i], distance[:, j]) for j in near[:k])],
        dtype=np.intp,
    )
    names = [_with_partners(log, i) if i in near else body for i, body in enumerate(log.meta["bodies"])]
    # thinner and thinner, as lines may coincide for a while
    handles = _draw_lines(ax, log.t, distance, names, near, "bodies farther away", np.linspace(3.0, 1.2, len(near)))
    handles += draw_levels(ax, log) + _shade_status(ax, log)
    label_distances(ax, distance[:, near])
    add_legend(ax, handles)
    if gains:
        _plot_gains(panels[1, 0], log, gains)
    panels[-1, 0].set_xlabel("time [s]")
    return figure


def _with_partners(log: Log, body: int) -> str:
    """Return the name of a body and of those that it is closest to, at its closest moment first."""
    distance, pairs, name = log.body_distance[:, body], log.body_pair[:, body], log.meta["bodies"][body]
    partners: list[str] = []
    for pair in pairs[np.argsort(distance, kind="stable")].tolist():
        a, b = log.meta["pairs"][pair] if pair >= 0 else (name, name)
        partner = a if b == name else b
        if partner != name and partner not in partners:
            partners.append(partner)
    more = f" and {len(partners) - _MAX_PARTNERS} more" if len(partners) > _MAX_PARTNERS else ""
    return f"{name} – {', '.join(partners[:_MAX_PARTNERS])}{more}" if partners else name


def gains_of(log: Log) -> tuple[str, ...]:
    """Return which of `alpha` and `beta` the law of a run has: eq. 10 both, a QP those of the form of its rows."""
    config = log.meta["config"]
    match config["solver"]["name"]:
        case "eq10" | "eq10-literal":
            return "alpha", "beta"
        case "qp" | "hqp":
            return ("beta",) if config["avoidance"]["row"]["type"] == "beta" else ("alpha", "beta")
        case _:
            return ()


def _plot_gains(ax: Any, log: Log, gains: tuple[str, ...]) -> None:
    alpha = np.minimum(log.alpha, ALPHA_SHOWN) if "alpha" in gains else np.zeros(0)
    if "alpha" in gains:
        ax.plot(log.t, alpha, color="#333333", label="α of the closest pair (eq. 11)")
    if "beta" in gains:
        ax.plot(log.t, log.beta, color="#8A8A8A", linestyle=DASHES[1], label="β of the closest pair (eq. 12)")
    ax.set_yscale("symlog", linthresh=1.0)
    top = next(top for top in (1.0, 10.0, ALPHA_SHOWN) if np.nanmax(alpha, initial=0.0) <= top)
    ax.set_ylim(-0.1, 1.15 * top)
    ticks = [tick for tick in (0.0, 0.5, 1.0, 10.0, ALPHA_SHOWN) if tick <= top]
    ax.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
    ax.set_yticks([], minor=True)
    is_cut = "alpha" in gains and np.any(log.alpha > ALPHA_SHOWN)
    ax.set_ylabel(f"gains [-]\n(α up to {ALPHA_SHOWN:g})" if is_cut else "gains [-]")
    add_grid(ax)
    add_legend(ax, ax.get_lines())


def speeds_figure(log: Log) -> Figure:
    """Draw joint velocities over time, with the limits of the joints drawn; shade steps that are not SOLVED."""
    names, limits = log.meta["coordinates"], log.meta["velocity_limit"]
    peak = np.max(np.abs(log.v), axis=0, initial=0.0)
    fastest = np.sort(np.argsort(-peak)[:_MAX_NAMED_LINES])
    figure = Figure(figsize=(9.5, 4.5), layout="constrained")
    ax = figure.add_subplot()
    handles = _draw_lines(ax, log.t, log.v, names, fastest, "slower joints", np.full(len(fastest), 1.4))
    for limit in sorted({limits[i] for i in fastest if limits[i] is not None}):
        style = {"color": COLLISION, "linewidth": 1.0, "linestyle": DASHES[3]}
        ax.axhline(-limit, **style)
        whose = [names[i] for i in fastest if limits[i] == limit]
        of = whose[0] if len(whose) == 1 else "all joints" if len(whose) == len(names) else f"{len(whose)} joints"
        handles.append(ax.axhline(limit, label=f"limit ±{limit:g} of {of}", **style))
    handles += _shade_status(ax, log)
    ax.set_xlabel("time [s]")
    ax.set_ylabel(f"joint velocity [{units(log, '/s')}]")
    add_grid(ax)
    add_legend(ax, handles)
    return figure


def _shade_status(ax: Any, log: Log) -> list[Any]:
    """Shade steps that were relaxed or stopped, and mark those of a plan; return their legend entries."""
    handles = []
    dt = log.meta["config"]["dt"]
    for status, colour in _STATUS_COLOUR.items():
        bad = log.status == STATUSES.index(status)
        for start, end in spans(bad):
            ax.axvspan(log.t[start], log.t[end] + dt, color=colour, alpha=0.35, linewidth=0, zorder=0)
        if bad.any():
            count = int(bad.sum())
            handles.append(Patch(color=colour, alpha=0.35, label=f"{status.value}: {count} step{'s' * (count > 1)}"))
    for start, end in spans(log.planned):
        ax.axvspan(log.t[start], log.t[end] + dt, color=PLAN, alpha=0.15, linewidth=0, zorder=0)
    if log.planned.any():
        handles.append(Patch(color=PLAN, alpha=0.15, label=f"plan followed: {dt * log.planned.sum():.1f} s"))
    return handles
