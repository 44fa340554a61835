"""Where beams meet height fields, those of many faces at once: a call costs the same for one face and for fifty."""

import itertools
from collections.abc import Iterator, Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from bsmap_cli.core.pieces import CHUNK, Spans, horner
from bsmap_cli.fit.heights import CylinderBase, HeightField, bulge_of, bulge_over
from bsmap_cli.model import Array, IntArray

SETTLED = 1e-5
"""Metres; behind a step of Newton's method below this what is left is its square times the curvature: nothing."""
STEEPEST = 0.05
"""Smallest sine between beam and surface that counts."""
FARTHEST = 5.0
"""Metres that a step of Newton's method may go."""


class Met(NamedTuple):
    """The same as Feet, without their points."""

    uv: Array
    beyond: Array
    slope: Array
    height: Array


class Feet(NamedTuple):
    """Where beams meet height fields.

    uv : (n, 2) parameters, not clamped.  beyond : (n,) metres from the measured point on to the foot, along the beam.
    slope : (n,) change of height over the surface along the beam.  points : (n, 3) in map.  height : (n,) metres.
    """

    uv: Array
    beyond: Array
    slope: Array
    points: Array
    height: Array


class Lines(NamedTuple):
    """Spans along one direction of f faces, face after face: where each begins, two more for each face; its middle, and
    the change (k,) of its own parameter.  first, spans : (f,) number of the first span of each face, and how many.
    """

    begins: Array
    middles: Array
    scales: Array
    first: IntArray
    spans: IntArray


class Table(NamedTuple):
    """Height fields of f faces.

    frame : (12, f) axes s, t, normal and origin; of a cylinder, two across the axis, the axis and a point of it.
    radius, middle : (f,) of cylinders; radius 0 for planes.
    bulge : (2, f) t of the centre and radius of the spheres that heights begin from; radius 0 where there is none.
    low, size : (2, f) of the rectangles, metres.
    least, most : (f,) parameters beyond which a surface goes on straight.  lines : along s and t.
    orders : (2, f) of the coefficients along t and s.
    coefficients : (4, 4, pieces) Taylor coefficients about the middles, those of t outside.  first_piece : (f,).
    """

    frame: Array
    radius: Array
    middle: Array
    bulge: Array
    low: Array
    size: Array
    least: Array
    most: Array
    lines: tuple[Lines, Lines]
    orders: IntArray
    coefficients: Array
    first_piece: IntArray


def tabulate(fields: Sequence[HeightField]) -> Table:
    """Table of height fields, in their order; made once for the same fields, which are asked about many times."""
    return _tabulated(tuple(fields))


@lru_cache(maxsize=16)
def _tabulated(fields: tuple[HeightField, ...]) -> Table:
    frame, radius, middle = np.empty((12, len(fields))), np.zeros(len(fields)), np.zeros(len(fields))
    bulge = np.array([bulge_of(field.base) or (0.0, 0.0) for field in fields]).reshape(-1, 2).T
    for k, field in enumerate(fields):
        base = field.base
        if isinstance(base, CylinderBase):
            upright = np.eye(3) if base.upright is None else base.upright
            frame[:9, k], frame[9:, k] = upright.T.ravel(), upright[:, :2] @ base.centre
            radius[k], middle[k] = base.radius, base.middle
        else:
            frame[:9, k], frame[9:, k] = base.axes.T.ravel(), base.origin
    low, high = (np.array([getattr(field, end) for field in fields]).reshape(-1, 2).T for end in ("low", "high"))
    # The least surface's formula holds beyond its rectangle, too.
    endless = np.array([field.knots.shape == (2, 2) for field in fields], dtype=bool)
    least, most = np.where(endless, -np.inf, 0.0), np.where(endless, np.inf, 1.0)
    pieces = [field.pieces for field in fields]
    along_s, along_t = _joined([p.along_u for p in pieces]), _joined([p.along_v for p in pieces])
    orders = np.array([p.coefficients.shape[:2] for p in pieces], dtype=np.int64).reshape(-1, 2).T
    total = along_s.spans * along_t.spans
    first = np.cumsum(total) - total
    coefficients = np.zeros((*orders.max(axis=1, initial=2), int(total.sum())))
    for p, start, count in zip(pieces, first, total, strict=True):
        q, r = p.coefficients.shape[:2]
        coefficients[:q, :r, start : start + count] = p.coefficients[:, :, 0]
    return Table(
        frame, radius, middle, bulge, low, high - low, least, most, (along_s, along_t), orders, coefficients, first
    )


