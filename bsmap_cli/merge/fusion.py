"""Fusing a pair of patches: do they agree within their covariances, and the surface that replaces both, Eq. (37-38)."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bsmap_cli.core.bspline import design_matrix, evaluate_grid
from bsmap_cli.core.gaussian import chi2_gate, pack, product, symmetric_sqrt, unpack
from bsmap_cli.core.uncertainty import pose_covariance, sensor_covariance
from bsmap_cli.errors import BsmapError
from bsmap_cli.merge.covariance import carry, fuse_blocks
from bsmap_cli.merge.facing import visible_normals
from bsmap_cli.merge.patch import Patch, land
from bsmap_cli.model import Array, PosePart, SurfaceCovariance
from bsmap_cli.params import MergeParams

STEP = 0.08
"""Metres between samples of a patch that is fused, where its knots do not ask for more."""
HUBER = 1.345
"""Standard deviations from which on a sample counts linearly only: Huber's value, 95% efficient for Gaussian errors."""


class Pairing(NamedTuple):
    """Samples of one patch on a grid, and their feet on the other.

    u : (n,), v : (m,) parameters of the grid.  points : (n, m, 3).  covariance : of the samples, as of control points.
    hit : (n * m,) bool, samples with a foot; the following hold these k samples only.
    normals : (k, 3) of the other patch at the feet, visible side.  offsets : (k,) metres from sample to foot along it.
    first, second : (k,) sensor variances of sample and foot along it.
    first_pose, second_pose : (k,) variances from the poses along it.
    """

    u: Array
    v: Array
    points: Array
    covariance: SurfaceCovariance
    hit: NDArray[np.bool_]
    normals: Array
    offsets: Array
    first: Array
    second: Array
    first_pose: Array
    second_pose: Array


class Agreement(NamedTuple):
    """How well two patches agree, squared Mahalanobis distances with their degrees of freedom and gates.

    squared_distance, dof, gate : of all offsets.
    pose_distance, pose_dof, pose_gate : of the pose errors that explain the offsets best: an error of the pose that is
    too large does not show among the many degrees of freedom of the whole.
    """

    squared_distance: float
    dof: int
    gate: float
    pose_distance: float
    pose_dof: int
    pose_gate: float

    @property
    def passed(self) -> bool:
        return self.squared_distance <= self.gate and self.pose_distance <= self.pose_gate


class Fused(NamedTuple):
    """Merged samples.

    points : (n, m, 3).  covariance : of the samples.  moved : how many are fused.
    gain : mean over all samples of the share that the second patch has in them.
    """

    points: Array
    covariance: SurfaceCovariance
    gain: float
    moved: int


def pair_samples(first: Patch, second: Patch, distance: float) -> Pairing:
    """Sample one patch on a grid, dense enough to fit on its knots again, and find the feet on the other."""
    u = _parameters(first.surface.knots_u, first.surface.degree_u, first.size[0])
    v = _parameters(first.surface.knots_v, first.surface.degree_v, first.size[1])
    points = evaluate_grid(first.surface, u, v)
    grid_u, grid_v = np.meshgrid(u, v, indexing="ij")
    sides = visible_normals(first.samples.pieces, first.facing, grid_u.ravel(), grid_v.ravel())
    landing = land(points.reshape(-1, 3), sides, second, distance)
    hit, normals = landing.hit, landing.normal[landing.hit]
    S, T = points.reshape(-1, 3)[hit], landing.foot[hit]
    covariance = carry(
        first.surface.covariance,
        design_matrix(first.surface.knots_u, first.surface.degree_u, u),
        design_matrix(first.surface.knots_v, first.surface.degree_v, v),
    )
    second_sensor = sensor_covariance(second.surface, landing.u[hit], landing.v[hit])
    return Pairing(
        u,
        v,
        points,
        covariance,
        hit,
        normals,
        np.einsum("nk,nk->n", T - S, normals),
        _along(unpack(covariance.blocks).reshape(-1, 3, 3)[hit], normals),
        _along(second_sensor, normals),
        _along(pose_covariance(first.surface.covariance.pose, S), normals),
        _along(pose_covariance(second.surface.covariance.pose, T), normals),
    )


def _parameters(knots: Array, degree: int, length: float) -> Array:
    """Parameters (n,) that divide each span into `degree` parts at least, and into steps of STEP on `length` metres."""
    ends = np.unique(knots)
    parts = np.maximum(np.ceil(np.diff(ends) * length / STEP).astype(int), degree)
    steps = [np.linspace(a, b, k, endpoint=False) for a, b, k in zip(ends[:-1], ends[1:], parts, strict=True)]
    return np.concatenate([*steps, [1.0]])


def _along(covariance: Array, normals: Array) -> Array:
    """Variances (n,) of covariances (n, 3, 3) along unit vectors (n, 3)."""
    return np.einsum("ni,nij,nj->n", normals, covariance, normals)


