"""Faces joined over one plane or cylinder in information form: heights, their knots and covariance, shares of poses.

A data set A tells its control heights c_A with the sensor part C_A of their covariance. With P_A from the heights c of
the joined face to those of A the sum of

    (P_A c - c_A)' C_A^-1 (P_A c - c_A)

is least. It is a sum over data sets, so that neither their order matters nor how many surveys a face was joined from.
Walls are not perfect, and faces not quite what they are fitted to: whether data sets agree, and whether their
differences pay for a knot, is told by Lambda_A, the inverse of C_A and the covariance of what walls leave their spline
by. G_A leads from the errors of pose e (unit variance each: three of the data set's own, and those of the modes that
its trajectory has) to c_A.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular
from scipy.spatial.distance import cdist

from bsmap_cli.core.bspline import clamped_knots
from bsmap_cli.core.gaussian import symmetric_sqrt
from bsmap_cli.core.uncertainty import TWIST, is_plane, with_twist
from bsmap_cli.fit.heights import (
    HeightField,
    Knots,
    PlaneBase,
    basis_matrix,
    greville,
    least_knots,
    with_degree,
    with_knot,
)
from bsmap_cli.fit.selection import HIGHEST_DEGREE, MOST, PRICE
from bsmap_cli.fit.smoothness import smoothness
from bsmap_cli.merge.bases import BasedFace, height_basis, normals, places_on
from bsmap_cli.merge.frames import Frame
from bsmap_cli.model import Array, HeightCovariance, PosePart

WAVE = 1.0
"""Metres over which a wall's departure from its spline is correlated."""
PER_CONTROL_POINT = 4
"""Samples for each control point and direction, through which heights are carried over to the common base."""
PER_SPAN, MOST_SAMPLES = 2, 64
"""Samples for each of the narrowest spans and direction, but no more than so many for the sake of these."""
ROBUST = 3.0
"""Standard deviations beyond which a data set's heights count less (Huber)."""


LEAST_SIGMA, ROUNDED = 1e-5, 1e-6
"""Metres, and share of a variance, to which sensor parts are known at best: files round coordinates and covariances."""
LEAST_SHARE = 1e-6
"""Of the largest variance of heights over a cylinder: what has less was not fitted."""
ALIGNED = 0.95
"""Cosine between axes that count as the same."""
LEAST_SPAN = 0.01
"""Between knots, of the whole."""
ENOUGH = 2.0
"""Criterion for each height told, above which other knots are tried."""


class Told(NamedTuple):
    """What one face of a data set tells about the joined face.

    uv : (m, 2) parameters in the frame of samples of its rectangle.  carry : (k, m) from heights there to its own.
    heights : (k,) its own, above the frame's plane.  root : (k, k) lower triangular, root' root = Lambda.
    sensor_root : (k, k) likewise of the inverse of the sensor part.
    covariance : (k, k) of the heights, sensor part.  by_pose : (k, p), of each of its pose parts in turn.
    basis : (m, k) back from its heights to the samples.  stiffness : 1 / metres, weight of what it cannot follow there.
    degrees, inner : along s and t of the frame, of its own spline: degrees, and knots in the frame's parameters, those
    at its ends too where it is more than bilinear.
    """

    uv: Array
    carry: Array
    heights: Array
    root: Array
    sensor_root: Array
    covariance: Array
    by_pose: Array
    pose: tuple[PosePart, ...]
    basis: Array
    stiffness: float
    degrees: tuple[int, int]
    inner: tuple[Array, Array]


class Joined(NamedTuple):
    """Height field of a joined face.  information : (n, n) of its heights.  gains : (n, k) of each face told.

    criterion : chi square and price of the control points.
    """

    field: HeightField
    information: Array
    gains: list[Array]
    criterion: float


