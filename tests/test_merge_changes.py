"""What moved between two surveys is told, in the artifact, by the command and in the picture, and nothing else is."""

from dataclasses import replace

import numpy as np
import pytest
from commands import bsmap
from face_maps import boxed, cupboard, map_of, plate, room, with_poses
from scenes import true_slam_map

from bsmap_cli.cloud import make_cloud
from bsmap_cli.fit import fit_surfaces
from bsmap_cli.io.surfaces_json import read_surfaces, write_surfaces
from bsmap_cli.merge import merge_surfaces
from bsmap_cli.params import CloudParams, FitParams, MergeParams, SimulateParams
from bsmap_cli.simulate import SCENES, simulate_scene
from bsmap_cli.simulate.geometry import carve, solid
from bsmap_cli.simulate.geometry import room as hollow


def moved(surface_map):
    return [d for d in surface_map.decisions if d.outcome == "moved"]


def with_pieces(data_set, *pieces):
    """The empty room with pieces."""
    made = room(data_set, extra=False)
    return replace(made, surfaces=(*made.surfaces, *with_poses(map_of(*pieces)).surfaces))


def test_box_that_was_carried_away_is_told_where_it_stood_and_where_it_stands():
    old, new = (with_pieces(name, *cupboard(name, x, 4.0)) for name, x in (("set-01", 1.0), ("set-02", 3.5)))
    result = merge_surfaces([old, new], MergeParams())
    assert {d.first for d in moved(result)} == {f"set-0{k}/{side}" for k in (1, 2) for side in ("front", "side")}
    assert all(d.figures["share"] > 0.5 for d in moved(result))
    assert {"set-01/front", "set-02/front"} <= {s.name for s in result.surfaces}


def test_panel_that_slid_along_its_wall_is_told():
    """It hid the wall 6 cm behind it, which the other survey saw."""

    def panel(name, x):
        return plate(f"{name}/panel", (x, 3.94, 0.5), (1.2, 0.0, 0.0), (0.0, 0.0, 1.0), (3.0, 2.0))

    result = merge_surfaces([with_pieces("set-01", panel("set-01", 1.0)), with_pieces("set-02", panel("set-02", 3.0))],
                            MergeParams())  # fmt: skip
    assert {d.first for d in moved(result)} == {"set-01/panel", "set-02/panel"}


def leaf(data_set, angle):
    """Door leaf, 0.9 m wide, its hinge 6 cm before the wall y = 4, turned out of the wall by an angle."""
    along = 0.9 * np.array([np.cos(angle), -np.sin(angle), 0.0])
    return plate(f"{data_set}/leaf", (2.0, 3.94, 0.05), tuple(along), (0.0, 0.0, 1.9), (3.0, 2.0))


@pytest.mark.parametrize("degrees", [4.0, 15.0, 90.0])
def test_door_leaf_that_was_turned_is_told_and_not_averaged(degrees):
    leaves = leaf("set-01", 0.0), leaf("set-02", np.radians(degrees))
    maps = [with_pieces(one.data_sets[0], one) for one in leaves]
    result = merge_surfaces(maps, MergeParams())
    assert {name for d in moved(result) for name in (d.first, d.second) if name} == {one.name for one in leaves}
    kept = {s.name: s for s in result.surfaces}
    for one in leaves:
        np.testing.assert_allclose(kept[one.name].control_points, one.control_points, atol=1e-4)


def test_what_nobody_else_looked_at_is_not_told():
    """A second room that one survey saw, a cupboard in a corner where the other one saw no floor, and one high up."""
    second = boxed("set-01", (6.2, 0.0, 0.0), (9.0, 4.0, 2.5)).surfaces
    corner = boxed("set-02", (0.0, 0.0, 0.0), (6.0, 2.5, 2.5), ("floor", "south", "west"))
    board = plate("set-01/board", (2.0, 1.0, 2.0), (1.0, 0.0, 0.0), (0.0, 0.0, 0.3), (3.0, 2.0))
    one = with_pieces("set-01", *cupboard("set-01", 1.0, 4.0), board)
    far = tuple(replace(s, name=f"far/{s.name[7:]}", data_sets=("far",)) for s in second)
    far = tuple(
        replace(s, covariance=replace(s.covariance, pose=(replace(s.covariance.pose[0], data_set="far"),))) for s in far
    )
    one = map_of(*one.surfaces, *with_poses(map_of(*far)).surfaces, creases=one.creases)
    assert moved(merge_surfaces([one, with_poses(corner)], MergeParams())) == []


