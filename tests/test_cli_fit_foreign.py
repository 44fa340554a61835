"""bsmap fit of clouds of other programs, by its entry point, and what takes its result."""

import numpy as np
import pytest
from commands import assert_refused, bsmap, process
from scattered import box_room, write_ply

from bsmap_cli.io.surfaces_json import read_surfaces


@pytest.fixture(scope="module")
def foreign(tmp_path_factory):
    """A room as a PLY file of another program. Not to be written to."""
    return write_ply(tmp_path_factory.mktemp("foreign") / "room.ply", box_room(20_000))


def test_it_warns_and_all_commands_take_the_result(foreign):
    done = process("fit", foreign)
    assert done.code == 0, done
    warnings = [line for line in done.err.splitlines() if "warning" in line]
    assert len(warnings) == 1
    assert f"{foreign} has no scan order: " in warnings[0]
    assert "scan order none" in done.err
    surfaces = foreign.with_name("room.surfaces.json")
    assert len(read_surfaces(surfaces).surfaces) == 6
    assert "up to date" in bsmap("fit", foreign).err
    assert "scan_order: none" in bsmap("info", surfaces).out
    assert bsmap("export", surfaces, "--to", foreign.with_name("room.glb")).code == 0
    assert bsmap("merge", surfaces).code == 0
    assert len(read_surfaces(foreign.with_name("room.map.json")).surfaces) == 6


def test_what_it_refuses(foreign, tmp_path):
    output = tmp_path / "never.json"
    assert_refused(bsmap("fit", foreign, "--method", "paper", "-o", output), 2, "needs scan lines")
    plot = tmp_path / "never.png"
    assert_refused(bsmap("fit", foreign, "--plot", plot, "-o", output), 2, "has no scan order, and --plot")
    cut = tmp_path / "cut.ply"
    cut.write_bytes(foreign.read_bytes()[:-7])
    assert_refused(bsmap("fit", cut, "-o", output), 65, "cut.ply: was cut")
    few = write_ply(tmp_path / "few.ply", np.eye(3))
    assert_refused(bsmap("fit", few, "-o", output), 65, "few.ply: has 3 points")
    nan = write_ply(tmp_path / "nan.ply", np.full((40, 3), np.nan))
    assert_refused(bsmap("fit", nan, "-o", output), 65, "nan.ply: 40 points are not finite")
    assert not output.exists()
    assert not plot.exists()