def tell(face: BasedFace, frame: Frame, flatness: float, finest: Array) -> Told:
    """Carry a face's heights and their covariance over to the common base, by least squares on samples.

    finest : (2,) metres along s and t of the frame, of the narrowest spans that the joined face may have.
    """
    field, covariance = face.field, face.surface.covariance
    assert isinstance(covariance, HeightCovariance)
    axes = _axes(field, frame)
    spans = (field.high - field.low) / (finest[axes] if axes else finest.min())
    grid = _grid(field.knots, spans)
    places = places_on(field, grid)
    local = frame.base.local(places)
    n = normals(frame.base, places)
    C = with_twist(covariance.matrix) if is_plane(covariance.matrix) else covariance.matrix
    free, C = _free_heights(C) if face.round else (np.eye(len(C)), C)
    basis = height_basis(face.surface, field, grid) @ free
    carry = np.asarray(np.linalg.pinv(basis), dtype=np.float64)
    by_pose = [carry @ _lifted(part, places, n) for part in covariance.pose]
    uneven = free.T @ (flatness**2 * np.exp(-_distances(field) / WAVE)) @ free
    known = C + np.diag(LEAST_SIGMA**2 + ROUNDED * np.diag(C))
    root, sensor_root = _inverse_root(C + uneven), _inverse_root(known)
    uv = (local[:, :2] - frame.low) / (frame.high - frame.low)
    all_poses = np.concatenate(by_pose, axis=1) if by_pose else np.zeros((len(C), 0))
    degrees, inner = _knots_in(field, frame)
    # What it saw nothing of counts once for each of its heights, but no less than once for each of the spans.
    seen = max(basis.shape[1], np.prod(np.clip(spans, 1.0, MOST_SAMPLES / PER_SPAN)))
    stiffness = float(np.sqrt(seen / basis.shape[0])) / flatness
    heights = carry @ local[:, 2]
    return Told(uv, carry, heights, root, sensor_root, C, all_poses, covariance.pose, basis, stiffness, degrees, inner)


def finest_spans(faces: Sequence[BasedFace], frame: Frame) -> Array:
    """(2,) metres along s and t of a frame, of the narrowest spans that faces tell of: half as wide as theirs are.

    What is narrower lies between what they tell, and could be anything.
    """
    spans = []
    for face in faces:
        k, size = face.field.knots, face.field.high - face.field.low
        own = size * [np.diff(np.unique(k.s)).min(), np.diff(np.unique(k.t)).min()]
        axes = _axes(face.field, frame)
        spans.append(own[axes] if axes else np.full(2, own.min()))
    return np.asarray(np.min(spans, axis=0)) / 2.0


def _axes(field: HeightField, frame: Frame) -> list[int]:
    """Which of a field's axes lies along s and which along t of a frame; none where they are skew to them."""
    if not (isinstance(frame.base, PlaneBase) and isinstance(field.base, PlaneBase)):
        return [0, 1]
    turn = np.abs(frame.base.axes[:, 0] @ field.base.axes[:, :2])
    return [0, 1] if turn[0] > ALIGNED else [1, 0] if turn[1] > ALIGNED else []


def _free_heights(covariance: Array) -> tuple[Array, Array]:
    """Heights (n, k) that the data could move, and their covariance (k, k): splines that follow an arc have more."""
    values, vectors = np.linalg.eigh(covariance)
    free = values > LEAST_SHARE * values[-1]
    return vectors[:, free], np.diag(values[free])


def _distances(field: HeightField) -> Array:
    """(n, n) metres between the control points of a field."""
    k = field.knots
    s, t = greville(k.s, k.degree_s), greville(k.t, k.degree_t)
    at = np.stack(np.meshgrid(s, t, indexing="ij"), axis=-1).reshape(-1, 2) * (field.high - field.low)
    return np.asarray(cdist(at, at))


def _inverse_root(covariance: Array) -> Array:
    """Lower triangular R with R' R the inverse of a covariance."""
    return np.asarray(solve_triangular(np.linalg.cholesky(covariance), np.eye(len(covariance)), lower=True))


def _knots_in(field: HeightField, frame: Frame) -> tuple[tuple[int, int], tuple[Array, Array]]:
    """Degrees and knots of a face along the frame's axes; none where its own are skew to them, or follow an arc."""
    k, axes = field.knots, _axes(field, frame)
    degrees, inner = [1, 1], [np.zeros(0), np.zeros(0)]
    if k.size > 4 and axes and isinstance(frame.base, PlaneBase) and isinstance(field.base, PlaneBase):
        for own, (degree, knots) in enumerate(((k.degree_s, k.s), (k.degree_t, k.t))):
            axis = axes.index(own)
            at = np.full((len(np.unique(knots)), 3), 0.0)
            at[:, own] = np.unique(knots) * field.high[own]
            local = frame.base.local(field.base.place(at))[:, :2]
            along = ((local - frame.low) / (frame.high - frame.low))[:, axis]
            degrees[axis], inner[axis] = degree, along if degree > 1 or len(along) > 2 else np.zeros(0)
    return (degrees[0], degrees[1]), (inner[0], inner[1])


