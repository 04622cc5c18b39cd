"""Status of a control step in words and colours, as HTML."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from typing import Any

import numpy as np

from qpavoid.control.tick import Tick
from qpavoid.problem import Status
from qpavoid.reason import Severity

_MAX_REASONS = 6
_BADGES = {Status.SOLVED: "#1B7F4B", Status.RELAXED: "#B7791F", Status.STOPPED: "#C62F2F"}
_SEVERITIES = {Severity.INFO: "#6B6B6B", Severity.WARNING: "#9C5F00", Severity.ALARM: "#C62F2F"}
_PAGE = '<div style="padding:0.2em 0.9em;font-size:0.85em;line-height:1.45">{}</div>'


def status_html(tick: Tick, step_times: Sequence[float] = (), note: str = "") -> str:
    """Return what a control step decided and why.

    Args:
        tick: the step.
        step_times: of the last steps [s].
        note: more to say, in plain text.
    """
    solution, proximity, names = tick.solution, tick.proximity, tick.problem.pair_names
    closest = ""
    if len(proximity.pair):
        nearest = int(np.argmin(proximity.distance))
        a, b = names[proximity.pair[nearest]]
        closest = closest_html(a, b, float(proximity.distance[nearest]), tick.problem.avoidance.d1)
    reasons = [
        (str(reason), reason.severity) for reason in (*solution.reasons, *solution.stalled, *solution.assumptions)
    ]
    return page_html(solution.status, tick.state.t, closest, reasons, times_html(step_times), note)


def page_html(
    status: Status, t: float, closest: str, reasons: Sequence[tuple[str, Severity]], times: str = "", note: str = ""
) -> str:
    """Return a status with its time [s], closest pair, reasons with their severities, and a note."""
    badge = f"background:{_BADGES[status]};color:white;border-radius:0.3em;padding:0 0.4em"
    lines = [f'<b style="{badge}">{status.value}</b> at {t:.2f} s{times}', closest]
    lines += [_coloured(text, _SEVERITIES[severity]) for text, severity in reasons[:_MAX_REASONS]]
    if len(reasons) > _MAX_REASONS:
        lines.append(f"and {len(reasons) - _MAX_REASONS} more")
    lines.append(_coloured(note, "#0B5CAD"))
    return _PAGE.format("<br>".join(filter(None, lines)))


def text_html(*lines: str) -> str:
    """Return lines of plain text."""
    return _PAGE.format("<br>".join(map(escape, lines)))


def hint_html(text: str) -> str:
    """Return what is to be done first, in plain text."""
    return _PAGE.format(f'<b style="color:#0B5CAD">{escape(text)}</b>')


def closest_html(a: str, b: str, distance: float, d1: float) -> str:
    """Return the closest pair and its distance [m]."""
    colour = "#C62F2F" if distance < 0.0 else "#9C5F00" if distance < d1 else "#333333"
    return _coloured(f"closest: {a} – {b}: {1e3 * distance:.0f} mm" + ", in contact" * (distance < 0.0), colour)


def times_html(step_times: Sequence[float]) -> str:
    """Return how long the last control steps took."""
    if not len(step_times):
        return ""
    ordered = sorted(step_times)  # a quarter of the time of numpy's quantiles
    median, p99 = ordered[len(ordered) // 2], ordered[int(0.99 * (len(ordered) - 1))]
    return f", step {_milliseconds(median)}, p99 {_milliseconds(p99)}"


def _milliseconds(time: float) -> str:
    """Return a time [s] in words: 0.31 ms, 1.4 ms, 12 ms, 120 ms."""
    return f"{1e3 * time:.2g} ms" if time < 0.0995 else f"{1e3 * time:.0f} ms"


def legend_html(names: Sequence[str], colours: Any) -> str:
    """Return the names of ghosts, each in its colour (n, 3), 0 to 255."""
    lines = [
        f'<span style="color:rgb({r:.0f},{g:.0f},{b:.0f})">&#9632;</span> {escape(name)}'
        for name, (r, g, b) in zip(names, colours, strict=True)
    ]
    return _PAGE.format("<br>".join(lines))


def _coloured(text: str, colour: str) -> str:
    return f'<span style="color:{colour}">{escape(text)}</span>' if text else ""
