"""Robots that are shown translucent: along a backup trajectory, or of other runs in the same scene."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin

from qpavoid.problem import Array
from qpavoid.viz.meshes import Mesh, decimated
from qpavoid.viz.view_link import BACKUP, MAX_GHOSTS

COLOURS = np.array([[60, 120, 220], [230, 120, 20], [150, 60, 170], [20, 150, 110]], np.uint8)
"""Of a backup trajectory, then of the other runs."""
_OPACITIES = (0.18, 0.55)
"""Of a backup trajectory's robots, and of others."""
_COARSE = 0.02
"""Size of details that are left out [m]."""


class Ghosts:
    """One batch of meshes for each joint, an instance of it for each robot."""

    def __init__(self, scene: Any, parts: list[tuple[int, Any, list[Mesh]]], others: int) -> None:
        """Add the batches, which are invisible.

        Args:
            scene: of viser.
            parts: joint, placement on it and meshes of each part of the robot.
            others: number of other runs.
        """
        self._count = MAX_GHOSTS + others
        by_joint: dict[int, list[tuple[Any, Any]]] = {}
        for joint, placement, meshes in parts:
            for mesh in meshes:
                coarse = decimated(mesh, _COARSE)
                vertices = coarse.vertices @ placement.rotation.T + placement.translation
                by_joint.setdefault(joint, []).append((vertices, coarse.faces))
        self._batches: list[tuple[int, Any]] = []
        identity = np.tile([1.0, 0.0, 0.0, 0.0], (self._count, 1))
        for joint, group in by_joint.items():
            starts = np.cumsum([0, *(len(vertices) for vertices, _ in group)])
            faces = [faces + start for (_, faces), start in zip(group, starts, strict=False)]
            batch = scene.add_batched_meshes_simple(
                f"/ghosts/{joint}", np.concatenate([vertices for vertices, _ in group]).astype(np.float32),
                np.concatenate(faces).astype(np.uint32), identity, np.zeros((self._count, 3)),
                batched_scales=np.zeros(self._count), batched_colors=np.tile(COLOURS[0], (self._count, 1)),
                batched_opacities=np.ones(self._count), cast_shadow=False, visible=False, lod="off", side="double",
            )  # fmt: skip
            self._batches.append((joint, batch))
        self._shown: Array = np.zeros((0, 0))

    def show(self, model: Any, data: Any, ghosts: Array) -> None:
        """Show robots (g, 2 + nq), see `Frame.ghosts`; they are not sent again where nothing changed."""
        ghosts = ghosts[: self._count]
        if ghosts.shape == self._shown.shape and np.array_equal(ghosts[:, 2:], self._shown[:, 2:]):
            return
        self._shown = ghosts.copy()
        count, kinds = len(ghosts), ghosts[:, 0].astype(int)
        wxyz, position = (
            np.tile([1.0, 0.0, 0.0, 0.0], (len(self._batches), self._count, 1)),
            np.zeros((len(self._batches), self._count, 3)),
        )
        for number, q in enumerate(ghosts[:, 2:]):
            pin.forwardKinematics(model, data, q)
            for index, (joint, _) in enumerate(self._batches):
                pose = data.oMi[joint]
                wxyz[index, number] = np.roll(pin.Quaternion(pose.rotation).coeffs(), 1)
                position[index, number] = pose.translation
        scales, colours, opacities = np.zeros(self._count), np.zeros((self._count, 3), np.uint8), np.ones(self._count)
        scales[:count], colours[:count] = 1.0, COLOURS[kinds % len(COLOURS)]
        opacities[:count] = np.where(kinds == BACKUP, *_OPACITIES)
        for index, (_, batch) in enumerate(self._batches):
            if batch.visible != (count > 0):
                batch.visible = count > 0
            if count:
                batch.batched_wxyzs, batch.batched_positions = wxyz[index], position[index]
                batch.batched_scales, batch.batched_colors, batch.batched_opacities = scales, colours, opacities