def _lifted(part: PosePart, points: Array, normals: Array) -> Array:
    """(m, 3 + modes) change of heights along normals (m, 3) at points (m, 3) by unit errors of a pose part, by its
    share.
    """
    J = normals.copy()
    J[:, 2] = normals[:, 1] * (points[:, 0] - part.centre[0]) - normals[:, 0] * (points[:, 1] - part.centre[1])
    return np.asarray(part.weight * J @ unit_errors(part))


def unit_errors(part: PosePart) -> Array:
    """(3, 3 + modes) error of pose by errors of unit variance: three of the data set's own, then the modes'."""
    own = symmetric_sqrt(part.own)
    return own if part.modes is None else np.concatenate([own, part.modes], axis=1)


def join(told: Sequence[Told], frame: Frame, finest: Array) -> Joined:
    """Joined heights on the knots that the data pay for, found step by step from the least surface.

    Where that does not end in a good fit, it is tried from the knots of all faces told, too.

    finest : (2,) metres along s and t, of the narrowest spans.
    """
    least = np.maximum(finest / (frame.high - frame.low), LEAST_SPAN)
    best = _improved(told, frame, least_knots(frame.base, frame.low, frame.high), least)
    own = _own_knots(told)
    if own.size > 4 and best.criterion > ENOUGH * sum(len(one.heights) for one in told):
        best = min(best, _improved(told, frame, own, least), key=lambda j: j.criterion)
    return _flattened(best) if best.field.knots.size == 4 and isinstance(frame.base, PlaneBase) else best


def _flattened(joined: Joined) -> Joined:
    """A bilinear patch whose twist does not pay for its parameter made a plane, by least squares.

    The fourth height of a wall costs accuracy, at its corners most, where beams are few.
    """
    heights = joined.field.heights.ravel()
    along = np.linalg.solve(joined.information, TWIST)
    variance = TWIST @ along
    if (TWIST @ heights) ** 2 >= PRICE * variance:
        return joined
    plane = np.eye(4) - np.outer(along, TWIST) / variance
    field = replace(joined.field, heights=(plane @ heights).reshape(2, 2))
    return joined._replace(field=field, gains=[plane @ K for K in joined.gains])


def _improved(told: Sequence[Told], frame: Frame, knots: Knots, least: Array) -> Joined:
    best = solve(told, frame, knots)
    for _ in range(40):
        tried = [solve(told, frame, richer) for richer in _richer(best.field.knots, least)]
        better = min(tried, key=lambda j: j.criterion, default=best)
        if better.criterion >= best.criterion:
            break
        best = better
    return best


def _own_knots(told: Sequence[Told]) -> Knots:
    """Highest degrees of the faces told, knots at all of theirs."""
    degree_s, degree_t = (max(one.degrees[axis] for one in told) for axis in (0, 1))
    s, t = (np.unique(np.round(np.concatenate([one.inner[axis] for one in told]), 6)) for axis in (0, 1))
    return Knots(int(degree_s), int(degree_t), clamped_knots(degree_s, _spaced(s)), clamped_knots(degree_t, _spaced(t)))


def _spaced(inner: Array) -> Array:
    """Inner knots without those that come too soon after the one before."""
    kept: list[float] = []
    for knot in inner:
        if LEAST_SPAN < knot < 1.0 - LEAST_SPAN and (not kept or knot - kept[-1] > LEAST_SPAN):
            kept.append(float(knot))
    return np.array(kept)


def _richer(k: Knots, least: Array) -> list[Knots]:
    """One step richer: a degree more, or one span halved that is wide enough; least : (2,) of the whole."""
    if k.size >= MOST:
        return []
    out = []
    if k.degree_s < HIGHEST_DEGREE:
        out.append(k._replace(degree_s=k.degree_s + 1, s=with_degree(k.s, k.degree_s)))
    if k.degree_t < HIGHEST_DEGREE:
        out.append(k._replace(degree_t=k.degree_t + 1, t=with_degree(k.t, k.degree_t)))
    out += [k._replace(s=with_knot(k.s, k.degree_s, new)) for new in _middles(k.s, least[0])]
    out += [k._replace(t=with_knot(k.t, k.degree_t, new)) for new in _middles(k.t, least[1])]
    return out


