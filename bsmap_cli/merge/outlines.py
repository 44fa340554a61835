"""Outlines of joined faces: corners at creases brought onto the surfaces that now meet there, regions united, creases
found again along the new outline, and each crease made one line that both faces refer to."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import shapely

from bsmap_cli.core.bspline import evaluate_surface
from bsmap_cli.core.polygons import simplify
from bsmap_cli.fit.heights import HeightField, evaluate, offset
from bsmap_cli.merge.regions import Region, loops_of, region_of, united
from bsmap_cli.model import Array, BSplineSurface, Crease, TrimLoop

TOLERANCE = 0.001
"""Metres by which a simplified outline may leave the union."""
FINE = 0.03
"""Metres between points of a side that is laid on a curved surface, before it is simplified."""
ALONG = 0.003
"""Metres from a crease within which a side of the new outline runs along it."""
FARTHEST = 0.05
"""Metres by which a corner is moved at most."""
APART = 0.02
"""Metres between two pieces of one crease."""
STRAIGHT = 0.005
"""Metres by which a crease leaves its straight line at most, to be joined with others of the same two faces."""

FacePair = tuple[int, int]


class Member(NamedTuple):
    """Loops of one face of a data set in map: corners (k, 3), and the faces of the map that meet in each side."""

    corners: list[Array]
    sides: list[list[FacePair | None]]


class Outline(NamedTuple):
    """Loops (k, 3) of a face of the map, corners on its surface, and which faces meet in each side (or None)."""

    loops: list[Array]
    sides: list[list[FacePair | None]]


def member_of(surface: BSplineSurface, pairs: Sequence[FacePair | None]) -> Member:
    """Loops of a surface; pairs : of each crease of the map."""
    corners = [evaluate_surface(surface, *np.clip(loop.parameters, 0.0, 1.0).T) for loop in surface.trims]
    sides = [[pairs[c] if c >= 0 else None for c in loop.creases.tolist()] for loop in surface.trims]
    return Member(corners, sides)


def onto(fields: Sequence[HeightField], points: Array) -> Array:
    """Points (n, 3) moved the shortest way onto all surfaces at once; those that would go far stay."""
    out = points.copy()
    for _ in range(4):
        found = [offset(field, out) for field in fields]
        heights = np.stack([h for h, _ in found], axis=1)
        normals = np.stack([n for _, n in found], axis=1)
        # Surfaces that are nearly parallel do not tell where along them they meet.
        steps = np.linalg.pinv(normals, rcond=0.1) @ heights[..., None]
        out = out - steps[..., 0]
    far = np.linalg.norm(out - points, axis=1) > FARTHEST
    return np.where(far[:, None], points, out)


def snapped(member: Member, face: int, fields: Mapping[int, HeightField]) -> Member:
    """The member, its corners at creases brought onto the surfaces of the map that meet there."""
    corners = []
    for points, sides in zip(member.corners, member.sides, strict=True):
        new = points.copy()
        by_faces = defaultdict(list)
        for k in range(len(points)):
            met = {f for pair in (sides[k - 1], sides[k]) if pair for f in pair if f in fields}
            if met - {face}:
                by_faces[tuple(sorted(met | {face}))].append(k)
        for met_faces, at in by_faces.items():
            new[at] = onto([fields[f] for f in met_faces], points[at])
        corners.append(new)
    return Member(corners, member.sides)


def outline(
    members: Sequence[Member],
    sets: Sequence[str],
    field: HeightField,
    face: int,
    fields: Mapping[int, HeightField],
    gap: float,
) -> Outline:
    """Outline of the union of the members' regions, in the base of the face's field."""
    placed = [snapped(member, face, fields) for member in members]
    flat = [[field.base.local(points)[:, :2] for points in member.corners] for member in placed]
    by_set: dict[str, list[Region]] = defaultdict(list)
    for name, loops in zip(sets, flat, strict=True):
        by_set[name].append(region_of(loops))
    whole = united([shapely.union_all(regions) for _, regions in sorted(by_set.items())], gap)
    rings = [_following(ring, field) for ring in loops_of(whole, TOLERANCE)]
    lines, pairs = _creased(flat, placed)
    loops, sides = [], []
    for ring in rings:
        height = evaluate(field, (ring - field.low) / (field.high - field.low))[0]
        loops.append(field.base.place(np.column_stack([ring, height])))
        sides.append(_sides_along(ring, lines, pairs))
    return Outline(loops, sides)


def _following(ring: Array, field: HeightField) -> Array:
    """The ring with corners more where its sides, straight in the base, follow a curved surface."""
    if field.knots.size == 4:
        return ring
    out = []
    for start, end in zip(ring, np.roll(ring, -1, axis=0), strict=True):
        share = np.linspace(0.0, 1.0, max(2, int(np.ceil(np.linalg.norm(end - start) / FINE)) + 1))
        points = start + share[:, None] * (end - start)
        height = evaluate(field, (points - field.low) / (field.high - field.low))[0]
        out.append(points[simplify(np.column_stack([points, height]), TOLERANCE)][:-1])
    return np.concatenate(out)


def _creased(flat: Sequence[list[Array]], members: Sequence[Member]) -> tuple[Array, list[FacePair]]:
    """Sides (k, 2, 2) that run along creases, and the faces that meet there."""
    ends, pairs = [], []
    for loops, member in zip(flat, members, strict=True):
        for points, sides in zip(loops, member.sides, strict=True):
            following = np.roll(points, -1, axis=0)
            for k, pair in enumerate(sides):
                if pair is not None:
                    ends.append((points[k], following[k]))
                    pairs.append(pair)
    return np.array(ends).reshape(-1, 2, 2), pairs


def _sides_along(ring: Array, lines: Array, pairs: Sequence[FacePair]) -> list[FacePair | None]:
    """Of each side of a ring the pair of the nearest crease that runs along it, or None."""
    if not len(lines):
        return [None] * len(ring)
    following = np.roll(ring, -1, axis=0)
    tree = shapely.STRtree(shapely.linestrings(lines))
    reach = shapely.buffer(shapely.points((ring + following) / 2.0), ALONG)
    side, line = tree.query(reach, predicate="intersects")
    direction = (following - ring) / np.maximum(np.linalg.norm(following - ring, axis=1, keepdims=True), 1e-12)
    out: list[FacePair | None] = [None] * len(ring)
    best = np.full(len(ring), np.inf)
    for k, at in zip(side.tolist(), line.tolist(), strict=True):
        normal = np.array([-direction[k, 1], direction[k, 0]])
        along = lines[at, 1] - lines[at, 0]
        skew = abs(float(normal @ along)) / max(float(np.linalg.norm(along)), 1e-12)
        if skew < 0.2 and (skew, pairs[at]) < (best[k], out[k] or pairs[at]):
            best[k], out[k] = skew, pairs[at]
    return out


class Joint(NamedTuple):
    """A straight piece of a crease: the faces that meet in it, its ends along the line, and its points (k, 3)."""

    pair: FacePair
    points: Array


def joints(outlines: Mapping[int, Outline], fields: Mapping[int, HeightField]) -> list[Joint]:
    """Creases of the map, from the sides of all outlines, each once; ends and corners of both faces are its points."""
    sides: dict[FacePair, list[tuple[Array, Array]]] = defaultdict(list)
    for found in outlines.values():
        for loop, pairs in zip(found.loops, found.sides, strict=True):
            following = np.roll(loop, -1, axis=0)
            for k, pair in enumerate(pairs):
                if pair is not None and all(f in outlines for f in pair):
                    sides[pair].append((loop[k], following[k]))
    out = []
    for pair, ends in sorted(sides.items()):
        for points in _pieces(np.array(ends)):
            out.append(Joint(pair, onto([fields[f] for f in pair], points)))
    return out


def _pieces(ends: Array) -> list[Array]:
    """Points of each connected piece of sides (k, 2, 3) that lie on about one line, in order along it."""
    middle, direction = main_line(ends.reshape(-1, 3))
    t = np.sort((ends - middle) @ direction, axis=1)
    order = np.argsort(t[:, 0], kind="stable")
    reached, starts = -np.inf, []
    for number, k in enumerate(order):
        if t[k, 0] > reached + APART:
            starts.append(number)
        reached = max(reached, t[k, 1])
    out = []
    for some in np.split(order, starts[1:]):
        points = ends[some].reshape(-1, 3)
        at = (points - middle) @ direction
        _, first = np.unique(np.round(at, 4), return_index=True)
        out.append(points[first])
    return [points for points in out if len(points) > 1]


def main_line(points: Array) -> tuple[Array, Array]:
    """Middle (3,) and direction (3,) of the straight line through points (n, 3), pointing up or along x."""
    middle = (points.min(axis=0) + points.max(axis=0)) / 2.0
    direction = np.linalg.svd(points - middle, full_matrices=False)[2][0]
    return middle, np.asarray(direction * np.sign(direction[np.argmax(np.abs(direction))]))


def trims_of(found: Outline, found_joints: Sequence[Joint], field: HeightField) -> tuple[TrimLoop, ...]:
    """Trim loops in the field's parameters; along creases they have exactly the creases' points."""
    by_pair: dict[FacePair, list[int]] = defaultdict(list)
    for number, joint in enumerate(found_joints):
        by_pair[joint.pair].append(number)
    loops = []
    for loop, pairs in zip(found.loops, found.sides, strict=True):
        points, creases = [], []
        following = np.roll(loop, -1, axis=0)
        for k, pair in enumerate(pairs):
            numbers = by_pair.get(pair, []) if pair else []
            run = _run(loop[k], following[k], [found_joints[n] for n in numbers])
            if run is None:
                points.append(loop[k : k + 1])
                creases.append([-1])
            else:
                which, between = run
                points.append(between[:-1])
                creases.append([numbers[which]] * (len(between) - 1))
        corners = np.concatenate(points)
        uv = (field.base.local(corners)[:, :2] - field.low) / (field.high - field.low)
        loops.append(TrimLoop(np.clip(uv, 0.0, 1.0), np.concatenate(creases).astype(np.int64)))
    return tuple(loops)


def _run(start: Array, end: Array, candidates: Sequence[Joint]) -> tuple[int, Array] | None:
    """Which joint holds a side, and the joint's points from its start to its end; None where none does."""
    for number, joint in enumerate(candidates):
        distance = [np.linalg.norm(joint.points - p, axis=1) for p in (start, end)]
        a, b = (int(np.argmin(d)) for d in distance)
        if a != b and max(distance[0][a], distance[1][b]) < 2.0 * ALONG:
            return number, joint.points[a : b + 1] if a < b else joint.points[b : a + 1][::-1]
    return None


def straight(points: Array) -> bool:
    """Whether points (n, 3) lie on one line."""
    middle, direction = main_line(points)
    off = (points - middle) - ((points - middle) @ direction)[:, None] * direction
    return bool(np.linalg.norm(off, axis=1).max() < STRAIGHT)


def crease_of(joint: Joint, names: Mapping[int, str]) -> Crease:
    """The crease of a joint."""
    return Crease((names[joint.pair[0]], names[joint.pair[1]]), joint.points)
