"""Poses over time from a CSV file."""

from __future__ import annotations

import csv
import io
import math
from pathlib import Path

import numpy as np
import pinocchio as pin

from qpavoid.config.base import LARGEST
from qpavoid.config.text import read_text
from qpavoid.errors import ConfigError
from qpavoid.problem import Array

CSV_HEADERS = ("t,x,y,z", "t,x,y,z,qx,qy,qz,qw")
_LARGEST_CSV, _MOST_ROWS = 20_000_000, 100_000
"""Size of a CSV file [bytes] and number of its rows, at most; each row becomes a piece of some kilobytes."""


def read_poses(path: Path, initial: Array) -> tuple[list[float], list[Array], list[Array]]:
    """Read times [s], positions (3,) [m] and rotations (3, 3) of a file.

    Without quaternions, each rotation is `initial`.

    Raises:
        ConfigError: naming file, line and column.
    """
    reader = csv.reader(io.StringIO(read_text(path, _LARGEST_CSV, f"{path}: motion.path")))
    rows: list[tuple[int, list[str]]] = []
    try:
        for row in reader:
            if row:
                rows.append((reader.line_num, [cell.strip() for cell in row]))
            if len(rows) > _MOST_ROWS + 1:
                raise ConfigError(f"{path}: more than {_MOST_ROWS} rows; give fewer poses, it is linear in between")
    except csv.Error as error:
        raise ConfigError(f"{path}, line {reader.line_num}: {error}; correct the cell") from None
    header = ",".join(rows[0][1]) if rows else ""
    if header not in CSV_HEADERS:
        expected = "` or `".join(CSV_HEADERS)
        raise ConfigError(f"{path}: header is `{header}`; the first line must be `{expected}`")
    if len(rows) < 3:
        raise ConfigError(f"{path}: {len(rows) - 1} row(s) of poses; give at least two, or use `type: fixed`")
    columns = header.split(",")
    times: list[float] = []
    positions: list[Array] = []
    rotations: list[Array] = []
    for line, cells in rows[1:]:
        where = f"{path}, line {line}"
        if len(cells) != len(columns):
            raise ConfigError(f"{where}: {len(cells)} cells; give {len(columns)}, as the header `{header}`")
        values = [_number(cell, f"{where}, {column}") for cell, column in zip(cells, columns, strict=True)]
        t, position, quaternion = values[0], values[1:4], values[4:]
        if times and t <= times[-1]:
            raise ConfigError(f"{where}, t: {t} comes after {times[-1]}; times must increase")
        times.append(t)
        positions.append(np.array(position))
        rotations.append(_unit_quaternion_matrix(quaternion, where) if quaternion else initial)
    return times, positions, rotations


def _number(cell: str, where: str) -> float:
    try:
        value = float(cell)
    except ValueError:
        value = math.nan
    if not abs(value) <= LARGEST * 10.0:  # seconds of the calendar are 1.7e9
        raise ConfigError(f"{where}: `{cell}` is not a finite number of sane size; correct the cell")
    return value


def _unit_quaternion_matrix(quaternion: list[float], where: str) -> Array:
    """Return the rotation (3, 3) of (qx, qy, qz, qw).

    It need not have unit length: files hold rounded numbers.
    """
    norm = math.hypot(*quaternion)
    if norm < 1e-6:
        raise ConfigError(f"{where}, qx,qy,qz,qw: the quaternion is zero; no turn is 0,0,0,1")
    matrix: Array = pin.Quaternion(np.array(quaternion) / norm).toRotationMatrix()
    return matrix
