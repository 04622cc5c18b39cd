"""Poses over time from a CSV file."""

from __future__ import annotations

import csv
import io
import math
from itertools import islice
from pathlib import Path

import numpy as np
import pinocchio as pin

from qpavoid.config.base import LARGEST
from qpavoid.config.text import read_text
from qpavoid.errors import ConfigError
from qpavoid.problem import Array

CSV_HEADERS = ("t,x,y,z", "t,x,y,z,qx,qy,qz,qw")
_LARGEST_CSV, _MOST_ROWS = 20_000_000, 100_000
"""Size of a CSV file [bytes] and number of its rows, at most; each row becomes a piece of a kilobyte."""


def read_poses(path: Path, initial: Array) -> tuple[list[float], list[Array], list[Array]]:
    """Read times [s], positions (3,) [m] and rotations (3, 3) of a file.

    Without quaternions, each rotation is `initial`.

    Raises:
        ConfigError: naming file, line and column.
    """
    reader = csv.reader(io.StringIO(read_text(path, _LARGEST_CSV, f"{path}: motion.path")))
    cells_of_lines = ((reader.line_num, [cell.strip() for cell in row]) for row in reader if row)
    try:
        rows = list(islice(cells_of_lines, _MOST_ROWS + 2))
    except csv.Error as error:
        raise ConfigError(f"{path}, line {reader.line_num}: {error}; correct the cell") from None
    if len(rows) > _MOST_ROWS + 1:
        raise ConfigError(f"{path}: more than {_MOST_ROWS} rows; give fewer poses, it is linear in between")
    header = ",".join(rows[0][1]) if rows else ""
    if header not in CSV_HEADERS:
        expected = "` or `".join(CSV_HEADERS)
        raise ConfigError(f"{path}: header is `{header}`; the first line must be `{expected}`")
    if len(rows) < 3:
        raise ConfigError(f"{path}: {len(rows) - 1} row(s) of poses; give at least two, or use `type: fixed`")
    columns = header.split(",")
    times, positions, rotations = list[float](), list[Array](), list[Array]()
    for line, cells in rows[1:]:
        where = f"{path}, line {line}"
        if len(cells) != len(columns):
            raise ConfigError(f"{where}: {len(cells)} cells; give {len(columns)}, as the header `{header}`")
        values = [_number(cell, f"{where}, {column}") for cell, column in zip(cells, columns, strict=True)]
        t, position, quaternion = values[0], np.array(values[1:4]), np.array(values[4:])
        if times and t <= times[-1]:
            raise ConfigError(f"{where}, t: {t} comes after {times[-1]}; times must increase")
        norm = np.linalg.norm(quaternion)  # need not be 1: files hold rounded numbers
        if len(quaternion) and norm < 1e-6:
            raise ConfigError(f"{where}, qx,qy,qz,qw: the quaternion is zero; no turn is 0,0,0,1")
        times.append(t)
        positions.append(position)
        rotations.append(pin.Quaternion(quaternion / norm).toRotationMatrix() if len(quaternion) else initial)
    return times, positions, rotations


def _number(cell: str, where: str) -> float:
    try:
        value = float(cell)
    except ValueError:
        value = math.nan
    if not abs(value) <= LARGEST * 10.0:  # seconds of the calendar are 1.7e9
        raise ConfigError(f"{where}: `{cell}` is not a finite number of sane size; correct the cell")
    return value
