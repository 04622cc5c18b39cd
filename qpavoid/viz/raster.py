"""Pictures of triangle meshes for figures: a depth buffer, parallel projection, one light; no display, no library."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numba
import numpy as np
import numpy.typing as npt

from qpavoid.problem import Array

Surface = tuple[Any, Any, tuple[float, ...]]
"""Vertices (n, 3) in world axes [m], triangles (t, 3), and colour: red, green, blue, 0 to 1."""
_FINER = 2
"""Pixels that are drawn for one, in each direction, so that edges look smooth."""
_LIGHT = np.array([-0.35, -0.45, -0.82])
"""Direction to the light: to the right, downwards, and away from the viewer."""
_AMBIENT = 0.5
"""Brightness of what the light does not reach [-]."""


class Projection(NamedTuple):
    """A parallel projection; drawing it loses lengths along the view alone."""

    right: Array
    up: Array
    forward: Array
    """(3,) unit vectors of the picture: to its right, upwards, and away from the viewer."""

    @classmethod
    def looking(cls, azimuth: float, elevation: float) -> Projection:
        """Return the one that looks from an azimuth about z and an elevation above the horizon [deg]."""
        a, e = np.radians(azimuth), np.radians(elevation)
        forward = -np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
        right = np.array([-np.sin(a), np.cos(a), 0.0])
        return cls(right, np.cross(right, forward), forward)

    def flat(self, points: Any) -> Array:
        """Return where points (..., 3) are in the picture (..., 2) [m]: to the right, and upwards."""
        return np.asarray(np.stack((np.asarray(points) @ self.right, np.asarray(points) @ self.up), axis=-1))


class Canvas:
    """A picture of a rectangle of a projection."""

    def __init__(self, projection: Projection, lower: Array, upper: Array, height: int) -> None:
        """Begin empty.

        Args:
            projection: the projection.
            lower: left lower corner of the rectangle (2,) [m].
            upper: right upper corner (2,) [m].
            height: of the picture [pixels].
        """
        self.projection, self._lower = projection, lower
        self._scale = _FINER * height / float(upper[1] - lower[1])
        rows, columns = _FINER * height, max(_FINER * round(height * float(np.divide(*(upper - lower)))), _FINER)
        self._image = np.full((rows, columns, 4), (1.0, 1.0, 1.0, 0.0), np.float32)
        self._depth = np.full((rows, columns), np.inf, np.float32)

    def draw(self, surfaces: Sequence[Surface]) -> None:
        """Draw surfaces; what is nearer hides what is farther, whatever the order."""
        for vertices, faces, colour in surfaces:
            if not len(faces):
                continue
            points = np.asarray(vertices, dtype=np.float64)
            flat = self._scale * (self.projection.flat(points) - self._lower)
            depth = self._scale * (points @ self.projection.forward)
            screen = np.column_stack((flat[:, 0], len(self._image) - flat[:, 1], depth))
            rgb = np.array(colour[:3], dtype=np.float64)
            _fill(screen, np.asarray(faces, dtype=np.int64), rgb, _LIGHT, self._image, self._depth)

    def is_visible(self, points: Array, margin: float) -> npt.NDArray[np.bool_]:
        """Return whether points (n, 3) [m] are in the picture and less than `margin` [m] behind what is drawn."""
        flat = self._scale * (self.projection.flat(points) - self._lower)
        column, row = flat[:, 0].astype(int), len(self._image) - 1 - flat[:, 1].astype(int)
        inside = (column >= 0) & (row >= 0) & (row < self._depth.shape[0]) & (column < self._depth.shape[1])
        depth = self._depth[np.where(inside, row, 0), np.where(inside, column, 0)]
        return np.asarray(inside & (self._scale * (points @ self.projection.forward - margin) < depth))

    def picture(self) -> npt.NDArray[np.uint8]:
        """Return the picture (height, width, 4) with its opacity."""
        rows, columns = (side // _FINER for side in self._depth.shape)
        cells = self._image.reshape(rows, _FINER, columns, _FINER, 4).mean(axis=(1, 3))
        return np.asarray(np.clip(255.0 * cells + 0.5, 0.0, 255.0), dtype=np.uint8)


@numba.njit
def _fill(screen: Any, faces: Any, colour: Any, light: Any, image: Any, depth: Any) -> None:
    """Fill triangles (t, 3) of points (n, 3) [pixels: to the right, downwards, away] where they are nearest."""
    rows, columns = depth.shape
    for face in range(len(faces)):
        ax, ay, az = screen[faces[face, 0]]
        bx, by, bz = screen[faces[face, 1]]
        cx, cy, cz = screen[faces[face, 2]]
        nx = (by - ay) * (cz - az) - (bz - az) * (cy - ay)
        ny = (bz - az) * (cx - ax) - (bx - ax) * (cz - az)
        area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
        if area == 0.0:
            continue
        length = np.sqrt(nx * nx + ny * ny + area * area)
        # the normal that faces the viewer: meshes may be inside out
        bright = -np.sign(area) * (nx * light[0] + ny * light[1] + area * light[2]) / length
        bright = _AMBIENT + (1.0 - _AMBIENT) * max(bright, 0.0)
        first_row, last_row = max(int(np.floor(min(ay, by, cy))), 0), min(int(np.ceil(max(ay, by, cy))), rows)
        first, last = max(int(np.floor(min(ax, bx, cx))), 0), min(int(np.ceil(max(ax, bx, cx))), columns)
        for row in range(first_row, last_row):
            y = row + 0.5
            for column in range(first, last):
                x = column + 0.5
                u = ((bx - x) * (cy - y) - (cx - x) * (by - y)) / area
                v = ((cx - x) * (ay - y) - (ax - x) * (cy - y)) / area
                w = 1.0 - u - v
                if u < 0.0 or v < 0.0 or w < 0.0:
                    continue
                z = u * az + v * bz + w * cz
                if z < depth[row, column]:
                    depth[row, column] = z
                    for channel in range(3):
                        image[row, column, channel] = bright * colour[channel]
                    image[row, column, 3] = 1.0
