"""Line EKF, method.md section 2 (Eq. 6-15): predict, update by a scan's pairs or a constraint, augment, remove.

The covariance is kept in the lower triangle of a Fortran-ordered square with room to grow: k pairs change it by a
downdate of rank 2 k (BLAS dsyrk) in place, which is fast and cannot lose symmetry. Hence the functions reuse the
buffers: a state given to one of them must not be used afterwards, only the one returned.
"""

import math
from typing import NamedTuple

import numpy as np
from scipy.linalg.blas import dsyrk, dtrsm, dtrsv
from scipy.linalg.lapack import dpotrf

from bsmap_cli.core import se2
from bsmap_cli.errors import BsmapError
from bsmap_cli.model import Array, IntArray

GROWTH = 64


class FilterState(NamedTuple):
    """mean : (capacity,) x, y, theta of base_link in map, then alpha, r of each line; covariance : (capacity,
    capacity), lower triangle; size : entries in use. Lines' n points away from where the robot saw them (r may be < 0).
    """

    mean: Array
    covariance: Array
    size: int

    @property
    def pose(self) -> Array:
        """(3,) x, y, theta."""
        return self.mean[:3]

    @property
    def lines(self) -> Array:
        """(m, 2) alpha, r."""
        return self.mean[3 : self.size].reshape(-1, 2)


def initial_state(pose: Array | None = None, pose_covariance: Array | None = None) -> FilterState:
    """State without lines; the map's frame is by default where the robot starts."""
    mean, covariance = np.zeros(GROWTH), np.zeros((GROWTH, GROWTH), order="F")
    if pose is not None:
        mean[:3] = pose
    if pose_covariance is not None:
        covariance[:3, :3] = pose_covariance
    return FilterState(mean, covariance, 3)


def pose_covariance(state: FilterState) -> Array:
    """(3, 3) of x, y, theta in map."""
    return _block(state.covariance, 0, 3)


def gather(covariance: Array, index: IntArray) -> Array:
    """Rows and columns `index` (k,) of the symmetric matrix whose lower triangle is given, full (k, k)."""
    row, column = np.maximum.outer(index, index), np.minimum.outer(index, index)
    return covariance[row, column]


def _block(covariance: Array, first: int, count: int) -> Array:
    """(count, count) on the diagonal, from `first` on, full; for a few rows."""
    out = covariance[first : first + count, first : first + count].copy()
    for k in range(1, count):
        out[:k, k] = out[k, :k]
    return out


def _columns(state: FilterState, first: int, count: int) -> Array:
    """(size, count) columns of the full symmetric covariance, for a few columns."""
    P, n, last = state.covariance, state.size, first + count
    out = np.empty((count, n)).T
    out[last:] = P[last:n, first:last]
    out[:first] = P[first:last, :first].T
    out[first:last] = _block(P, first, count)
    return out


def predict(state: FilterState, increment: Array, noise: Array) -> FilterState:
    """Pose compounded with a motion, Eq. (6)-(8).

    increment : (3,) motion in the robot's frame.  noise : (3, 3), its covariance there.
    """
    by_pose, by_motion = se2.compose_jacobians(state.pose, increment)
    P, n = state.covariance, state.size
    P[:3, :3] = by_pose @ _block(P, 0, 3) @ by_pose.T + by_motion @ noise @ by_motion.T
    P[3:n, :3] = P[3:n, :3] @ by_pose.T
    state.mean[:3] = se2.compose(state.pose, increment)
    return state


def expected_lines(pose: Array, lines: Array) -> Array:
    """(m, 2) alpha, r of map lines (m, 2) as seen from the pose, Eq. (9)."""
    alpha, r = lines[:, 0], lines[:, 1]
    x, y, theta = pose.tolist()
    out = np.empty((len(lines), 2))
    out[:, 0] = se2.wrap(alpha - theta)
    out[:, 1] = r - x * np.cos(alpha) - y * np.sin(alpha)
    return out


