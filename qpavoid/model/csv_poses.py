"""Poses over time from a CSV file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin

from qpavoid.config.base import LARGEST
from qpavoid.config.files import read_text
from qpavoid.errors import ConfigError
from qpavoid.problem import Array

CSV_HEADERS = ("t,x,y,z", "t,x,y,z,qx,qy,qz,qw")
_LARGEST_CSV, _MOST_ROWS = 20_000_000, 100_000
"""Size of a CSV file [bytes] and number of its rows, at most; each row becomes a piece of a kilobyte."""


def read_table(text: str, headers: tuple[str, ...], where: str) -> Array:
    """Read the numbers (n, columns) below one of some headers of a CSV text.

    Raises:
        ConfigError: another header, or a row that is not of as many numbers; naming file, row and column.
    """
    header, *lines = text.splitlines() or [""]
    if header.replace(" ", "") not in headers:
        raise ConfigError(f"{where}: header is `{header:.40}`; the first line must be `{'` or `'.join(headers)}`")
    lines = [line for line in lines if line.strip()]
    columns = header.count(",") + 1
    if not lines:
        return np.zeros((0, columns))
    try:
        return np.loadtxt(lines, delimiter=",", comments=None, ndmin=2).reshape(len(lines), columns)
    except ValueError as error:
        raise ConfigError(f"{where}: {error}; give {columns} numbers a row, as the header `{header}`") from None


def read_poses(path: Path, initial: Array) -> tuple[list[float], list[Array], list[Array]]:
    """Read times [s], positions (3,) [m] and rotations (3, 3) of a file.

    Without quaternions, each rotation is `initial`.

    Raises:
        ConfigError: naming file and row.
    """
    table = read_table(read_text(path, _LARGEST_CSV, f"{path}: motion.path"), CSV_HEADERS, str(path))
    if not 2 <= len(table) <= _MOST_ROWS:
        raise ConfigError(f"{path}: {len(table)} rows of poses; give 2 to {_MOST_ROWS}, or use `type: fixed`")
    is_sane = np.all(np.abs(table) <= 10.0 * LARGEST, axis=1)  # False for NaN too; seconds of the calendar are 1.7e9
    norms = np.linalg.norm(np.where(is_sane[:, None], table[:, 4:], 1.0), axis=1)  # need not be 1: they are rounded
    for clause, is_bad in (
        ("not finite numbers of sane size", ~is_sane),
        ("times must increase", np.diff(table[:, 0], prepend=-np.inf) <= 0.0),
        ("the quaternion is zero; no turn is 0,0,0,1", (norms < 1e-6) & (table.shape[1] > 4)),
    ):
        if is_bad.any():
            raise ConfigError(f"{path}: row {int(np.argmax(is_bad)) + 1} of poses: {clause}; correct it")
    if table.shape[1] == 4:
        rotations = [initial] * len(table)
    else:
        rotations = [pin.Quaternion(row).toRotationMatrix() for row in table[:, 4:] / norms[:, None]]
    return table[:, 0].tolist(), list(table[:, 1:4]), rotations
