"""Figures of one run and of several solvers on one scenario. Needs matplotlib: `pip install qpavoid[plots]`.

Every `*_figure` function returns a `matplotlib.figure.Figure` of its own: no display and no global state is used, so
they work headless and in threads.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from qpavoid.log import STATUSES, Log
from qpavoid.metrics import path_deviation
from qpavoid.plot_motion import motion_figure, path_figure
from qpavoid.problem import Array, Status

DPI = 130
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
)
SOLVER_STYLES: dict[str, tuple[str, Any]] = {
    "tracking": ("#333333", DASHES[2]),
    "eq10-literal": ("#E69F00", DASHES[3]),
    "eq10": ("#D55E00", DASHES[1]),
    "gradient-projection": ("#CC79A7", DASHES[4]),
    "potential-field": ("#56B4E9", DASHES[6]),
    "hqp": ("#009E73", DASHES[5]),
    "qp": ("#0072B2", DASHES[0]),
}
ALPHA_SHOWN = 100.0
"""α is drawn up to here: it grows without bound as the distance goes to 0."""
ERROR_FLOOR = 1e-5
"""The axis of distances to the target begins here [m]."""
COLLISION, D1, D2, D_SAFE = "#C62F2F", "#7A4B9A", "#8A8A8A", "#00695C"
_STATUS_COLOUR = {Status.RELAXED: "#F5C242", Status.STOPPED: "#C62F2F"}
_GREY = "#B8B8B8"


def plot_run(log: Log, folder: str | Path) -> list[Path]:
    """Writes the figures of one run: motion, joints, distances, speeds.

    Returns:
        The files, `<scenario>_<solver>_<figure>.png`, in that order.
    """
    draw = {"motion": motion_figure, "joints": joints_figure, "distances": distances_figure, "speeds": speeds_figure}
    figures = {name: make(log) for name, make in draw.items()}
    for figure in figures.values():
        figure.suptitle(_title(log), fontsize=11)
    return _save(figures, folder, f"{log.meta['scenario']}_{log.meta['solver'].replace(':', '-')}")


def plot_compare(logs: Sequence[Log], folder: str | Path) -> list[Path]:
    """Writes the figures that lay several runs of one scenario over each other: time and path.

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


# --- one run ------------------------------------------------------------------------------------------------


def position_names(log: Log) -> list[str]:
    """A name for each of the nq coordinates of q.

    Where nq > nv, joints with several velocities are taken to have one coordinate more (a quaternion, or the sine and
    cosine of a planar joint), and, if the count asks for it, joints without limits to be cosine and sine; whatever
    does not add up is numbered.
    """
    names: list[str] = log.meta["coordinates"]
    if len(names) == log.q.shape[1]:
        return names
    limited = {name for name, _, _ in log.meta["position_limits"]}
    counts = Counter(name if name in limited else name.rpartition(".")[0] or name for name in names)
    for circle in (("",), (".cos", ".sin")):
        parts = {1: circle, 6: (".x", ".y", ".z", ".qx", ".qy", ".qz", ".qw")}
        found = []
        for joint, count in counts.items():
            several = parts.get(count, tuple(f".{i}" for i in range(count + 1)))
            found += [joint] if joint in limited else [joint + part for part in several]
        if len(found) == log.q.shape[1]:
            return found
    return [f"q[{i}]" for i in range(log.q.shape[1])]


