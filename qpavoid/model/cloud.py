"""Points as from a depth camera: read, cleaned and sorted into voxels and blocks, so that queries find the near ones.

A voxel that holds a point counts as the sphere around it, whatever number of points it holds: how dense and how noisy a
camera is makes no difference to what is kept clear, and the same voxels come back from one picture to the next.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from qpavoid.config.files import read_text
from qpavoid.errors import ConfigError, NumericalError
from qpavoid.model.csv_poses import read_table
from qpavoid.model.sample import Sample
from qpavoid.problem import Array, IntArray, as_numbers

_BLOCK = 4
"""Voxels along the edge of a block."""
_HALF = 2**15
"""Blocks are numbered from -_HALF to _HALF - 1 along each axis."""
_STRIDES = np.array([_BLOCK**3 * (2 * _HALF) ** 2, _BLOCK**3 * 2 * _HALF, _BLOCK**3, _BLOCK**2, _BLOCK, 1])
"""Of a voxel's key for its block's numbers along the axes, and its own in the block."""
_MAX_DISTANCE = 1e2
"""Largest distance of a point from the cloud's origin [m]; no depth camera measures farther, and others are dropped."""
_LARGEST, _MOST_POINTS = 200_000_000, 5_000_000
"""Size of a file [bytes] and number of its points, at most: what a scenario reads within seconds."""


class Points(NamedTuple):
    """A measurement of a camera: replaces all earlier points of a cloud."""

    points: ArrayLike | Voxels
    """(n, 3) in the cloud's frame [m]; points with NaN or infinity are dropped. Or `Voxels` made beforehand, which
    saves the control step the work."""
    pose: Sample | None = None
    """Where the cloud's frame is, and how it moves; where it was if left out, which is the world at first."""
    t: float | None = None
    """Time stamp of the measurement [s]; that of the pose, or the time of the control step, if left out."""
    at_rest: bool = False
    """Whether they stay there until others are given: they are never stale."""


@dataclass(frozen=True)
class Voxels:
    """The voxels that hold a point, sorted into blocks."""

    resolution: float
    """Edge of a voxel [m]."""
    centers: Array
    """(m, 3) in the cloud's frame [m], those of a block one after the other."""
    keys: IntArray
    """(m,) number of each voxel, the same in every cloud of this resolution."""
    blocks: Array
    """(b, 4) sphere around the voxels' centres of each block: its centre and radius [m]."""
    starts: IntArray
    """(b + 1,) where each block begins in `centers`."""
    dropped: int = 0
    """Number of points that were NaN, infinite or farther away than 100 m."""
    given: int = 0
    """Number of points in all."""

    @classmethod
    def of(cls, points: ArrayLike, resolution: float) -> Voxels:
        """Sort points into voxels and blocks.

        It takes some ms for 10 000, which a thread of the camera may spend.

        Args:
            points: (n, 3) [m]; n may be 0.
            resolution: edge of a voxel [m]; that of the cloud's configuration.

        Raises:
            NumericalError: wrong shape, or not numbers.
        """
        array = as_numbers("points", points)
        if array.ndim != 2 or array.shape[1] != 3:
            raise NumericalError(f"points: shape {array.shape}, expected (n, 3)")
        is_finite = np.abs(array).max(axis=1, initial=0.0) <= _MAX_DISTANCE  # False for NaN too
        finite = array if is_finite.all() else array[is_finite]
        voxel = np.floor(finite / resolution).astype(np.int64)
        places = np.concatenate((voxel // _BLOCK + _HALF, voxel % _BLOCK), axis=1)
        keys, first = np.unique(places @ _STRIDES, return_index=True)
        centers = np.asarray((voxel[first] + 0.5) * resolution, dtype=np.float64)
        block = keys // _BLOCK**3
        starts = np.flatnonzero(np.diff(block, prepend=-1)).astype(np.intp)
        blocks = np.empty((len(starts), 4))
        if len(starts):
            low, high = np.minimum.reduceat(centers, starts), np.maximum.reduceat(centers, starts)
            blocks[:, :3], blocks[:, 3] = 0.5 * (low + high), 0.5 * np.linalg.norm(high - low, axis=1)
        return cls(
            resolution, centers, keys, blocks, np.append(starts, len(keys)), len(array) - len(finite), len(array)
        )

    @classmethod
    def of_octree(cls, tree: Any, resolution: float | None = None) -> Voxels:
        """Make voxels of the occupied leaves of a coal octree (`coal.OcTree`), large ones cut up.

        The edge of a voxel is the cloud's resolution [m], the tree's own if left out.
        """
        edge = tree.getResolution() if resolution is None else resolution
        points = [np.zeros((0, 3))]
        for x, y, z, size, occupancy, threshold in map(np.asarray, tree.toBoxes()):
            steps = (np.arange(max(round(size / edge), 1)) + 0.5) * edge - 0.5 * size if size > edge else np.zeros(1)
            if occupancy >= threshold:
                points.append(np.array([x, y, z]) + np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3))
        return cls.of(np.concatenate(points), edge)


def voxel_radius(resolution: float) -> float:
    """Return the radius of a voxel's circumscribed sphere [m]."""
    return float(0.5 * np.sqrt(3.0) * resolution)


def read_points(path: Path, where: str) -> Array:
    """Read points (n, 3) [m] from a file: `.npy` with an array (n, 3), or `.csv` with the header `x,y,z`.

    Raises:
        ConfigError: cannot be read, or not points; naming the field in `where`.
    """
    if path.suffix == ".csv":
        points: Any = read_table(read_text(path, _LARGEST, where), ("x,y,z",), f"{where}: {path}")
    else:
        try:
            size = path.stat().st_size if path.is_file() else _LARGEST + 1
            points = np.load(path, allow_pickle=False) if size <= _LARGEST else None
        except (ValueError, EOFError, OSError) as error:
            raise ConfigError(f"{where}: {path}: {error}; give an .npy or .csv with an array (n, 3)") from None
    if getattr(points, "ndim", 0) != 2 or points.shape[1] != 3 or points.dtype.kind not in "fiu":
        shape = getattr(points, "shape", "none")
        raise ConfigError(f"{where}: {path}: no array (n, 3) of numbers in a file below {_LARGEST} bytes: {shape}")
    if len(points) > _MOST_POINTS:
        raise ConfigError(f"{where}: {path}: {len(points)} points; at most {_MOST_POINTS} are read: thin them out")
    return np.asarray(points, dtype=np.float64)
