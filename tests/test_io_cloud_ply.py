"""The artifact of `cloud`: exact and back, readable by others, refusals."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData

from bsmap_cli import open3d_loader
from bsmap_cli.errors import BadInputError, MissingInputError
from bsmap_cli.io.artifact import Provenance, read_provenance
from bsmap_cli.io.cloud_ply import read_cloud, write_cloud
from bsmap_cli.io.completeness import is_complete
from bsmap_cli.model import PointCloud

START = 1_700_000_000_123_456_789


def cloud(n: int = 200, m: int = 7) -> PointCloud:
    rng = np.random.default_rng(5)
    half = rng.normal(size=(m, 3, 3))
    scan = np.sort(rng.integers(0, m, n)).astype(np.int32)
    times = START + np.cumsum(rng.integers(1, 2**43, m))
    return PointCloud(
        points=rng.normal(size=(n, 3)),
        scan_index=scan,
        beam_index=np.arange(n, dtype=np.int32),
        time_ns=times[scan] + np.arange(n),
        covariances=rng.normal(size=(n, 6)),
        scan_time_ns=times,
        scan_poses=rng.normal(size=(m, 3)),
        scan_pose_covariances=half @ half.swapaxes(1, 2) / 2 + np.swapaxes(half @ half.swapaxes(1, 2), 1, 2) / 2,
        mount=np.array([[1.0, 0, 0, 0.1], [0, 0, -1, 0], [0, 1, 0, 1 / 3], [0, 0, 0, 1]]),
        angle_min=-2.3561944901923448,
        angle_increment=1 / 3,
        range_sigma=0.01,
        angle_sigma=0.0005,
        scan_pose_modes=rng.normal(size=(m, 3, 5)),
    )


@pytest.mark.parametrize("n", [200, 0])
def test_cloud_comes_back_to_the_last_bit(tmp_path: Path, n: int) -> None:
    made = cloud(n)
    write_cloud(tmp_path / "a.cloud.ply", made)
    read = read_cloud(tmp_path / "a.cloud.ply")
    for name, value in vars(made).items():
        np.testing.assert_array_equal(getattr(read, name), value, err_msg=name)
        assert np.asarray(getattr(read, name)).dtype == np.asarray(value).dtype, name


@pytest.mark.parametrize("modes", [None, np.zeros((7, 3, 0))])
def test_unknown_correlation_is_not_none_at_all(tmp_path: Path, modes: np.ndarray | None) -> None:
    write_cloud(tmp_path / "a.cloud.ply", replace(cloud(), scan_pose_modes=modes))
    read = read_cloud(tmp_path / "a.cloud.ply").scan_pose_modes
    np.testing.assert_array_equal(read, modes)
    assert np.shape(read) == np.shape(modes)


def test_same_cloud_same_bytes_and_long_provenance_in_short_lines(tmp_path: Path) -> None:
    inputs = tuple((f"log{i}.mcap", "0" * 64) for i in range(30))
    made = Provenance("cloud", "0.1.0", {"range_max": "inf"}, inputs, "c" * 56, {"points": 200})
    for name in ("a.ply", "b.ply"):
        write_cloud(tmp_path / name, cloud(), made)
    content = (tmp_path / "a.ply").read_bytes()
    assert content == (tmp_path / "b.ply").read_bytes()
    assert read_provenance(tmp_path / "a.ply") == made
    header = content[: content.index(b"end_header")]
    assert max(map(len, header.split(b"\n"))) < 500


def test_only_types_that_all_programs_read(tmp_path: Path) -> None:
    write_cloud(tmp_path / "a.ply", cloud())
    header = (tmp_path / "a.ply").read_bytes().split(b"end_header")[0].decode()
    assert set(re.findall(r"^property (\w+)", header, re.MULTILINE)) == {"double", "int"}
    assert re.findall(r"^element (\w+) (\d+)$", header, re.MULTILINE) == [("vertex", "200"), ("scan", "7")]


def test_open3d_reads_the_points(tmp_path: Path) -> None:
    o3d = open3d_loader.load()
    inputs = tuple((f"log{i}.mcap", "0" * 64) for i in range(30))
    made = Provenance("cloud", "0.1.0", {}, inputs, "c" * 56, {})
    write_cloud(tmp_path / "a.ply", cloud(), made)
    points = np.asarray(o3d.io.read_point_cloud(str(tmp_path / "a.ply")).points)
    np.testing.assert_array_equal(points, cloud().points)


def test_cut_cloud_is_refused_with_both_sizes(tmp_path: Path) -> None:
    path = tmp_path / "a.cloud.ply"
    write_cloud(path, cloud())
    content = path.read_bytes()
    assert is_complete(path)
    for size in (len(content) - 1, len(content) // 2, content.index(b"end_header") + 11):
        path.write_bytes(content[:size])
        assert not is_complete(path)
        with pytest.raises(BadInputError, match=rf"was cut: {size} bytes, wanted {len(content)}; run `bsmap cloud`"):
            read_cloud(path)
    path.write_bytes(content[: content.index(b"element vertex")])
    with pytest.raises(BadInputError, match=r"was cut: .* wanted a whole header"):
        read_cloud(path)


def test_what_is_no_cloud_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    with pytest.raises(MissingInputError, match="No such file"):
        read_cloud(path)
    path.write_bytes(b"")
    with pytest.raises(BadInputError, match="is not a PLY file"):
        read_cloud(path)
    path.write_bytes(b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n")
    with pytest.raises(BadInputError, match="no cloud of `bsmap cloud`, for it has no scan order"):
        read_cloud(path)


def test_values_that_make_no_sense_are_refused(tmp_path: Path) -> None:
    path, made = tmp_path / "a.ply", cloud()
    points = made.points.copy()
    points[3, 1] = np.nan
    write_cloud(path, replace(made, points=points))
    with pytest.raises(BadInputError, match="1 values of vertex y are not finite"):
        read_cloud(path)
    write_cloud(path, replace(made, scan_index=made.scan_index + np.int32(1)))
    with pytest.raises(BadInputError, match="points of scans 1 to 7, but there are 7 scans"):
        read_cloud(path)


def test_other_version_or_missing_property_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    write_cloud(path, cloud())
    content = path.read_bytes()
    path.write_bytes(content.replace(b'{"version":2,', b'{"version":9,'))
    with pytest.raises(BadInputError, match="is of version 9, this bsmap reads 2"):
        read_cloud(path)
    path.write_bytes(content.replace(b"property double theta", b"property double thetb"))
    with pytest.raises(BadInputError, match=r"is damaged \(.*theta"):
        read_cloud(path)


def test_documented_facts(tmp_path: Path) -> None:
    write_cloud(tmp_path / "a.ply", cloud())
    comments = "".join(PlyData.read(str(tmp_path / "a.ply")).comments).replace("bsmap+:", "")
    facts = json.loads(comments.removeprefix("bsmap-cloud:"))
    assert facts["epoch_ns"] == cloud().time_ns.min()
    assert np.shape(facts["mount"]) == (4, 4)
