"""Which pairs can be within reach at all: their bounding spheres tell."""

from __future__ import annotations

from typing import Any

import numpy as np

from qpavoid import kernels
from qpavoid.model.scene import Scene
from qpavoid.problem import Array, IntArray, Mask


class Cull:
    """Switches pairs off in coal's data whose bounding spheres are out of reach."""

    def __init__(self, scene: Scene, data: Any, poses: Array, spheres: Array, centers: Array, by_coal: Mask) -> None:
        """Takes all pairs for switched on.

        Args:
            scene: robot and obstacles.
            data: geometry data, in which pairs are switched on and off.
            poses: world poses of all bodies, kept up to date by others (g, 12).
            spheres: bounding sphere of each body in its own frame, centre and radius (g, 4) [m].
            centers: see `ObstaclePlacement.centers` (g, 5).
            by_coal: which pairs coal computes (m,); the others stay off in its data.
        """
        self._data, self._poses, self._centers, self._by_coal = data, poses, centers, by_coal
        self._bodies = scene.movable
        self._local, self._radius = spheres[:, :3].copy(), spheres[:, 3].copy()
        self._pair_of = np.full((self._bodies, len(self._local)), -1, dtype=np.intp)
        self._pair_of[scene.pairs[:, 0], scene.pairs[:, 1]] = np.arange(len(scene.pairs))
        self._reach = np.nan
        self._wanted: Any = None
        self._within: Array = np.empty(self._pair_of.shape)
        self._found = np.zeros(len(scene.pairs), dtype=np.intp)
        self.active = np.ones(len(scene.pairs), dtype=bool)
        """(m,) which pairs are on."""
        for pair in np.flatnonzero(~by_coal).tolist():
            self._data.deactivateCollisionPair(pair)
        self._last = np.arange(len(scene.pairs)).tobytes()
        kernels.sorted_setxor(self._found, np.frombuffer(self._last, dtype=np.intp))  # so that no tick compiles it

    def place_points(self, indices: IntArray, positions: Array) -> None:
        """Moves the bounding spheres of several geometries (k,), whose centres are their origins (k, 3)."""
        self._centers[indices, :3] = positions
        self._centers[indices, 4] = -np.einsum("ij,ij->i", positions, positions)

    def enable(self, pairs: Any) -> None:
        """Takes only some pairs (m,) into account from now on."""
        self._wanted, self._reach = (self._pair_of >= 0) & pairs[self._pair_of], np.nan

    def switch(self, reach: float) -> IntArray:
        """Switches pairs on and off; gives those that are on, in increasing order."""
        if reach != self._reach:
            touching = self._radius[: self._bodies, None] + self._radius + reach
            self._within = np.where(self._wanted, touching**2 * (1.0 + 1e-9), -1.0)
            self._reach = reach
        count = kernels.candidates(self._poses, self._local, self._centers, self._within, self._pair_of, self._found)
        pairs = self._found[:count]
        now = pairs.tobytes()
        if now != self._last:
            changed = kernels.sorted_setxor(pairs, np.frombuffer(self._last, dtype=np.intp))
            self._last = now
            self.active[changed] ^= True
            changed = changed[self._by_coal[changed]]
            for pair, on in zip(changed.tolist(), self.active[changed].tolist(), strict=True):
                (self._data.activateCollisionPair if on else self._data.deactivateCollisionPair)(pair)
        return pairs