def test_same_room_again_tells_nothing():
    maps = [room(f"set-0{k}", 0.002, k) for k in (1, 2, 3)]
    assert moved(merge_surfaces(maps, MergeParams())) == []
    assert moved(merge_surfaces([merge_surfaces(maps[:2], MergeParams()), maps[2]], MergeParams())) == []


def test_command_tells_what_moved_and_draws_it(tmp_path):
    for name, x in (("set-01", 1.0), ("set-02", 3.5)):
        write_surfaces(tmp_path / f"{name}.surfaces.json", with_pieces(name, *cupboard(name, x, 4.0)))
    inputs = [tmp_path / f"set-0{k}.surfaces.json" for k in (1, 2)]
    done = bsmap("merge", *inputs, "--plot", tmp_path / "a.svg")
    assert done.code == 0, done
    assert len([line for line in done.err.splitlines() if line.startswith("moved: set-0")]) == 4
    assert "moved: set-01/front (1.80 m2): it moved, came or went" in done.err
    assert ", moved 4" in done.err
    assert len(moved(read_surfaces(tmp_path / "set-01.map.json"))) == 4
    assert "moved: 4" in bsmap("info", tmp_path / "set-01.map.json").out
    picture = (tmp_path / "a.svg").read_text()
    write_surfaces(inputs[1], with_pieces("set-02", *cupboard("set-02", 1.0, 4.0)))
    assert "moved 0" in bsmap("merge", *inputs, "--plot", tmp_path / "b.svg").err
    red = "stroke: #d62728; stroke-width: 2"
    assert (picture.count(red), (tmp_path / "b.svg").read_text().count(red)) == (4, 0)


def furnished(chest):
    """The scene `room`, its chest of drawers at another place."""
    mesh = carve(
        [
            hollow(0.0, 7.0, 0.0, 5.5, 0.0, 3.0),
            hollow(5.3, 6.2, 5.5, 5.65, 0.0, 2.05),
            solid(3.0, 4.2, 0.0, 0.3, 0.0, 3.0),
            solid(0.0, 0.6, 3.6, 5.5, 0.0, 2.0),
            solid(*chest, 0.0, 0.9),
        ]
    )
    return SCENES["room"]()._replace(mesh=mesh)


@pytest.mark.slow
@pytest.mark.parametrize("shift", [0.05, 1.2])
def test_chest_that_moved_in_a_simulated_room_is_told_and_nothing_else(monkeypatch, shift):
    fitted = []
    for seed, y in enumerate((0.0, shift)):
        scene = furnished((6.3 - y / 2, 7.0 - y / 2, y, 1.6 + y))
        monkeypatch.setitem(SCENES, "room", lambda scene=scene: scene)
        simulation = simulate_scene("room", SimulateParams(seed=seed))
        fitted.append(fit_surfaces(make_cloud(true_slam_map(simulation), CloudParams()), FitParams()))
        monkeypatch.undo()
    found = moved(merge_surfaces(fitted, MergeParams()))
    assert found
    start = np.array([2.5, 1.8, 0.04])
    c, s = np.cos(start[2]), np.sin(start[2])
    surfaces = {s.name: s for s in fitted[0].surfaces} | {f"2.{s.name}": s for s in fitted[1].surfaces}
    for decision in found:
        x, y, z = surfaces[decision.first].control_points.reshape(-1, 3).mean(axis=0)
        at = start[0] + c * x - s * y, start[1] + s * x + c * y
        assert 5.5 < at[0] < 7.05
        assert -0.05 < at[1] < 3.0
        assert z < 1.0
