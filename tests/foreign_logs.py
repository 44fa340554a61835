"""Real logs of formats that only the tests and benchmarks read, as model.ScanLog; all under ../shared/data/logs.

wean      lines `L x y theta xl yl thetal r1..r180 t` (laser with odometry) and `O ...`, centimetres, 180 degrees.
tinyslam  lines `t ? q1 q2 ...`, from column 25 on 683 ranges in mm of a Hokuyo URG-04LX; t in microseconds, q1 and q2
          ticks of the left and right wheel, 2,000 a turn. Wheel radius, half the axle and the laser's place ahead of it
          (0.077, 0.165, 0.145 m) are those of CoreSLAM's own test program.
dpslam    `Odometry x y theta` and `Laser 181 r1..r181` lines in turn, metres, no stamps: taken as 10 Hz.
"""

import gzip
from pathlib import Path

import numpy as np

from bsmap_cli.model import LaserScans, ScanLog

LOGS = Path(__file__).resolve().parents[2] / "shared" / "data" / "logs"
NO_RETURN = 50.0  # m
TICKS, WHEEL_RADIUS, HALF_AXLE = 2000, 0.077, 0.165


def read_wean(path: Path) -> ScanLog:
    """A log of wean, its own text format."""
    rows = np.array([line.split()[1:] for line in _lines(path) if line.startswith("L ")], dtype=float)
    odometry = np.column_stack([rows[:, :2] / 100, rows[:, 2]])
    beams = np.radians(np.arange(-90.0, 90.0))
    # The laser is told to be about 25 cm ahead of the robot's centre; the poses say exactly where.
    c, s = np.cos(rows[:, 2]), np.sin(rows[:, 2])
    ahead = c * (rows[:, 3] - rows[:, 0]) + s * (rows[:, 4] - rows[:, 1])
    return _log(rows[:, -1], rows[:, 6:-1] / 100, beams, float(np.median(ahead)) / 100, odometry)


def read_tinyslam(path: Path) -> ScanLog:
    """A log of tinyslam, by wheel ticks."""
    rows = np.array([line.split() for line in _lines(path)], dtype=float)
    ranges = rows[:, 24 : 24 + 683] / 1000
    ranges[ranges < 0.02] = np.nan  # 0 to 19 are error codes
    beams = (np.arange(683) - 341) * 2 * np.pi / 1024
    left, right = (np.diff(rows[:, k]) * 2 * np.pi * WHEEL_RADIUS / TICKS for k in (2, 3))
    way, turn = (left + right) / 2, (right - left) / (2 * HALF_AXLE)
    theta = np.r_[0.0, np.cumsum(turn)]
    heading = theta[:-1] + turn / 2
    xy = np.cumsum(np.column_stack([way * np.cos(heading), way * np.sin(heading)]), axis=0)
    odometry = np.column_stack([np.r_[np.zeros((1, 2)), xy], theta])
    return _log(rows[:, 0] * 1e-6, ranges, beams, 0.145, odometry)


def read_dpslam(path: Path) -> ScanLog:
    """A log of dpslam, at 10 Hz."""
    lines = [line.split() for line in _lines(path)]
    odometry = np.array([w[1:4] for w in lines if w[0] == "Odometry"], dtype=float)
    ranges = np.array([w[2 : 2 + int(w[1])] for w in lines if w[0] == "Laser"], dtype=float)
    beams = np.linspace(-np.pi / 2, np.pi / 2, ranges.shape[1])
    ranges[ranges > 8.0] = np.nan  # the log's "no return" is about 8.1
    return _log(0.1 * np.arange(len(ranges)), ranges, beams, 0.0, odometry)


def _lines(path: Path) -> list[str]:
    with gzip.open(path, "rt") as file:
        return [line for line in file if line.strip()]


def _log(seconds: np.ndarray, ranges: np.ndarray, beams: np.ndarray, ahead: float, odometry: np.ndarray) -> ScanLog:
    """Log of one laser `ahead` metres before base_link."""
    ranges = ranges.astype(np.float32)
    ranges[ranges >= NO_RETURN] = np.nan
    mount = np.eye(4)
    mount[0, 3] = ahead
    time_ns = np.rint(seconds * 1e9).astype(np.int64)
    scans = LaserScans(time_ns, ranges, beams[0], beams[1] - beams[0], 0.0, 0.02, NO_RETURN, mount, "laser", "/scan")
    return ScanLog(scans, odometry, None)


FOREIGN = {
    **{f"wean {k}": (read_wean, LOGS / f"wean/robotdata{k}.log.gz") for k in range(1, 6)},
    **{f"tinyslam {k}": (read_tinyslam, LOGS / f"tinyslam/exp{k}.dat.gz") for k in (1, 2)},
    "dpslam": (read_dpslam, LOGS / "dpslam/loop5.log.gz"),
}
