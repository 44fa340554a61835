"""How much each sighting of a line counts, as what is left of the errors tells: variance components.

The covariance of a segment is that of the noise of its points and a floor, for no wall is flat (method.md section 1).
How large either really is differs from laser to laser and from building to building; and single lines, such as chords
of a curved wall, scatter more than the others.
"""

import numpy as np
from scipy import sparse
from scipy.optimize import nnls
from scipy.sparse.linalg import SuperLU

from bsmap_cli.model import Array, IntArray
from bsmap_cli.slam.posegraph import ROBUST_WIDTH, entries, probes, robust_means
from bsmap_cli.slam.segments import Segments
from bsmap_cli.slam.sightings import Sightings, derivatives, errors

PRIOR_FREEDOM = 10.0
"""Degrees of freedom with which all lines together speak for the scatter of one."""
OFTEN = 5
"""Sightings from which on a line tells of its errors: one seen less often follows them."""
FEWEST = 50
"""Sightings of such lines without which the covariances stay as they are."""
LEAST_NOISE = LEAST_FLOOR = 0.02
"""Of the variances of noise and of the floor, what is kept: a bump in a wall is the same in every scan, so that nothing
shows it."""
LEAST_LEFT = 0.05
"""Share of a variance that an error must still have, however much was fitted to it."""
ROUNDS, STEPS = 3, 5
"""Of all lines' scales and single lines' in turn; of either in itself."""


def weighed(
    poses: Array, lines: Array, sightings: Sightings, segments: Segments, floors: Array, factors: SuperLU
) -> Sightings:
    """Sightings with the information that their errors at `poses` (n, 3) and `lines` (m, 2) bear out.

    sightings : with the information by which poses and lines were found.  floors : (2,) standard deviations of the
    floors, in direction and in the middle of a segment: radians, metres.  factors : of the information of all poses but
    the first and all lines.
    """
    centre, told = centred(segments.covariances[sightings.segment])
    parts = variance_parts(told, segments.angular[sightings.segment], floors)
    squares = centred_errors(poses, lines, sightings, centre) ** 2
    left = left_over(poses, lines, sightings, centre, factors)
    often = np.bincount(sightings.line, minlength=len(lines))[sightings.line] >= OFTEN
    telling = often & ~sightings.rival.any(axis=1)
    scales, own = np.ones(len(parts)), np.ones(len(lines))
    for _ in range(ROUNDS):
        if np.count_nonzero(telling) >= FEWEST:
            each = own[sightings.line][telling, None]
            scales = by_parts(squares[telling], left[telling], parts[:, telling] * each)
        variances = np.tensordot(scales, parts, axes=1)
        own = by_scatter(squares, left, variances, sightings.line, len(lines))
    along, middle = 1.0 / (variances * own[sightings.line, None] + sightings.rival).T
    # With offset = r - centre * alpha, the information of (alpha, offset), which is diagonal, as that of (alpha, r).
    information = np.stack([along + centre**2 * middle, -centre * middle, -centre * middle, middle], axis=1)
    return sightings._replace(information=information.reshape(-1, 2, 2))


def centred(covariance: Array) -> tuple[Array, Array]:
    """Where along it direction and offset of a segment are independent (m,), and their variances there (m, 2)."""
    centre = covariance[:, 0, 1] / covariance[:, 0, 0]
    return centre, np.stack([covariance[:, 0, 0], covariance[:, 1, 1] - centre * covariance[:, 0, 1]], axis=1)


def centred_errors(poses: Array, lines: Array, sightings: Sightings, centre: Array) -> Array:
    """(m, 2) errors in direction and in the offset at `centre` (m,)."""
    error = errors(poses, lines, sightings)
    error[:, 1] -= centre * error[:, 0]
    return error


def variance_parts(told: Array, angular: Array, floors: Array) -> Array:
    """(3, m, 2) variances by the noise of ranges, by that of the beams' directions, and by the floor.

    told, angular : (m, 2) of all, and by the beams' directions.  floors : (2,) standard deviations.
    """
    floor = np.minimum(floors**2, told)
    return np.stack([np.maximum(told - floor - angular, 0.0), angular, floor])


