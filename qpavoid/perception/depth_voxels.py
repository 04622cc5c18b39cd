"""One depth image after the other into voxels: the robot's own body is left out, what it hides is remembered."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from qpavoid import kernels
from qpavoid.errors import ConfigError, NumericalError
from qpavoid.kernels import CellGrid, OwnBodies
from qpavoid.model.cloud import Voxels
from qpavoid.perception.camera import Camera
from qpavoid.problem import Array


class GridFull(NumericalError):
    """An image has more voxels than there is memory for: a region or a coarser resolution makes them fewer."""


class DepthVoxels:
    """Memory of the voxels of a camera; of bounded size."""

    def __init__(
        self,
        camera: Camera,
        resolution: float = 0.02,
        margin: float = 0.02,
        region: ArrayLike | None = None,
        memory: float = np.inf,
        least_pixels: int = 1,
        capacity: int = 30_000,
    ) -> None:
        """Lay the memory out.

        Args:
            camera: its lens and ranges.
            resolution: edge of a voxel [m]; that of the cloud's configuration.
            margin: distance from the robot's bodies up to which points count as the robot's own [m]. It has to cover
                errors of the calibration and of the time stamps, and be less than the safety distance d1.
            region: corners (2, 3) of a box, in world axes, outside of which points are left out [m].
            memory: time for which voxels are kept that something hides, or that are out of the picture [s].
            least_pixels: pixels that a voxel needs to count: more than 1 leaves single wrong ones out.
            capacity: voxels, at most.

        Raises:
            ConfigError: naming the argument.
        """
        everything = [[-_ENDLESS] * 3, [_ENDLESS] * 3]
        self._region = np.array(everything if region is None else region, dtype=np.float64)
        if self._region.shape != (2, 3) or not (self._region[0] < self._region[1]).all():
            raise ConfigError("region: expected two corners (2, 3), the lower one first")
        if not 1e-3 <= resolution <= 1.0 or not 0.0 <= margin <= 1.0 or not memory >= 0.0:
            raise ConfigError(f"resolution {resolution} m, margin {margin} m, memory {memory} s: out of range")
        if least_pixels < 1 or not 1 <= capacity <= _MOST_VOXELS:
            raise ConfigError(f"least_pixels {least_pixels}, capacity {capacity}: expected 1 to {_MOST_VOXELS}")
        self._camera, self._resolution, self._margin = camera, float(resolution), float(margin)
        self._memory, self._least_pixels, self._ranges = memory, least_pixels, np.array(camera.ranges)
        self._own = np.zeros((camera.height, camera.width), dtype=bool)
        size = 1 << (4 * capacity).bit_length()
        self._grid = CellGrid(
            np.zeros(size, np.intp), np.zeros((capacity, 3), np.intp), np.zeros(capacity, np.intp), np.zeros(capacity)
        )
        self._known: Array = np.zeros((0, 3))
        self._stamps: Array = np.zeros(0)

    def voxels(self, depth: Array, bodies: OwnBodies, pose: Array, t: float) -> Voxels:
        """Sort an image into voxels, in world axes.

        Args:
            depth: of each pixel (h, w), float32 [m]; 0 or NaN where unknown, infinite where nothing is in sight.
            bodies: of the robot when the image was taken, in the camera's axes.
            pose: of the camera then (12,), world axes.
            t: when it was taken [s].

        Raises:
            GridFull: more voxels than `capacity`; those of the image before are kept in mind.
        """
        camera, grid = self._camera, self._grid
        kernels.mark_own_pixels(depth, camera.lens, bodies, self._margin, self._own)
        count = kernels.fill_cells(
            depth, camera.lens, pose, self._own, self._ranges, self._region, self._resolution, t, grid
        )
        if count >= 0 and self._memory > 0.0:
            lasting = self._stamps >= t - self._memory
            count = kernels.recall_cells(
                depth, camera.lens, pose, self._own, bodies, camera.ranges[0], self._resolution,
                self._known[lasting], self._stamps[lasting], self._least_pixels, count, grid,
            )  # fmt: skip
        if count < 0:
            raise GridFull(
                f"more than {len(grid.cells)} voxels; give a smaller region, a coarser resolution or a larger capacity"
            )
        counted = np.flatnonzero(grid.pixels[:count] >= self._least_pixels)
        self._known = np.asarray((grid.cells[counted] + 0.5) * self._resolution, dtype=np.float64)
        self._stamps = grid.stamps[counted]
        return Voxels.of(self._known, self._resolution)


_ENDLESS = 90.0
"""Coordinates up to which points are used where no region is given [m]: beyond, a cloud drops them."""
_MOST_VOXELS = 1_000_000
"""Largest capacity [-]."""
