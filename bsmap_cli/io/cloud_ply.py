"""The artifact of `cloud`: a binary PLY with only the types that Open3D, CloudCompare and MeshLab all read.

    element vertex  double x y z                    metres, in map
                    int scan, int beam              the organised grid: scan in `scan` below, beam of the laser
                    double time                     seconds since `epoch_ns`
                    double cov_xx .. cov_zz         six terms of the point's covariance, metres squared
    element scan    double time x y theta           pose of base_link at each vertical scan
                    double cov_xx cov_xy cov_xt cov_yy cov_yt cov_tt
                    double mode1_x mode1_y mode1_t ..  what the poses' errors have in common, see `Trajectory`

Comments hold one JSON object each, broken where longer than other readers take: `bsmap-provenance:`, and
`bsmap-cloud:` with format version, `epoch_ns` (int), mount (4 x 4, T_base_laser), angles and noise of the laser,
`modes` (int, or null where it is not known what the errors have in common).
"""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement, PlyParseError

from bsmap_cli.errors import BadInputError, MissingInputError
from bsmap_cli.io.artifact import Provenance, atomic_output, join_comments, split_comment
from bsmap_cli.io.completeness import ply_size
from bsmap_cli.model import Array, IntArray, PointCloud

VERSION = 2
_POINT = ("xx", "xy", "xz", "yy", "yz", "zz")
_POSE = ("xx", "xy", "xt", "yy", "yt", "tt")
VERTEX = [
    *((name, "<f8") for name in "xyz"),
    *((name, "<i4") for name in ("scan", "beam")),
    ("time", "<f8"),
    *((f"cov_{pair}", "<f8") for pair in _POINT),
]
SCAN = [(name, "<f8") for name in ("time", "x", "y", "theta", *(f"cov_{pair}" for pair in _POSE))]
_UPPER = np.triu_indices(3)
_LASER_FIELDS = ("angle_min", "angle_increment", "range_sigma", "angle_sigma")


def write_cloud(path: Path | str, cloud: PointCloud, provenance: Provenance | None = None) -> None:
    """Write the artifact of `cloud`; CannotWriteError where that fails."""
    epoch = int(np.min(np.concatenate([cloud.scan_time_ns, cloud.time_ns]), initial=2**63 - 1))
    facts = {"version": VERSION, "frame": "map", "epoch_ns": epoch, "mount": cloud.mount.tolist()}
    facts |= {name: float(getattr(cloud, name)) for name in _LASER_FIELDS}
    facts["modes"] = None if cloud.scan_pose_modes is None else cloud.scan_pose_modes.shape[2]
    comments = [*split_comment(provenance.to_line())] if provenance else []
    comments += split_comment("bsmap-cloud:" + json.dumps(facts, separators=(",", ":")))
    elements = [
        PlyElement.describe(_vertices(cloud, epoch), "vertex"),
        PlyElement.describe(_scans(cloud, epoch), "scan"),
    ]
    with atomic_output(path) as temporary:
        PlyData(elements, text=False, byte_order="<", comments=comments).write(str(temporary))


def _vertices(cloud: PointCloud, epoch: int) -> NDArray[Any]:
    rows = np.zeros(len(cloud.points), dtype=VERTEX)
    for k, name in enumerate("xyz"):
        rows[name] = cloud.points[:, k]
    rows["scan"], rows["beam"], rows["time"] = cloud.scan_index, cloud.beam_index, _seconds(cloud.time_ns, epoch)
    for k, pair in enumerate(_POINT):
        rows[f"cov_{pair}"] = cloud.covariances[:, k]
    return rows


def _scans(cloud: PointCloud, epoch: int) -> NDArray[Any]:
    modes = np.zeros((len(cloud.scan_time_ns), 3, 0)) if cloud.scan_pose_modes is None else cloud.scan_pose_modes
    rows = np.zeros(len(modes), dtype=_scan_type(modes.shape[2]))
    rows["time"] = _seconds(cloud.scan_time_ns, epoch)
    for k, name in enumerate(("x", "y", "theta")):
        rows[name] = cloud.scan_poses[:, k]
    for pair, i, j in zip(_POSE, *_UPPER, strict=True):
        rows[f"cov_{pair}"] = cloud.scan_pose_covariances[:, i, j]
    for name, column in zip(_mode_names(modes.shape[2]), modes.swapaxes(1, 2).reshape(len(modes), -1).T, strict=True):
        rows[name] = column
    return rows


def _mode_names(modes: int) -> list[str]:
    return [f"mode{number}_{axis}" for number in range(1, modes + 1) for axis in "xyt"]


