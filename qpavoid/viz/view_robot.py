"""A robot on a page: its bodies over its meshes, a slider for each joint, and what is checked of its pairs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from html import escape
from typing import Any

import numpy as np
import pinocchio as pin

from qpavoid.control.distances import DistanceQuery
from qpavoid.model.kinematics import ForwardKinematics
from qpavoid.model.robot import Robot
from qpavoid.model.scene import build_scene
from qpavoid.problem import Array
from qpavoid.viz.view import View, page_setup, run_page
from qpavoid.viz.view_clock import PlayClock
from qpavoid.viz.view_link import MAX_WITNESSES, Frame, bodies_in_contact

NEAR = 0.1
"""Distance up to which active pairs are shown [m]."""
_LISTED = 8
"""Closest pairs that are listed."""
_PERIOD = 0.02


class RobotPage:
    """A robot that is moved by hand."""

    def __init__(
        self,
        robot: Robot,
        left_out: Mapping[str, Sequence[str]],
        notes: Sequence[str] = (),
        *,
        port: int = 8080,
        host: str = "127.0.0.1",
        quality: str = "high",
    ) -> None:
        """Start the page.

        Args:
            robot: the robot.
            left_out: reason why pairs are not checked, and these pairs, in words.
            notes: more to say about it, in words.
            port: see `View`.
            host: see `View`.
            quality: see `View`.

        Raises:
            ConfigError: viser is missing.
        """
        self.robot, self._scene = robot, build_scene(robot)
        self._kinematics, self._query = ForwardKinematics(robot.model), DistanceQuery(self._scene)
        bounds = robot.bounds()
        start = np.zeros(robot.model.nv)
        start[bounds.v_index] = robot.home[bounds.q_index]
        lower, upper = np.full(robot.model.nv, -np.pi), np.full(robot.model.nv, np.pi)  # of joints without limits
        has_both = np.isfinite(bounds.lower) & np.isfinite(bounds.upper) & (bounds.lower < bounds.upper)
        lower[bounds.v_index[has_both]] = np.minimum(bounds.lower, robot.home[bounds.q_index])[has_both]
        upper[bounds.v_index[has_both]] = np.maximum(bounds.upper, robot.home[bounds.q_index])[has_both]
        self._start, self._values = start, start.copy()
        setup = page_setup(robot, [], [], robot.name)
        sliders = zip(robot.coordinate_names, lower.tolist(), upper.tolist(), start.tolist(), strict=True)
        texts = [(f"{len(pairs)} pairs left out: {why}", _list_html(pairs)) for why, pairs in left_out.items()]
        setup.controls = {"joints": list(sliders), "shows bodies": True, "texts": texts}
        if notes:
            setup.controls["texts"].append((f"{len(notes)} notes", _list_html(notes)))
        setup.port, setup.host, setup.quality = port, host, quality
        self.touching: set[str] = set()
        """Names of the bodies that touch in the configuration that is shown."""
        self.view, self._clock = View.of_setup(setup), PlayClock(_PERIOD)

    @property
    def q(self) -> Array:
        """Return the configuration (nq,) that the sliders give."""
        return np.asarray(pin.integrate(self.robot.model, self.robot.home, self._values - self._start))

    def run(self, is_done: Callable[[], bool] = lambda: False) -> None:
        """Run until `is_done`, the page fails, or the keyboard interrupts."""
        run_page(self.view, self._clock, self._apply, self._advance, is_done)

    def _apply(self, event: dict[str, Any]) -> None:
        if event["type"] == "joint":
            self._values[event["index"]] = float(event["value"])

    def _advance(self) -> None:
        self._clock.wait()
        if self.view.is_due():
            self.view.show(self.frame())

    def frame(self) -> Frame:
        """Return what is shown."""
        q, scene = self.q, self._scene
        self._kinematics.compute(q)
        self._query.compute(self._kinematics.joint_poses, NEAR)
        pairs = np.asarray(self._query.pairs)
        results = self._query.arrays.results[pairs]
        is_near = results[:, 0] < NEAR
        order = np.flatnonzero(is_near)[np.argsort(results[is_near, 0])]
        pairs, results = pairs[order], results[order]
        touching = bodies_in_contact(scene, pairs, results[:, 0])
        self.touching = {scene.body_names[int(number)] for number in touching}
        witnesses = np.column_stack((results[:, [0, 4, 5, 6, 7, 8, 9]], np.full(len(pairs), -1.0)))[:MAX_WITNESSES]
        lines = [f"<b>{len(scene.pairs)} active pairs</b>, {len(pairs)} nearer than {1e3 * NEAR:.0f} mm"]
        for pair, distance in zip(pairs[:_LISTED].tolist(), results[:_LISTED, 0].tolist(), strict=True):
            a, b = scene.pair_names[pair]
            colour = "#C62F2F" if distance < 0.0 else "#333333"
            lines.append(f'<span style="color:{colour}">{escape(a)} – {escape(b)}: {1e3 * distance:.0f} mm</span>')
        none = np.zeros((0, 3)), np.zeros((0, 12)), np.zeros((0, 12))
        text = f'<div style="padding:0.2em 0.9em;font-size:0.85em">{"<br>".join(lines)}</div>'
        ghosts = np.zeros((0, 2 + len(q)))
        return Frame(
            0.0, q, np.zeros(self.robot.model.nv), witnesses, *none, np.array([0.0, NEAR]), ghosts, touching, text
        )  # fmt: skip


def _list_html(lines: Sequence[str]) -> str:
    return f'<div style="padding:0.2em 0.9em;font-size:0.8em">{"<br>".join(map(escape, lines))}</div>'