def _joined(spans: Sequence[Spans]) -> Lines:
    """Spans along one direction of all faces."""
    none = np.zeros(0)
    count = np.array([len(of.middle) for of in spans], dtype=np.int64)
    begins = np.concatenate([none, *([2.0 * k, *(of.inner[:-1] + 2.0 * k)] for k, of in enumerate(spans))])
    middles, scales = (np.concatenate([none, *of]) for of in ([s.middle for s in spans], [s.scale for s in spans]))
    return Lines(begins, middles, scales, np.cumsum(count) - count, count)


def find_feet(
    table: Table, face: IntArray, points: Array, directions: Array, start: Array | None = None, steps: int = 4
) -> Feet:
    """Feet of beams through points (n, 3) along unit directions (n, 3), each on its face (n,), by Newton's method.

    start : (n,) metres from the points at which it begins, 0 where not given.
    """
    met = meet(table, face, points, directions, None, start, steps)
    return Feet(met.uv, met.beyond, met.slope, points + met.beyond[:, None] * directions, met.height)


def meet(
    table: Table,
    face: IntArray,
    points: Array,
    directions: Array,
    at: IntArray | None = None,
    start: Array | None = None,
    steps: int = 4,
) -> Met:
    """The same without points, of those beams that are numbered `at` (n,) among points and directions (k, 3)."""
    uv, rest = np.empty((2, len(face))), np.empty((3, len(face)))
    for part, faces in _chunks(face, len(table.radius)):
        p, d = (np.ascontiguousarray(of[part if at is None else at[part]].T) for of in (points, directions))
        begin = np.zeros(p.shape[1]) if start is None else start[part]
        alone = len(faces) == 1 and table.least[faces[0]] < 0.0 and not table.radius[faces[0]]
        uv[:, part], rest[:, part] = (_on_bilinear if alone else _newton)(table, faces, p, d, begin, steps)
    return Met(uv.T, *rest)


def _chunks(face: IntArray, faces: int) -> Iterator[tuple[slice | IntArray, IntArray]]:
    """Parts of the beams on `face` (n,) of so many that fit into the processor's cache, with their faces.

    Long lists are taken face by face: where a part has only one face, that is given once, and its tables need not be
    copied for every beam.
    """
    if len(face) <= CHUNK:
        yield slice(None), face[:1] if faces == 1 else face
        return
    order = None
    if np.any(face[1:] < face[:-1]):
        # Short numbers are sorted in one pass.
        order = np.argsort(face.astype(np.int16 if faces < 2**15 else np.int64), kind="stable")
        face = face[order]
    for a, b in itertools.pairwise([0, *(np.flatnonzero(np.diff(face)) + 1).tolist(), len(face)]):
        for part in (slice(first, min(first + CHUNK, b)) for first in range(a, b, CHUNK)):
            yield part if order is None else order[part], face[a : a + 1]


def offsets(table: Table, face: IntArray, points: Array) -> tuple[Array, Array]:
    """Heights (n,) of points (n, 3) above their faces, to first order their distances, and unit normals (n, 3)."""
    frame, p = table.frame.take(face, axis=1), np.ascontiguousarray(points.T)
    local = _turned(frame, p - frame[9:])
    at, arm = _round_ones(table, face, len(points))
    if len(at):
        local[:, at], c, s = _around(table, face[at], local[:, at])
    height, gradient, _ = _heights(table, face, _of_faces(table, face), local)
    normal = frame[6:9] - gradient[0] * frame[0:3] - gradient[1] * frame[3:6]
    if len(at):
        around = gradient[0, at] * arm / np.maximum(arm + local[2, at], 0.1 * arm)
        normal[:, at] = _in_map(frame[:, at], np.stack([c + around * s, s - around * c, -gradient[1, at]]))
    length = np.sqrt(np.sum(normal**2, axis=0))
    return (local[2] - height) / length, (normal / length).T


def parameters_at(table: Table, face: IntArray, points: Array) -> Array:
    """(n, 2) parameters of points (n, 3) on their faces (n,)."""
    frame = table.frame.take(face, axis=1)
    local = _turned(frame, points.T - frame[9:])
    at = _round_ones(table, face, len(points))[0]
    local[:, at] = _around(table, face[at], local[:, at])[0]
    return ((local[:2] - table.low.take(face, axis=1)) / table.size.take(face, axis=1)).T