def _scan_type(modes: int) -> list[tuple[str, str]]:
    return [*SCAN, *((name, "<f8") for name in _mode_names(modes))]


def _seconds(time_ns: IntArray, epoch: int) -> Array:
    """Seconds since `epoch`; exact to the nanosecond for the first 50 days."""
    return np.asarray((time_ns - epoch) / 1e9)


def read_cloud(path: Path | str) -> PointCloud:
    """Read the artifact of `cloud`.

    Raises
    ------
    MissingInputError
        There is no such file.
    BadInputError
        It is not a cloud of `bsmap cloud`, of another version, cut, or holds what makes no sense.
    """
    facts = _checked_facts(Path(path))
    try:
        elements = PlyData.read(str(path))
        vertex, scan = elements["vertex"].data, elements["scan"].data
        vertex = vertex[[name for name, _ in VERTEX]]
        scan = scan[[name for name, _ in _scan_type(facts["modes"] or 0)]]
    except (PlyParseError, KeyError, ValueError) as error:
        raise BadInputError(f"{path}: is damaged ({error}); run `bsmap cloud` again") from error
    _check_values(path, vertex, scan)
    covariances = np.zeros((len(scan), 3, 3))
    for pair, i, j in zip(_POSE, *_UPPER, strict=True):
        covariances[:, i, j] = covariances[:, j, i] = scan[f"cov_{pair}"]
    return PointCloud(
        points=np.column_stack([vertex[name] for name in "xyz"]),
        scan_index=vertex["scan"].astype(np.int32),
        beam_index=vertex["beam"].astype(np.int32),
        time_ns=_nanoseconds(vertex["time"], facts["epoch_ns"]),
        covariances=np.column_stack([vertex[f"cov_{pair}"] for pair in _POINT]),
        scan_time_ns=_nanoseconds(scan["time"], facts["epoch_ns"]),
        scan_poses=np.column_stack([scan[name] for name in ("x", "y", "theta")]),
        scan_pose_covariances=covariances,
        mount=np.array(facts["mount"], dtype=float),
        scan_pose_modes=None if facts["modes"] is None else _modes(scan, facts["modes"]),
        **{name: facts[name] for name in _LASER_FIELDS},
    )


def _modes(scan: NDArray[Any], modes: int) -> Array:
    """(m, 3, k)"""
    columns = np.array([scan[name] for name in _mode_names(modes)]).reshape(modes, 3, len(scan))
    return columns.transpose(2, 1, 0)


def _nanoseconds(seconds: Array, epoch: int) -> IntArray:
    return np.rint(seconds * 1e9).astype(np.int64) + epoch


def _checked_facts(path: Path) -> dict[str, Any]:
    """The object of the comment `bsmap-cloud:`, after a check that the file is whole."""
    try:
        size = path.stat().st_size
        with open(path, "rb") as file:
            head = file.read(65536)
    except OSError as error:
        raise MissingInputError(f"{path}: {error.strerror or error}") from error
    if not head.startswith(b"ply"):
        raise BadInputError(f"{path}: is not a PLY file; wanted a cloud of `bsmap cloud`")
    found = re.search(r"^comment bsmap-cloud:(.*)$", join_comments(head.decode("latin-1")), re.MULTILINE)
    if found is None:
        raise BadInputError(f"{path}: is a PLY file, but no cloud of `bsmap cloud`, for it has no scan order")
    wanted = ply_size(head)
    if wanted != size:
        raise BadInputError(
            f"{path}: was cut: {size} bytes, wanted {wanted or 'a whole header'}; run `bsmap cloud` again"
        )
    facts: dict[str, Any] = json.loads(found.group(1))
    if facts["version"] != VERSION:
        raise BadInputError(
            f"{path}: is of version {facts['version']}, this bsmap reads {VERSION}; run `bsmap cloud` again"
        )
    return facts


def _check_values(path: Path | str, vertex: NDArray[Any], scan: NDArray[Any]) -> None:
    for element, rows in (("vertex", vertex), ("scan", scan)):
        for name in rows.dtype.names or ():
            if bad := int(np.count_nonzero(~np.isfinite(rows[name]))):
                raise BadInputError(f"{path}: {bad} values of {element} {name} are not finite; run `bsmap cloud` again")
    if len(vertex) and (vertex["scan"].min() < 0 or vertex["scan"].max() >= len(scan)):
        raise BadInputError(
            f"{path}: points of scans {vertex['scan'].min()} to {vertex['scan'].max()}, but there are {len(scan)} scans"
        )