def _middles(knots: Array, least: float) -> list[float]:
    """Middles of the spans that are wide enough to be halved."""
    edges = np.unique(knots)
    return [float((a + b) / 2.0) for a, b in pairwise(edges) if b - a >= 2.0 * least]


def solve(told: Sequence[Told], frame: Frame, knots: Knots) -> Joined:
    """Heights on given knots; data sets that disagree count less (two rounds)."""
    at = np.split(basis_matrix(knots, np.concatenate([one.uv for one in told])), _ends(told))
    P = [one.carry @ basis for one, basis in zip(told, at, strict=True)]
    wanted = [one.sensor_root @ one.heights for one in told]
    N = [one.sensor_root @ p for one, p in zip(told, P, strict=True)]
    share = np.ones(len(told))
    # What the faces told cannot follow of the joined heights, weighted: their heights do not show it.
    strays = [one.stiffness * (basis - one.basis @ p) for one, basis, p in zip(told, at, P, strict=True)]
    stiff = smoothness(knots) + np.sum([stray.T @ stray for stray in strays], axis=0)
    for _ in range(3):
        H = stiff + sum(w * n.T @ n for w, n in zip(share, N, strict=True))
        factor = cho_factor(H)
        c = cho_solve(factor, np.sum([w * n.T @ y for w, n, y in zip(share, N, wanted, strict=True)], axis=0))
        squares = np.array([np.sum((one.root @ (one.heights - p @ c)) ** 2) for one, p in zip(told, P, strict=True)])
        size = np.sqrt(squares / [len(y) for y in wanted])
        share = np.minimum(1.0, ROBUST / np.maximum(size, 1e-12))
    gains = [w * cho_solve(factor, n.T @ one.sensor_root) for w, n, one in zip(share, N, told, strict=True)]
    field = HeightField(frame.base, frame.low, frame.high, knots, c.reshape(knots.shape))
    counts = np.array([len(y) for y in wanted])
    loss = np.where(size > ROBUST, counts * (2.0 * size - ROBUST) * ROBUST, squares)
    beyond = sum(float(np.sum((stray @ c) ** 2)) for stray in strays)
    return Joined(field, H, gains, float(loss.sum() + beyond) + PRICE * knots.size)


def _ends(told: Sequence[Told]) -> list[int]:
    """Where the samples of each face but the last end, all of them in a row."""
    return np.cumsum([len(one.uv) for one in told])[:-1].tolist()


def covariance_of(joined: Joined, told: Sequence[Told]) -> tuple[Array, tuple[PosePart, ...]]:
    """Sensor part sum K_A C_A K_A' of the heights, and the pose parts by their share in the whole.

    The shares are the mean over the face: trace(K_A P_A) over the number of heights. They add up to 1.
    """
    matrix = np.sum([K @ one.covariance @ K.T for K, one in zip(joined.gains, told, strict=True)], axis=0)
    shares = np.array(
        [
            np.trace(K @ one.carry @ basis_matrix(joined.field.knots, one.uv))
            for K, one in zip(joined.gains, told, strict=True)
        ]
    )
    parts: dict[str, PosePart] = {}
    for share, one in zip(shares / shares.sum(), told, strict=True):
        for part in one.pose:
            before = parts[part.data_set].weight if part.data_set in parts else 0.0
            parts[part.data_set] = replace(part, weight=float(before + share * part.weight))
    return (matrix + matrix.T) / 2.0, tuple(parts[name] for name in sorted(parts))


def _grid(knots: Knots, spans: Array) -> Array:
    """(n, 2) parameters of samples; spans : (2,) how many of the narrowest spans there are along u and v."""
    counts = np.maximum(PER_CONTROL_POINT * np.array(knots.shape), np.minimum(PER_SPAN * spans, MOST_SAMPLES))
    u, v = (np.linspace(0.0, 1.0, int(np.ceil(count))) for count in counts)
    return np.stack(np.meshgrid(u, v, indexing="ij"), axis=-1).reshape(-1, 2)