def _newton(table: Table, face: IntArray, p: Array, d: Array, start: Array, steps: int) -> tuple[Array, Array]:
    """(2, n) parameters; (3, n) way beyond the points, slope and height, of beams p, d (3, n)."""
    # Over a plane s, t and h change evenly along a beam.
    flat, turn = _in_frames(table, face, p, d)
    at, arm = _round_ones(table, face, p.shape[1])
    round_ones, ahead = np.broadcast_to(face, p.shape[1])[at] if len(at) else at, turn[:, at]
    beyond, own = start.copy(), _of_faces(table, face)
    for step in range(steps):
        local = flat + beyond * turn
        if len(at):
            local[:, at], c, s = _around(table, round_ones, flat[:, at] + beyond[at] * ahead)
            stretch = arm / np.maximum(arm + local[2, at], 0.1 * arm)
            dx, dy, dz = ahead
            turn[:, at] = (dy * c - dx * s) * stretch, dz, dx * c + dy * s
        height, gradient, uv = _heights(table, face, own, local)
        climb = gradient[0] * turn[0] + gradient[1] * turn[1]
        slope = _steep(turn[2] - climb)
        move = np.minimum(np.maximum((local[2] - height) / slope, -FARTHEST), FARTHEST)
        beyond -= move
        left = np.flatnonzero(np.abs(move) >= SETTLED) if step < steps - 1 else at[:0]
        if 2 * len(left) <= len(move):
            break
    uv -= move * turn[:2] / own.size
    rest = np.array([beyond, slope, height - move * climb])
    if len(left):  # few beams, most often grazing ones, need more steps than the others
        few = face if len(face) == 1 else face[left]
        uv[:, left], rest[:, left] = _newton(table, few, p[:, left], d[:, left], beyond[left], steps - 1 - step)
    return uv, rest


def _on_bilinear(table: Table, face: IntArray, p: Array, d: Array, start: Array, steps: int) -> tuple[Array, Array]:
    """The same on the least surface over a plane, (1,) face: along a beam its height is a polynomial of degree 2."""
    flat, turn = _in_frames(table, face, p, d)
    (a, b), (c, twist) = table.coefficients[:2, :2, table.first_piece[face[0]]].tolist()
    low, size = table.low[:, face], table.size[:, face]
    # The coefficients are those about the middle, whose own parameters run from -1 to 1.
    x, y = (flat[:2] - low) * (2.0 / size) - 1.0
    dx, dy = turn[:2] * (2.0 / size)
    above = flat[2] - (a + b * x + y * (c + twist * x))
    rise = turn[2] - (b + twist * y) * dx - (c + twist * x) * dy
    bend = -twist * dx * dy
    beyond = start
    for step in range(steps):
        bent = bend * beyond
        raw = rise + 2.0 * bent
        off = above + beyond * (rise + bent)
        slope = _steep(raw)
        move = np.minimum(np.maximum(off / slope, -FARTHEST), FARTHEST)
        before, beyond = beyond, beyond - move
        if step == steps - 1 or np.abs(move).max(initial=0.0) < SETTLED:
            break
    uv = 0.5 * (np.array([x + beyond * dx, y + beyond * dy]) + 1.0)
    return uv, np.array([beyond, slope, flat[2] + before * turn[2] - off - move * (turn[2] - raw)])


def _steep(slope: Array) -> Array:
    """Slopes (n,), those that are too small made greater."""
    return np.copysign(np.maximum(np.abs(slope), STEEPEST), slope)


def _in_frames(table: Table, face: IntArray, p: Array, d: Array) -> tuple[Array, Array]:
    """Points and directions (3, n) in the frames of their faces (n,), or of one (1,)."""
    frame = table.frame.take(face, axis=1)
    if len(face) == 1:
        axes = frame[:9].reshape(3, 3)
        return axes @ (p - frame[9:]), axes @ d
    return _turned(frame, p - frame[9:]), _turned(frame, d)


def _turned(frame: Array, vectors: Array) -> Array:
    """(3, n) vectors (3, n), each in its frame (12, n)."""
    x, y, z = vectors
    return np.array([frame[k] * x + frame[k + 1] * y + frame[k + 2] * z for k in (0, 3, 6)])