def line_jacobians(pose: Array, alpha: Array) -> tuple[Array, Array]:
    """Derivatives of `expected_lines` by the pose (..., 2, 3) and by the line (..., 2, 2), Eq. (10).

    alpha : (...), of the map lines.
    """
    c, s = np.cos(alpha), np.sin(alpha)
    by_pose, by_line = np.zeros((*c.shape, 2, 3)), np.zeros((*c.shape, 2, 2))
    by_pose[..., 0, 2] = -1.0
    by_pose[..., 1, 0], by_pose[..., 1, 1] = -c, -s
    x, y, _ = pose.tolist()
    by_line[..., 0, 0] = by_line[..., 1, 1] = 1.0
    by_line[..., 1, 0] = x * s - y * c
    return by_pose, by_line


def stacked_jacobian(pose: Array, alpha: Array) -> Array:
    """(2 k, 3 + 2 k) of lines seen from the pose, by the pose and by each of the lines (k,) in turn, Eq. (10)."""
    k, pair = len(alpha), np.arange(len(alpha))
    by_pose, by_line = line_jacobians(pose, alpha)
    H = np.zeros((k, 2, 3 + 2 * k))
    H[..., :3] = by_pose
    H[..., 3:].reshape(k, 2, k, 2)[pair, :, pair] = by_line
    return H.reshape(2 * k, -1)


def add_blocks(matrix: Array, blocks: Array) -> None:
    """Add blocks (k, 2, 2) to those on the diagonal of a matrix (2 k, 2 k), in place."""
    k, pair = len(blocks), np.arange(len(blocks))
    matrix.reshape(k, 2, k, 2)[pair, :, pair] += blocks


def state_index(lines: IntArray) -> IntArray:
    """(3 + 2 k,) where the pose and the lines (k,) stand in the state."""
    index = np.arange(3 + 2 * len(lines))
    index[3::2] = 3 + 2 * lines
    index[4::2] = 4 + 2 * lines
    return index


def update(state: FilterState, lines: IntArray, observed: Array, noise: Array) -> tuple[FilterState, float]:
    """Correct by the matched pairs of a scan at once, linearised at the state as it is, Eq. (11)-(15).

    lines : (k,).  observed : (k, 2) alpha, r in base_link.  noise : (k, 2, 2), independent of each other.
    Returns the state and the normalised innovation squared.
    """
    k = len(lines)
    if k == 0:
        return state, 0.0
    seen = state.lines[lines]
    innovation = observed - expected_lines(state.pose, seen)
    innovation[:, 0] = se2.wrap(innovation[:, 0])
    columns = np.empty((3 + 2 * k, state.size))
    columns[:3] = _columns(state, 0, 3).T
    for pair, line in enumerate(lines.tolist()):
        columns[3 + 2 * pair : 5 + 2 * pair] = _columns(state, 3 + 2 * line, 2).T
    H = stacked_jacobian(state.pose, seen[:, 0])
    cross = H @ columns
    S = cross[:, state_index(lines)] @ H.T
    add_blocks(S, noise)
    return _correct(state, cross.T, S, innovation.ravel())


def constrain_equal(state: FilterState, first: int, second: int, noise: Array) -> FilterState:
    """Correct by the knowledge that two lines are one, up to `noise` (2, 2) of their difference."""
    i, j = 3 + 2 * first, 3 + 2 * second
    cross = _columns(state, i, 2) - _columns(state, j, 2)
    S = cross[i : i + 2] - cross[j : j + 2] + noise
    difference = state.mean[j : j + 2] - state.mean[i : i + 2]
    difference[0] = se2.wrap(difference[0])
    return _correct(state, cross, S, difference)[0]


def update_pose(state: FilterState, pose: Array, noise: Array) -> FilterState:
    """Correct by a pose (3,) known from elsewhere, with covariance `noise` (3, 3)."""
    cross = _columns(state, 0, 3)
    innovation = pose - state.pose
    innovation[2] = se2.wrap(innovation[2])
    return _correct(state, cross, cross[:3] + noise, innovation)[0]


