"""Jumps: what stands before a wall and the wall behind it are two faces, whatever surface can be laid through both."""

import numpy as np
import pytest
from face_scenes import passing_set

from bsmap_cli.fit.beams import make_grid
from bsmap_cli.fit.blocks import Blocks
from bsmap_cli.fit.context import make_context
from bsmap_cli.fit.division import _seen_from_both_sides
from bsmap_cli.fit.heights import CylinderBase, HeightField, flat_knots
from bsmap_cli.fit.lowmodels import fit_plane_frame, sums_of
from bsmap_cli.fit.pieces import find_pieces
from bsmap_cli.fit.unions import _Region, _same_side, low_order_cost
from bsmap_cli.simulate.geometry import arc, carve, join, room, upright

PILLAR, RADIUS, WALL = np.array([0.95, 1.9]), 0.25, 3.2


@pytest.fixture(scope="module")
def context():
    """Pieces of 60 scans along a room, in the middle of which a round pillar hides one wall."""
    pillar = upright(arc(tuple(PILLAR), RADIUS, np.pi, -np.pi, np.radians(1.0)), 0.0, 2.6)
    place = passing_set(join([carve([room(-6.0, 8.0, -1.2, WALL, 0.0, 2.6)]), pillar]), scans=60)
    grid = make_grid(place.cloud, np.arange(60))
    return make_context(grid, find_pieces(grid))


def those_on(context, distance):
    """Pieces all blocks of which lie where the `distance` (n,) is nearly nothing."""
    near = np.abs(distance) < 0.05
    owner = context.blocks.owner
    return np.flatnonzero(np.bincount(owner, near) == np.bincount(owner))


def test_what_stands_before_a_wall_is_parted_from_it_but_not_from_itself(context):
    points = context.blocks.points
    before = set(those_on(context, np.hypot(*(points[:, :2] - PILLAR).T) - RADIUS).tolist())
    wall = set(those_on(context, points[:, 1] - WALL).tolist())
    assert len(before) >= 10
    parted = [(k, other) for k in before for other in context.parted[k]]
    assert any(other in wall for _, other in parted)
    assert not any(other in before for _, other in parted)
    assert not any(other in wall for k in wall for other in context.parted[k])
    row = context.pieces.row
    assert not any(other in wall and abs(row[other] - row[k]) == 1 for k in before for other in context.neighbours[k])
    assert all(before & set(context.neighbours[k]) for k in before)


def quarter_seen(from_inside, seed=0):
    """Blocks of a quarter of an upright cylinder of 1 m about the map's z, beams from inside it or from far outside."""
    rng = np.random.default_rng(seed)
    angle = rng.uniform(0.0, 0.5 * np.pi, 200) + np.pi * from_inside
    out = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(200)])
    points = out + np.column_stack([np.zeros((200, 2)), rng.uniform(0.0, 2.0, 200)]) + 0.002 * rng.normal(size=(200, 3))
    row = np.repeat(np.arange(20), 10)
    return Blocks(points, out if from_inside else -out, np.full(200, 8.0), row, np.arange(200.0), row)


def region_of(*parts):
    blocks = Blocks(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))
    frame = fit_plane_frame(blocks)
    box = np.array([blocks.points.min(axis=0), blocks.points.max(axis=0)])
    low = low_order_cost(blocks, frame, 0.002)
    return _Region((0,), blocks, frame, sums_of(frame, blocks, 0.002), low.cost, box, low)


def test_a_cylinder_is_seen_from_inside_or_from_outside_but_not_both():
    for inside in (False, True):
        alike = region_of(quarter_seen(inside), quarter_seen(inside, 1))
        assert alike.low.is_round
        assert _same_side(alike)
    both = region_of(quarter_seen(True), quarter_seen(False))
    assert both.low.is_round
    assert not _same_side(both)


def test_a_field_over_a_cylinder_that_beams_meet_from_both_sides_is_told():
    base = CylinderBase(np.zeros(2), 1.0, 0.0)
    field = HeightField(base, np.array([-np.pi, 0.0]), np.array([np.pi, 2.0]), flat_knots(), np.zeros((2, 2)))
    inside, outside = quarter_seen(True), quarter_seen(False)
    for one in (inside, outside):
        assert not _seen_from_both_sides(field, one.points, one.directions)
    points, directions = (
        np.vstack([getattr(one, name) for one in (inside, outside)]) for name in ("points", "directions")
    )
    assert _seen_from_both_sides(field, points, directions)
