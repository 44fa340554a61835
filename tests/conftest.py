"""Artifacts that the tests of the commands share."""

from pathlib import Path

import pytest
from commands import bsmap
from scenes import first_scans, simulated

from bsmap_cli.io.log import write_scans
from bsmap_cli.io.mesh_ply import write_mesh
from bsmap_cli.io.tum import write_tum

SCANS = 26
"""Of the room: one translation of 20 scans and the begin of a turn."""


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with a short log.mcap, its truth, and all that `bsmap run` makes of it. Not to be written to."""
    folder = tmp_path_factory.mktemp("made")
    write_short_log(folder / "log.mcap")
    simulation = simulated("room")
    write_tum(folder / "log.truth.tum", simulation.truth)
    write_mesh(folder / "log.truth.ply", simulation.vertices, simulation.triangles)
    done = bsmap("run", folder / "log.mcap")
    assert done.code == 0, done
    return folder


@pytest.fixture(scope="session")
def short_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short log.mcap alone. Not to be written to."""
    path = tmp_path_factory.mktemp("short") / "log.mcap"
    write_short_log(path)
    return path


def write_short_log(path: Path) -> None:
    simulation = simulated("room")
    log = first_scans(simulation.log, SCANS)
    assert log.vertical is not None
    keep = simulation.odometry_time_ns <= log.horizontal.time_ns[-1] + 100_000_000
    write_scans(path, log.horizontal, log.vertical, simulation.odometry_time_ns[keep], simulation.odometry_poses[keep])