def _in_map(frame: Array, vectors: Array) -> Array:
    """(3, n) vectors (3, n), given each in its frame (12, n), in map."""
    x, y, z = vectors
    return x * frame[0:3] + y * frame[3:6] + z * frame[6:9]


def _round_ones(table: Table, face: IntArray, count: int) -> tuple[IntArray, Array]:
    """Which of the faces (count,), or (1,) for all, are cylinders, and their radii."""
    if not table.radius.any():
        return np.zeros(0, dtype=np.int64), np.zeros(0)
    radius = table.radius.take(face)
    if len(face) != count:
        at = np.arange(count if radius[0] else 0)
        return at, np.full(len(at), radius[0])
    at = np.flatnonzero(radius)
    return at, radius[at]


def _around(table: Table, face: IntArray, place: Array) -> tuple[Array, Array, Array]:
    """(3, n) arc, height, distance outwards, on cylinders, of places (3, n) about their axes; cosine and sine."""
    radius, (x, y, z) = table.radius[face], place
    angle = (np.arctan2(y, x) - table.middle[face] + np.pi) % (2.0 * np.pi) - np.pi
    distance = np.hypot(x, y)
    safe = np.maximum(distance, 1e-12)
    return np.array([angle * radius, z, distance - radius]), x / safe, y / safe


class _Own(NamedTuple):
    """What of a table belongs to the faces of n beams, or to one for all: looked up once, not in each step.

    low, size, bulge : (2, n or 1).  least, most, piece, spans : (n or 1,).  orders : of the coefficients along t, s.
    first : (n or 1,) number of the first span along s and along t.
    """

    low: Array
    size: Array
    bulge: Array | None
    least: Array
    most: Array
    piece: IntArray
    spans: IntArray
    orders: tuple[int, int]
    first: tuple[IntArray, IntArray]


def _of_faces(table: Table, face: IntArray) -> _Own:
    """The same for faces (n,), or one (1,)."""
    orders_t, orders_s = table.orders.take(face, axis=1).max(axis=1, initial=2).tolist()
    along_s, along_t = table.lines
    return _Own(
        table.low.take(face, axis=1),
        table.size.take(face, axis=1),
        table.bulge.take(face, axis=1) if table.bulge.any() else None,
        table.least.take(face),
        table.most.take(face),
        table.first_piece.take(face),
        along_t.spans.take(face),
        (orders_t, orders_s),
        (along_s.first.take(face), along_t.first.take(face)),
    )


def _heights(table: Table, face: IntArray, own: _Own, local: Array) -> tuple[Array, Array, Array]:
    """Heights (n,) at s, t of `local` (3, n), gradients (2, n) by s and t, and parameters (2, n)."""
    uv = (local[:2] - own.low) / own.size
    inside = np.minimum(np.maximum(uv, own.least), own.most)
    along_s, along_t = (
        _own_parameter(line, face, first, u) for line, first, u in zip(table.lines, own.first, inside, strict=True)
    )
    piece = own.piece + along_s[0] * own.spans + along_t[0]
    orders_t, orders_s = own.orders
    value, by_x, by_y = horner(table.coefficients[:orders_t, :orders_s].take(piece, axis=2), along_s[1], along_t[1])
    gradient = np.empty(uv.shape)
    np.multiply(by_x, along_s[2], out=gradient[0])
    np.multiply(by_y, along_t[2], out=gradient[1])
    height = value + gradient[0] * (uv[0] - inside[0]) + gradient[1] * (uv[1] - inside[1])
    gradient /= own.size
    if own.bulge is not None:
        middle, radius = np.broadcast_to(own.bulge, uv.shape)
        at = np.flatnonzero(radius)
        more, slope = bulge_over(radius[at], local[1, at] - middle[at])
        height[at] += more
        gradient[1, at] += slope
    return height, gradient, uv


def _own_parameter(line: Lines, face: IntArray, first: IntArray, u: Array) -> tuple[IntArray, Array, Array]:
    """Number (n,) of the span of each parameter (n,) in its face, the span's own parameter, and its change."""
    number = np.zeros(len(u), dtype=np.int64)
    if len(line.begins) > len(line.first) and (len(face) != 1 or line.spans[face[0]] > 1):
        within = np.minimum(np.maximum(u, 0.0), 1.0)
        number = line.begins.searchsorted(within + 2.0 * face, side="right") - 1 - first
    span = number + first
    scale = line.scales.take(span)
    return number, (u - line.middles.take(span)) * scale, scale
