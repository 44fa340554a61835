"""How much each sighting of a line counts, as what is left of the errors tells: variance components.

The covariance of a segment is that of the noise of its points and a floor, for no wall is flat (method.md section 1).
How large either really is differs from building to building; and single lines, such as chords of a curved wall, scatter
more than the others.
"""

import numpy as np
from scipy import sparse
from scipy.optimize import nnls
from scipy.sparse.linalg import SuperLU

from bsmap_cli.model import Array
from bsmap_cli.slam.posegraph import ROBUST_WIDTH, entries, robust_means
from bsmap_cli.slam.segments import Segments
from bsmap_cli.slam.sightings import Sightings, derivatives, errors

PRIOR_FREEDOM = 10.0
"""Degrees of freedom with which all lines together speak for the scatter of one."""
OFTEN = 5
"""Sightings from which on a line tells of its errors: one seen less often follows them."""
FEWEST = 50
"""Sightings of such lines without which the covariances stay as they are."""
LEAST_FLOOR = 0.05
"""Of the variance of the floor, what is kept: a bump in a wall is the same in every scan, so that nothing shows it."""
ROUNDS, PROBES = 5, 16


def weighed(
    poses: Array, lines: Array, sightings: Sightings, segments: Segments, floors: Array, factors: SuperLU | None
) -> Sightings:
    """Sightings with the information that their errors at `poses` (n, 3) and `lines` (m, 2) bear out.

    floors : (2,) standard deviations of the floors, in direction and in the middle of a segment: radians, metres.
    factors : of the information of all poses but the first and all lines, as these were found; None where they were
    not fitted to the sightings yet, so that nothing is told by these: they stay as they are.
    """
    if factors is None:
        return sightings
    covariance = segments.covariances[sightings.segment]
    fitted = fitted_variances(poses, lines, sightings, covariance, factors)
    return by_scatter(poses, lines, by_parts(poses, lines, sightings, covariance, floors, fitted), fitted)


def centred(covariance: Array) -> tuple[Array, Array]:
    """Where along it direction and offset of a segment are independent (m,), and their variances there (m, 2)."""
    centre = covariance[:, 0, 1] / covariance[:, 0, 0]
    return centre, np.stack([covariance[:, 0, 0], covariance[:, 1, 1] - centre * covariance[:, 0, 1]], axis=1)


def centred_errors(poses: Array, lines: Array, sightings: Sightings, centre: Array) -> Array:
    """(m, 2) errors in direction and in the offset at `centre` (m,)."""
    error = errors(poses, lines, sightings)
    error[:, 1] -= centre * error[:, 0]
    return error


def fitted_variances(poses: Array, lines: Array, sightings: Sightings, covariance: Array, factors: SuperLU) -> Array:
    """(m, 2) variances, centred, of what poses and lines make of each sighting: those its error at them lacks.

    For they were fitted to it (the leverage of regression). The diagonal of A N^-1 A' by random vectors of signs
    (Bekas, Kokiopoulou and Saad 2007); the seed is fixed, so that the same data give the same variances.
    """
    centre, both = centred(covariance)
    by_pose, by_line = derivatives(poses, lines, sightings)
    for part in (by_pose, by_line):
        part[:, 1] -= centre[:, None] * part[:, 0]
    rows = 2 * np.arange(len(centre))
    places = [entries(rows, 3 * sightings.pose, by_pose), entries(rows, 3 * len(poses) + 2 * sightings.line, by_line)]
    row, column = (np.concatenate([place[k] for place in places]) for k in (0, 1))
    shape = (2 * len(centre), 3 * len(poses) + 2 * len(lines))
    A = sparse.csr_matrix((np.concatenate([by_pose.ravel(), by_line.ravel()]), (row, column)), shape)[:, 3:]
    # Each in units of its deviation, so that those of large variances do not drown the others.
    deviation = np.sqrt(both).reshape(-1, 1)
    signs = np.random.default_rng(0).choice([-1.0, 1.0], size=(shape[0], PROBES))
    found = A @ factors.solve(A.T @ (signs / deviation))
    return np.maximum((found * signs * deviation).mean(axis=1), 0.0).reshape(-1, 2)


def by_parts(
    poses: Array, lines: Array, sightings: Sightings, covariance: Array, floors: Array, fitted: Array
) -> Sightings:
    """With noise and floor each as large as the errors of all sightings tell.

    Where its points are centred, direction and offset of a segment are independent: there each has a variance that is
    a sum of both parts, and a regression of the squared errors on these gives their scales.

    covariance : (m, 2, 2), of the segments.  fitted : (m, 2), variances that the errors lack.
    """
    centre, both = centred(covariance)
    floor = np.minimum(floors**2, both)
    noise = both - floor
    often = np.bincount(sightings.line, minlength=len(lines))[sightings.line] >= OFTEN
    if np.count_nonzero(often) < FEWEST:
        return sightings
    squares = (centred_errors(poses, lines, sightings, centre) ** 2 + fitted)[often]
    scales = np.ones(2)
    for _ in range(ROUNDS):
        now = (scales[0] * noise + scales[1] * floor)[often]
        distance = squares / now
        distance /= 1.0 + distance / ROBUST_WIDTH
        parts = np.stack([(noise[often] / now).ravel(), (floor[often] / now).ravel()], axis=1)
        scales = nnls(parts, distance.ravel() / robust_means(1)[1])[0]
        scales = np.maximum(scales, [LEAST_FLOOR, LEAST_FLOOR * max(1.0, scales[0])])
    along, middle = 1.0 / (scales[0] * noise + scales[1] * floor).T
    # With offset = r - centre * alpha, the information of (alpha, offset), which is diagonal, as that of (alpha, r).
    information = np.stack([along + centre**2 * middle, -centre * middle, -centre * middle, middle], axis=1)
    return sightings._replace(information=information.reshape(-1, 2, 2))


def by_scatter(poses: Array, lines: Array, sightings: Sightings, fitted: Array) -> Sightings:
    """With less information for lines whose sightings agree less than those of the others do.

    A chord of a curved wall or an edge of clutter is another one in every scan; the noise of its points does not tell
    that, what is left of its errors does. Each line gets a variance of its own where that is above the common one,
    drawn towards it by PRIOR_FREEDOM, less what chance may do (its standard deviation).

    fitted : (m, 2), variances that the errors lack.
    """
    centre, variances = centred(np.asarray(np.linalg.inv(sightings.information), dtype=np.float64))
    squares = centred_errors(poses, lines, sightings, centre) ** 2 + fitted
    own = np.ones(len(lines))
    freedom = 2.0 * np.bincount(sightings.line, minlength=len(lines))
    for _ in range(3):
        distance = (squares / variances).sum(axis=1) / own[sightings.line]
        distance /= 1.0 + distance / ROBUST_WIDTH
        common = distance.sum() / max(2.0 * len(distance), 1.0)
        each = np.bincount(sightings.line, weights=distance, minlength=len(lines))
        own *= (each + PRIOR_FREEDOM * common) / ((freedom + PRIOR_FREEDOM) * max(common, 1e-12))
        own = np.maximum(own, 1.0)
    own = np.maximum(own / (1.0 + np.sqrt(2.0 / (freedom + PRIOR_FREEDOM))), 1.0)
    return sightings._replace(information=sightings.information / own[sightings.line, None, None])