def _correct(state: FilterState, cross: Array, S: Array, innovation: Array) -> tuple[FilterState, float]:
    """State corrected by an innovation (k,) with covariance S (k, k); cross : (size, k) = P H'."""
    L, failed = dpotrf(S, lower=1)
    if failed:
        raise BsmapError("the filter's innovation covariance is no longer positive definite")
    whitened = dtrsv(L, innovation, lower=1)
    W = np.zeros((len(state.mean), len(innovation)), order="F")
    W[: state.size] = dtrsm(1.0, L, cross, side=1, lower=1, trans_a=1)
    state.mean[:] += W @ whitened
    state.mean[2] = se2.wrap(state.mean[2])
    P = dsyrk(-1.0, W, beta=1.0, c=state.covariance, lower=1, overwrite_c=1)
    return FilterState(state.mean, P, state.size), float(whitened @ whitened)


def augment(state: FilterState, observed: Array, noise: Array) -> FilterState:
    """Append a line seen at (2,) alpha, r in base_link with covariance `noise` (2, 2), Eq. (4)-(5)."""
    state = _with_room(state, state.size + 2)
    x, y, theta = state.pose.tolist()
    alpha = float(observed[0]) + theta
    c, s = math.cos(alpha), math.sin(alpha)
    lever = y * c - x * s
    by_pose = np.array([[0.0, 0.0, 1.0], [c, s, lever]])
    by_observed = np.array([[1.0, 0.0], [lever, 1.0]])
    P, n = state.covariance, state.size
    cross = _columns(state, 0, 3) @ by_pose.T
    P[n : n + 2, :n] = cross.T
    P[n : n + 2, n : n + 2] = by_pose @ cross[:3] + by_observed @ noise @ by_observed.T
    state.mean[n : n + 2] = alpha, observed[1] + x * c + y * s
    return FilterState(state.mean, P, n + 2)


def insert(state: FilterState, line: Array, covariance: Array) -> FilterState:
    """Append a line (2,) alpha, r of the map with covariance (2, 2), independent of all the rest."""
    state = _with_room(state, state.size + 2)
    P, n = state.covariance, state.size
    P[n : n + 2, :n] = 0.0
    P[n : n + 2, n : n + 2] = covariance
    state.mean[n : n + 2] = line
    return FilterState(state.mean, P, n + 2)


def line_covariances(state: FilterState, lines: IntArray | None = None) -> Array:
    """(m, 2, 2) marginal covariances of the lines, by default of all."""
    first = 3 + 2 * (np.arange(len(state.lines)) if lines is None else lines)
    out = np.empty((len(first), 2, 2))
    out[:, 0, 0] = state.covariance[first, first]
    out[:, 0, 1] = out[:, 1, 0] = state.covariance[first + 1, first]
    out[:, 1, 1] = state.covariance[first + 1, first + 1]
    return out


def remove(state: FilterState, line: int) -> FilterState:
    """Marginalise a line out; the last line takes its place."""
    P, n, at = state.covariance, state.size, 3 + 2 * line
    if at != n - 2:
        last = _columns(state, n - 2, 2)
        P[at : at + 2, :at] = last[:at].T
        P[at + 2 : n - 2, at : at + 2] = last[at + 2 : n - 2]
        P[at : at + 2, at : at + 2] = last[n - 2 :]
        state.mean[at : at + 2] = state.mean[n - 2 : n]
    P[n - 2 : n, :n] = 0.0
    state.mean[n - 2 : n] = 0.0
    return FilterState(state.mean, P, n - 2)


def _with_room(state: FilterState, size: int) -> FilterState:
    capacity = len(state.mean)
    if size <= capacity:
        return state
    grown = capacity + GROWTH
    mean, covariance = np.zeros(grown), np.zeros((grown, grown), order="F")
    mean[:capacity], covariance[:capacity, :capacity] = state.mean, state.covariance
    return FilterState(mean, covariance, state.size)
