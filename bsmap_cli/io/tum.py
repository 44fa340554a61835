"""Trajectories as text, `t x y z qx qy qz qw`, as the TUM benchmark and evo have them; stamps exact to the ns."""

from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from bsmap_cli.errors import BadInputError, MissingInputError
from bsmap_cli.io.artifact import Provenance, atomic_output
from bsmap_cli.model import Array, Trajectory


def write_tum(path: Path | str, trajectory: Trajectory, provenance: Provenance | None = None) -> None:
    """Write the poses of base_link in map, without their covariances; CannotWriteError where that fails."""
    lines = [f"# {provenance.to_line()}"] if provenance else []
    lines += [f"# poses: {len(trajectory.time_ns)}", "# t x y z qx qy qz qw"]
    half = trajectory.poses[:, 2] / 2
    rows = np.column_stack([trajectory.poses[:, :2], np.sin(half), np.cos(half)]) + 0.0  # no -0.0
    lines += [_line(t, row) for t, row in zip(trajectory.time_ns.tolist(), rows.tolist(), strict=True)]
    with atomic_output(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="ascii")


def _line(time_ns: int, row: list[float]) -> str:
    seconds, nanoseconds = divmod(time_ns, 1_000_000_000)
    x, y, qz, qw = row
    return f"{seconds}.{nanoseconds:09d} {x:.9f} {y:.9f} 0 0 0 {qz:.12f} {qw:.12f}"


def read_tum(path: Path | str) -> Trajectory:
    """Read planar poses of a TUM file: x, y and yaw; the covariances, which it does not hold, are zero.

    Raises
    ------
    MissingInputError
        There is no such file.
    BadInputError
        A line is not eight numbers, a quaternion is zero, or there is no pose.
    """
    times: list[int] = []
    rows: list[list[float]] = []
    for number, line in enumerate(_text(path).splitlines(), 1):
        if line.strip() and not line.startswith("#"):
            try:
                time_ns, row = _parse(line)
            except (ValueError, InvalidOperation) as error:
                raise BadInputError(f"{path}: line {number}: {error}; wanted t x y z qx qy qz qw") from error
            times.append(time_ns)
            rows.append(row)
    if not rows:
        raise BadInputError(f"{path}: holds no poses")
    values = np.array(rows)
    poses = np.column_stack([values[:, :2], _yaw(values[:, 3:])])
    return Trajectory(np.array(times, dtype=np.int64), poses, np.zeros((len(rows), 3, 3)))


def _text(path: Path | str) -> str:
    try:
        return Path(path).read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise MissingInputError(f"{path}: {error.strerror or error}") from error


def _parse(line: str) -> tuple[int, list[float]]:
    words = line.split()
    if len(words) != 8:
        raise ValueError(f"{len(words)} columns")
    row = [float(word) for word in words[1:]]
    if not np.all(np.isfinite(row)) or not any(row[3:]):
        raise ValueError("not a pose")
    return round(Decimal(words[0]) * 1_000_000_000), row


def _yaw(q: Array) -> Array:
    """Yaw (n,) of quaternions (n, 4) x, y, z, w of any length."""
    x, y, z, w = q.T
    return np.arctan2(2 * (w * z + x * y), w**2 + x**2 - y**2 - z**2)