def agreement(first: Patch, second: Patch, pairing: Pairing, params: MergeParams) -> Agreement:
    """Robust squared Mahalanobis distance of two patches from the offsets of all their paired samples.

    The offsets are d = F y + e: y ~ N(0, I) the pose errors of the data sets, common to all samples, e the sensor's and
    the surface's own error. Neighbouring samples of a spline are not independent, so all of them together count as many
    as the smaller patch has control points; the surface's own error (rounded corners) counts as the larger of bound_u
    and its residuals, and single places that differ by much are held down by Huber's loss.
    """
    poses = _pose_factors(first, second, pairing)
    own = [max(patch.surface.residuals.rms, params.bound_u) for patch in (first, second)]
    deviation = np.sqrt(pairing.first + pairing.second + own[0] ** 2 + own[1] ** 2)
    controls = min(int(np.prod(patch.surface.control_points.shape[:2])) for patch in (first, second))
    dof = min(len(pairing.offsets), controls)
    F, d = poses / deviation[:, None], pairing.offsets / deviation
    y, squared, pose_dof = _huber_fit(F, d, dof / len(d))
    return Agreement(
        squared, dof, chi2_gate(params.gate, dof), float(y @ y), pose_dof, chi2_gate(params.gate, pose_dof)
    )


def _pose_factors(first: Patch, second: Patch, pairing: Pairing) -> Array:
    """Matrix (k, 3 s) of the change of the offsets by unit pose errors of the s data sets of both patches.

    A data set in both patches moves both: only the difference of the shares remains.
    """
    places = pairing.points.reshape(-1, 3)[pairing.hit]
    factors: dict[str, Array] = {}
    for patch, sign in ((first, -1.0), (second, 1.0)):
        for part in patch.surface.covariance.pose:
            change = sign * part.weight * _pose_lever(part, places, pairing.normals) @ symmetric_sqrt(part.covariance)
            factors[part.data_set] = factors.get(part.data_set, 0.0) + change
    return np.hstack(list(factors.values()))


def _pose_lever(part: PosePart, points: Array, normals: Array) -> Array:
    """Rows n'J (k, 3): change of points along their normals by (x, y, theta) of a data set's pose."""
    turn = (points[:, 0] - part.centre[0]) * normals[:, 1] - (points[:, 1] - part.centre[1]) * normals[:, 0]
    return np.stack([normals[:, 0], normals[:, 1], turn], axis=1)


def _huber_fit(F: Array, d: Array, share: float) -> tuple[Array, float, int]:
    """Pose errors y that minimise share * sum huber(d - F y) + |y|^2, the minimum, and how many of y the offsets see.

    huber(r) = r^2 within HUBER, linear outside; iteratively reweighted. What is seen is the trace of the hat matrix.
    """
    y: Array = np.zeros(F.shape[1])
    for _ in range(20):
        weights = share * np.minimum(1.0, HUBER / np.maximum(np.abs(d - F @ y), HUBER))
        information = F.T @ (weights[:, None] * F)
        normal_matrix = information + np.eye(len(information))
        y = np.asarray(np.linalg.solve(normal_matrix, F.T @ (weights * d)), dtype=float)
    r = np.abs(d - F @ y)
    minimum = share * np.where(r <= HUBER, r**2, 2 * HUBER * r - HUBER**2).sum() + y @ y
    seen = np.trace(np.linalg.solve(normal_matrix, information))
    return y, float(minimum), max(1, round(float(seen)))


def fuse(first: Patch, second: Patch, pairing: Pairing, params: MergeParams) -> Fused:
    """Merged points X = S + C1 (C1 + C2)^-1 (T - S), Eq. (37-38), along the normal.

    A foot says where the other surface is across it, not which of its points this is: T - S has no part along the
    surface, and neither has the product of Gaussians here, or it would take information along the surface from the
    feet that they do not hold. Samples without a foot, and those farther off than the gate allows, stay what they were.

    Raises
    ------
    BsmapError
        Where both surfaces claim to be without error.
    """
    a, b = pairing.first + pairing.first_pose, pairing.second + pairing.second_pose
    if not np.all(a + b > 0.0):
        raise BsmapError(
            f"surfaces {first.surface.name} and {second.surface.name} cannot be merged: both have zero covariance"
        )
    mean, _ = product(np.zeros((len(a), 1)), a[:, None, None], pairing.offsets[:, None], b[:, None, None])
    shift = mean[:, 0]
    own = sum(max(patch.surface.residuals.rms, params.bound_u) ** 2 for patch in (first, second))
    near = pairing.offsets**2 <= chi2_gate(params.gate, 1) * (a + b + own)
    gains = np.where(near, a / (a + b), 0.0)
    points, blocks = pairing.points.reshape(-1, 3).copy(), unpack(pairing.covariance.blocks).reshape(-1, 3, 3)
    points[pairing.hit] += np.where(near, shift, 0.0)[:, None] * pairing.normals
    blocks[pairing.hit] = fuse_blocks(blocks[pairing.hit], pairing.second, pairing.normals, gains)
    grid = pairing.points.shape[:2]
    covariance = SurfaceCovariance(
        pack(blocks.reshape(*grid, 3, 3)),
        pairing.covariance.correlation_u,
        pairing.covariance.correlation_v,
        pairing.covariance.pose,
    )
    return Fused(points.reshape(*grid, 3), covariance, float(gains.sum() / len(points)), int(np.count_nonzero(near)))