def left_over(poses: Array, lines: Array, sightings: Sightings, centre: Array, factors: SuperLU) -> Array:
    """(m, 2) share of its variance that each error still has: one less its leverage, for poses and lines were fitted.

    The diagonal of A N^-1 A' by random vectors of signs (Bekas, Kokiopoulou and Saad 2007), over the variances that
    made N.
    """
    by_pose, by_line = derivatives(poses, lines, sightings)
    for part in (by_pose, by_line):
        part[:, 1] -= centre[:, None] * part[:, 0]
    rows = 2 * np.arange(len(centre))
    places = [entries(rows, 3 * sightings.pose, by_pose), entries(rows, 3 * len(poses) + 2 * sightings.line, by_line)]
    row, column = (np.concatenate([place[k] for place in places]) for k in (0, 1))
    shape = (2 * len(centre), 3 * len(poses) + 2 * len(lines))
    A = sparse.csr_matrix((np.concatenate([by_pose.ravel(), by_line.ravel()]), (row, column)), shape)[:, 3:]
    variances = centred(np.asarray(np.linalg.inv(sightings.information), dtype=np.float64))[1]
    # Each in units of its deviation, so that those of large variances do not drown the others.
    deviation = np.sqrt(variances).reshape(-1, 1)
    signs = probes(*shape)
    fitted = (A @ factors.solve(A.T @ (signs / deviation)) * signs / deviation).mean(axis=1).reshape(-1, 2)
    # Robust weights made N smaller by their mean.
    return np.clip(1.0 - robust_means(2).weight * fitted, LEAST_LEFT, 1.0)


def by_parts(squares: Array, left: Array, parts: Array) -> Array:
    """(3,) scales of the parts of the variances, each as large as the errors of all sightings tell.

    A regression of the squared errors, robust, on the shares of the parts in their variances.

    squares : (m, 2) of the centred errors.  left : (m, 2), see `left_over`.  parts : (3, m, 2) variances.
    """
    scales = np.ones(len(parts))
    for _ in range(STEPS):
        now = np.tensordot(scales, parts, axes=1)
        distance = squares / (now * left)
        distance *= left / (1.0 + distance / ROBUST_WIDTH)
        shares = (parts * (left / now)).reshape(len(parts), -1)
        # The same as by all rows: only their products count.
        root = np.linalg.cholesky(shares @ shares.T + np.diag(np.full(len(parts), 1e-9)))
        scales = nnls(root.T, np.linalg.solve(root, shares @ distance.ravel() / robust_means(1).distance))[0]
        scales[0] = max(scales[0], LEAST_NOISE)
        scales[2] = max(scales[2], LEAST_FLOOR * max(1.0, scales[0]))
    return scales


def by_scatter(squares: Array, left: Array, variances: Array, line: IntArray, count: int) -> Array:
    """(count,) factors of the variances of lines whose sightings agree less than those of the others do.

    A chord of a curved wall or an edge of clutter is another one in every scan; the noise of its points does not tell
    that, what is left of its errors does. Each line gets a variance of its own where that is above the common one,
    drawn towards it by PRIOR_FREEDOM, less what chance may do (its standard deviation).

    squares, left : (m, 2) as for `by_parts`.  variances : (m, 2).  line : (m,), below `count`.
    """
    freedom = np.bincount(line, weights=left.sum(axis=1), minlength=count) + PRIOR_FREEDOM
    own = np.ones(count)
    for _ in range(STEPS):
        distance = (squares / (variances * left)).sum(axis=1) / own[line]
        distance *= left.sum(axis=1) / (1.0 + distance / ROBUST_WIDTH) / robust_means(2).distance
        each = np.bincount(line, weights=distance, minlength=count)
        own = np.maximum(own * (each + PRIOR_FREEDOM) / freedom, 1.0)
    return np.maximum(own / (1.0 + np.sqrt(2.0 / freedom)), 1.0)
