"""CSV tables of positions and poses: rows with x, y, z, and an orientation where there is one; other columns are kept.

Columns are known by their names, in any order and case. A position is ``x, y, z``; an orientation beside it is a
quaternion ``qx, qy, qz, qw``. Or a row holds a homogeneous matrix, ``m00`` to ``m23``, first the row, then the column:
``m03, m13, m23`` are the position.
"""

import csv
import io
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from mereo.io.errors import readable

POSITION = ("x", "y", "z")
QUATERNION = ("qx", "qy", "qz", "qw")
TURN = tuple(f"m{row}{column}" for row in range(3) for column in range(3))
SHIFT = tuple(f"m{row}3" for row in range(3))

DELIMITERS = ",;\t"

TOLERANCE = 1e-3
"""Largest difference of a matrix from a rotation, or of a quaternion's length from 1."""


@dataclass(frozen=True, eq=False)
class PoseTable:
    """Table of positions, or of poses.

    Attributes:
        header: names of all columns.
        rows: their texts.
        delimiter: between them.
        points: position of each row.
        rotations: orientation of each row, the pose's axes as columns; None where the table has none.
    """

    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    delimiter: str
    points: Float[np.ndarray, "n 3"]
    rotations: Float[np.ndarray, "n 3 3"] | None

    def at(self, points: Float[np.ndarray, "n 3"], rotations: Float[np.ndarray, "n 3 3"] | None) -> "PoseTable":
        """The table with other positions and orientations."""
        return replace(self, points=points, rotations=rotations)

    def text(self, factor: float = 1.0) -> str:
        """Content of a file: positions times ``factor``, and orientations; what other columns say stays."""
        columns = {_key(name): i for i, name in enumerate(self.header)}
        told = dict(zip(_position(columns), (factor * self.points).T, strict=True))
        if self.rotations is not None and QUATERNION[0] in columns:
            told |= dict(zip(QUATERNION, Rotation.from_matrix(self.rotations).as_quat().T, strict=True))
        elif self.rotations is not None:
            told |= dict(zip(TURN, self.rotations.reshape(-1, 9).T, strict=True))
        cells = np.array(self.rows, dtype=object).reshape(-1, len(self.header))
        for name, values in told.items():
            cells[:, columns[name]] = [f"{value:.10g}" for value in values]
        file = io.StringIO()
        writer = csv.writer(file, delimiter=self.delimiter, lineterminator="\n")
        writer.writerow(self.header)
        writer.writerows(cells.tolist())
        return file.getvalue()


def read_pose_table(path: Path) -> PoseTable:
    """Table of a CSV file, separated by commas, semicolons or tabs.

    Raises ``FileNotFoundError`` and ``ValueError``: columns are missing, a cell is no number, a row is too short or
    its orientation is none.
    """
    with readable(path, "table of points"):
        text = path.read_text(encoding="utf-8-sig")
        first = next((line for line in text.splitlines() if line.strip()), "")
        delimiter = max(DELIMITERS, key=first.count)
        reader = csv.reader(io.StringIO(text), delimiter=delimiter)
        lines = [(reader.line_num, row) for row in reader if any(cell.strip() for cell in row)]
        (_, header), *body = lines
        columns = {_key(name): i for i, name in enumerate(header)}
        position = _position(columns)
        turn = _orientation(columns)
        if not body:
            raise ValueError("it has a header and no row")
        for line, row in body:
            if len(row) != len(header):
                raise ValueError(f"line {line} has {len(row)} cells and the header {len(header)}")
        points = _numbers(body, columns, position)
        rotations = None if turn is None else _rotations(body, _numbers(body, columns, turn))
    return PoseTable(tuple(header), tuple(tuple(row) for _, row in body), delimiter, points, rotations)


Lines = list[tuple[int, list[str]]]
"""Number and cells of each line."""


def _key(name: str) -> str:
    return name.strip().lower()


def _position(columns: dict[str, int]) -> tuple[str, ...]:
    """Names of the columns that hold the position."""
    by_name, by_matrix = ({*names} <= columns.keys() for names in (POSITION, SHIFT))
    if by_name == by_matrix:
        found = "both" if by_name else "neither"
        raise ValueError(
            f"its columns are {', '.join(columns)}, with {found} of x, y, z and m03, m13, m23; it needs one of them"
        )
    return POSITION if by_name else SHIFT


def _orientation(columns: dict[str, int]) -> tuple[str, ...] | None:
    """Names of the columns that hold the orientation; None where there are none."""
    for names in (QUATERNION, TURN):
        missing = [name for name in names if name not in columns]
        if not missing:
            return names
        if len(missing) < len(names):
            raise ValueError(f"it has a column {next(n for n in names if n in columns)!r} but no {missing[0]!r}")
    return None


def _numbers(lines: Lines, columns: dict[str, int], names: tuple[str, ...]) -> Float[np.ndarray, "n k"]:
    """Values of some columns."""
    return np.array([[_number(line, row[columns[name]], name) for name in names] for line, row in lines])


def _number(line: int, cell: str, name: str) -> float:
    try:
        value = float(cell)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise ValueError(f"line {line} has {cell!r} in the column {name}, which is no finite number")
    return value


def _rotations(lines: Lines, values: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n 3 3"]:
    """Orientations by quaternions (four values) or matrices (nine)."""
    if values.shape[1] == len(QUATERNION):
        off = np.abs(np.linalg.norm(values, axis=1) - 1)
        result = Rotation.from_quat(np.where(off[:, None] < TOLERANCE, values, [0.0, 0.0, 0.0, 1.0])).as_matrix()
    else:
        result = values.reshape(-1, 3, 3)
        off = np.abs(result @ result.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
        off = np.where(np.linalg.det(result) > 0, off, np.inf)
    if (off >= TOLERANCE).any():
        raise ValueError(f"line {lines[int(np.argmax(off >= TOLERANCE))][0]} has an orientation that is no rotation")
    return result