def joints_figure(log: Log) -> Figure:
    """Coordinates of q over time, a panel each, with position limits (Figs. 7 and 14 of the paper)."""
    names = position_names(log)
    limits = {name: (lower, upper) for name, lower, upper in log.meta["position_limits"]}
    columns = 4 if len(names) <= 16 else 6
    rows = max(-(-len(names) // columns), 1)
    figure = Figure(figsize=(2.6 * columns, 1.8 * rows + 0.8), layout="constrained")
    for i, name in enumerate(names):
        ax = figure.add_subplot(rows, columns, i + 1)
        ax.plot(log.t, log.q[:, i], color=COLOURS[0], linewidth=1.4)
        ax.set_title(name, fontsize=9)
        ax.tick_params(labelsize=8)
        _grid(ax)
        if name in limits:
            for limit in filter(np.isfinite, limits[name]):
                ax.axhline(limit, color=COLLISION, linewidth=0.8)
            bottom, top = ax.get_ylim()
            ax.set_ylim(bottom, top)
            for limit, outer in zip(limits[name], (bottom, top), strict=True):
                if np.isfinite(limit):
                    ax.axhspan(limit, outer, color=COLLISION, alpha=0.15, linewidth=0)
        if i + columns >= len(names):
            ax.set_xlabel("time [s]", fontsize=9)
    figure.supylabel("joint position [rad or m]", fontsize=10)
    handles = [
        Line2D([], [], color=COLOURS[0], label="position"),
        Patch(color=COLLISION, alpha=0.3, label="beyond limits"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=2, fontsize=9, frameon=False)
    return figure


def distances_figure(log: Log) -> Figure:
    """Distance of each body over time with d1, d2 and collision, and α, β below (Figs. 8, 11, 13 of the paper)."""
    avoidance = log.meta["config"]["avoidance"]
    offset, reach = avoidance["offset"], 1.5 * avoidance["d2"]
    distance = log.body_distance + offset
    figure = Figure(figsize=(9.5, 7.0), layout="constrained")
    ax, gains = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    drawn = np.flatnonzero(np.isfinite(distance).any(axis=0))
    nearest = np.min(distance, axis=0, initial=np.inf)
    near = drawn if len(drawn) <= len(COLOURS) else drawn[nearest[drawn] < reach]
    far = [i for i in drawn if i not in near]
    for i in far:
        ax.plot(log.t, distance[:, i], color=_GREY, linewidth=0.7, zorder=1)
    # Thinner and thinner: the two bodies of a pair share their distance, and neither line may hide the other.
    for rank, (i, width) in enumerate(zip(near, np.linspace(3.0, 1.2, len(near)), strict=True)):
        ax.plot(log.t, distance[:, i], label=log.meta["bodies"][i], linewidth=width, zorder=3, **_style(rank))
    handles = ax.get_legend_handles_labels()[0]
    if far:
        handles.append(Line2D([], [], color=_GREY, linewidth=0.7, label=f"{len(far)} bodies never within {reach:g} m"))
    handles += _levels(ax, log, qp=_is_qp(log))
    handles += _shade_status(ax, log)
    _plot_gains(gains, log)
    _distance_axis(ax, offset, distance[:, near])
    _legend(ax, handles)
    return figure


def _plot_gains(ax: Any, log: Log) -> None:
    alpha = np.minimum(log.alpha, ALPHA_SHOWN)
    ax.plot(log.t, alpha, color="#333333", label="α of the closest pair (eq. 11)")
    ax.plot(log.t, log.beta, color="#8A8A8A", linestyle=DASHES[1], label="β of the closest pair (eq. 12)")
    ax.set_yscale("symlog", linthresh=1.0)
    top = next(top for top in (1.0, 10.0, ALPHA_SHOWN) if np.nanmax(alpha, initial=0.0) <= top)
    ticks = [tick for tick in (0.0, 0.5, 1.0, 10.0, ALPHA_SHOWN) if tick <= top]
    ax.set_ylim(-0.1, 1.15 * top)
    ax.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
    ax.set_yticks([], minor=True)
    ax.set_ylabel(f"gains [-]\n(α up to {ALPHA_SHOWN:g})" if np.any(log.alpha > ALPHA_SHOWN) else "gains [-]")
    ax.set_xlabel("time [s]")
    _grid(ax)
    _legend(ax, ax.get_lines())


def speeds_figure(log: Log) -> Figure:
    """Joint velocities over time; limits of the joints that use more than 80 % of theirs; ticks not SOLVED shaded."""
    names, limits = log.meta["coordinates"], log.meta["velocity_limit"]
    peak = np.max(np.abs(log.v), axis=0, initial=0.0)
    fastest = np.sort(np.argsort(-peak)[: 2 * len(COLOURS)])
    figure = Figure(figsize=(9.5, 4.5), layout="constrained")
    ax = figure.add_subplot()
    rest = [i for i in range(len(names)) if i not in fastest]
    for i in rest:
        ax.plot(log.t, log.v[:, i], color=_GREY, linewidth=0.7, zorder=1)
    for rank, i in enumerate(fastest):
        ax.plot(log.t, log.v[:, i], label=names[i], linewidth=1.4, zorder=3, **_style(rank))
    handles = ax.get_legend_handles_labels()[0]
    if rest:
        handles.append(Line2D([], [], color=_GREY, linewidth=0.7, label=f"{len(rest)} slower joints"))
    for limit in {limits[i] for i in fastest if limits[i] is not None and peak[i] > 0.8 * limits[i]}:
        style = {"color": COLLISION, "linewidth": 1.0, "linestyle": DASHES[3]}
        ax.axhline(-limit, **style)
        handles.append(ax.axhline(limit, label=f"velocity limit ±{limit:g}", **style))
    handles += _shade_status(ax, log)
    ax.set_xlabel("time [s]")
    ax.set_ylabel("joint velocity [rad/s or m/s]")
    _grid(ax)
    _legend(ax, handles)
    return figure


# --- several solvers ----------------------------------------------------------------------------------------


def solver_styles(logs: Sequence[Log]) -> list[dict[str, Any]]:
    """Label, colour and line style of each run, the same in every panel and, for known solvers, in every figure."""
    solvers = [log.meta["solver"] for log in logs]
    known = [SOLVER_STYLES[solver] for solver in solvers if solver in SOLVER_STYLES]
    spare = [(colour, dash) for dash in DASHES for colour in COLOURS if (colour, dash) not in known]
    spare.sort(key=lambda style: style[0] in [colour for colour, _ in known])  # colours of their own first
    taken: list[str] = []
    styles = []
    for solver in solvers:
        colour, dash = SOLVER_STYLES[solver] if solver in SOLVER_STYLES and solver not in taken else spare.pop(0)
        label = f"{solver} ({taken.count(solver) + 1})" if solver in taken else solver
        taken.append(solver)
        styles.append({"label": label, "color": colour, "linestyle": dash})
    return styles


def compare_time_figure(logs: Sequence[Log]) -> Figure:
    """Smallest distance, deviation from the planned path, distance to the target and fastest joint over time."""
    meta = logs[0].meta
    offset = meta["config"]["avoidance"]["offset"]
    figure = Figure(figsize=(9.0, 10.0), layout="constrained")
    distance, deviation, error, speed = figure.subplots(4, 1, sharex=True, height_ratios=(1.5, 1, 1, 1))
    for log, style in zip(logs, solver_styles(logs), strict=True):
        line = {**style, "linewidth": 1.7}
        to_target = np.linalg.norm(log.target - log.tool, axis=2)
        distance.plot(log.t, log.min_distance + offset, **line)
        deviation.plot(log.t, np.max(path_deviation(log), axis=1, initial=0.0), **line)
        error.plot(log.t, np.max(to_target, axis=1, initial=1e-3 * ERROR_FLOOR), **line)
        speed.plot(log.t, np.max(np.abs(log.v), axis=1, initial=0.0), **line)
    solvers = distance.get_legend_handles_labels()[0]
    levels = _levels(distance, logs[0], qp=any(map(_is_qp, logs)))
    _distance_axis(distance, offset, *(log.min_distance + offset for log in logs), name="smallest distance\n")
    deviation.set_ylabel("deviation from the\nplanned path [m]")
    error.set_yscale("log")
    tolerance = meta["config"]["goal_tolerance"]
    levels.append(
        error.axhline(tolerance, color=D2, linewidth=1.0, linestyle=":", label=f"goal tolerance: {tolerance:g} m")
    )
    error.set_ylim(bottom=ERROR_FLOOR)
    error.set_ylabel("distance to the\ntarget [m]")
    speed.set_ylabel("fastest joint\n[rad/s or m/s]")
    speed.set_xlabel("time [s]")
    for ax in (deviation, error, speed):
        _grid(ax)
    figure.suptitle(meta["title"] or meta["scenario"], fontsize=11)
    _legend(distance, [*solvers, *levels[:-1]])
    _legend(error, levels[-1:])
    return figure


# --- parts --------------------------------------------------------------------------------------------------


def _style(rank: int) -> dict[str, Any]:
    return {"color": COLOURS[rank % len(COLOURS)], "linestyle": DASHES[rank // len(COLOURS) % len(DASHES)]}


def _is_qp(log: Log) -> bool:
    return str(log.meta["solver"]).partition(":")[0] in ("qp", "hqp")


def _grid(ax: Any) -> None:
    ax.grid(True, color="#E4E4E4", linewidth=0.6)
    ax.set_axisbelow(True)
    ax.margins(x=0.0)


def _legend(ax: Any, handles: Sequence[Any]) -> None:
    """Legend beside the panel, where it hides nothing."""
    style = {"fontsize": 8, "frameon": False, "borderaxespad": 0.0}
    ax.legend(handles=handles, loc="upper left", bbox_to_anchor=(1.01, 1.0), **style)


def _levels(ax: Any, log: Log, qp: bool) -> list[Any]:
    """Draws d2, d1, the distance that QP rows hold, and collision."""
    avoidance = log.meta["config"]["avoidance"]
    levels = [("$d_2$ = {:g} m", avoidance["d2"], D2, DASHES[1]), ("$d_1$ = {:g} m", avoidance["d1"], D1, DASHES[3])]
    d_safe = avoidance["row"].get("d_safe")
    if qp and d_safe is not None:
        levels.append(("$d_{{safe}}$ = {:g} m (QP rows)", d_safe, D_SAFE, DASHES[2]))
    levels.append(("collision: {:g} m", avoidance["offset"], COLLISION, DASHES[0]))
    return [
        ax.axhline(d, color=colour, linestyle=dash, linewidth=1.1, zorder=2, label=label.format(d))
        for label, d, colour, dash in levels
    ]


def _distance_axis(ax: Any, offset: float, *drawn: Array, name: str = "distance ") -> None:
    ax.set_ylabel(f"{name}between axes [m]" if offset > 0.0 else f"{name}between surfaces [m]")
    _grid(ax)
    finite = [d[np.isfinite(d)] for d in drawn]
    lowest = min((float(d.min()) for d in finite if d.size), default=offset)
    bottom, top = ax.get_ylim()
    bottom = min(lowest, offset) - 0.04 * (top - offset)
    ax.axhspan(bottom, offset, color=COLLISION, alpha=0.08, linewidth=0, zorder=0)
    ax.set_ylim(bottom, top)


def _shade_status(ax: Any, log: Log) -> list[Any]:
    """Shades ticks that were relaxed or stopped; gives a legend entry for each status that occurs."""
    handles = []
    dt = log.meta["config"]["dt"]
    for status, colour in _STATUS_COLOUR.items():
        bad = np.r_[False, log.status == STATUSES.index(status), False].astype(np.int8)
        starts, ends = np.flatnonzero(np.diff(bad) == 1), np.flatnonzero(np.diff(bad) == -1)
        for start, end in zip(starts, ends, strict=True):
            ax.axvspan(log.t[start], log.t[end - 1] + dt, color=colour, alpha=0.35, linewidth=0, zorder=0)
        if len(starts):
            handles.append(Patch(color=colour, alpha=0.35, label=f"{status.value}: {int(bad.sum())} ticks"))
    return handles
