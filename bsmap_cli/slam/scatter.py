"""How much each sighting of a line counts, as what is left of the errors tells: variance components.

The covariance of a segment is that of the noise of its points and a floor, for no wall is flat (method.md section 1).
How large either really is differs from building to building; and single lines, such as chords of a curved wall, scatter
more than the others.
"""

import numpy as np
from scipy.optimize import nnls

from bsmap_cli.model import Array
from bsmap_cli.slam.posegraph import ROBUST_WIDTH
from bsmap_cli.slam.segments import Segments
from bsmap_cli.slam.sightings import Sightings, errors

PRIOR_FREEDOM = 10.0
"""Degrees of freedom with which all lines together speak for the scatter of one."""
OFTEN = 5
"""Sightings from which on a line tells of its errors: one seen less often follows them."""
FEWEST = 50
"""Sightings of such lines without which the covariances stay as they are."""
LEAST_FLOOR = 0.05
"""Of the variance of the floor, what is kept: a bump in a wall is the same in every scan, so that nothing shows it."""
ROUNDS = 5


def weighed(poses: Array, lines: Array, sightings: Sightings, segments: Segments, floors: Array) -> Sightings:
    """Sightings with the information that their errors at `poses` (n, 3) and `lines` (m, 2) bear out.

    floors : (2,) standard deviations of the floors, in direction and in the middle of a segment: radians, metres.
    """
    return by_scatter(poses, lines, by_parts(poses, lines, sightings, segments, floors))


def by_parts(poses: Array, lines: Array, sightings: Sightings, segments: Segments, floors: Array) -> Sightings:
    """With noise and floor each as large as the errors of all sightings tell.

    Where its points are centred, direction and offset of a segment are independent: there each has a variance that is
    a sum of both parts, and a regression of the squared errors on these gives their scales.
    """
    covariance = segments.covariances[sightings.segment]
    centre = covariance[:, 0, 1] / covariance[:, 0, 0]
    both = np.stack([covariance[:, 0, 0], covariance[:, 1, 1] - centre * covariance[:, 0, 1]], axis=1)
    floor = np.minimum(floors**2, both)
    noise = both - floor
    error = errors(poses, lines, sightings)
    error[:, 1] -= centre * error[:, 0]
    often = np.bincount(sightings.line, minlength=len(lines))[sightings.line] >= OFTEN
    if np.count_nonzero(often) < FEWEST:
        return sightings
    scales = np.ones(2)
    for _ in range(ROUNDS):
        now = (scales[0] * noise + scales[1] * floor)[often]
        distance = error[often] ** 2 / now
        distance /= 1.0 + distance / ROBUST_WIDTH
        parts = np.stack([(noise[often] / now).ravel(), (floor[often] / now).ravel()], axis=1)
        scales = nnls(parts, distance.ravel())[0]
        scales = np.maximum(scales, [LEAST_FLOOR, LEAST_FLOOR * max(1.0, scales[0])])
    along, middle = 1.0 / (scales[0] * noise + scales[1] * floor).T
    # With offset = r - centre * alpha, the information of (alpha, offset), which is diagonal, as that of (alpha, r).
    information = np.stack([along + centre**2 * middle, -centre * middle, -centre * middle, middle], axis=1)
    return sightings._replace(information=information.reshape(-1, 2, 2))


def by_scatter(poses: Array, lines: Array, sightings: Sightings) -> Sightings:
    """With less information for lines whose sightings agree less than those of the others do.

    A chord of a curved wall or an edge of clutter is another one in every scan; the noise of its points does not tell
    that, what is left of its errors does. Each line gets a variance of its own where that is above the common one,
    drawn towards it by PRIOR_FREEDOM.
    """
    error = errors(poses, lines, sightings)
    own = np.ones(len(lines))
    freedom = 2.0 * np.bincount(sightings.line, minlength=len(lines))
    for _ in range(3):
        distance = np.einsum("mi,mij,mj->m", error, sightings.information, error) / own[sightings.line]
        distance /= 1.0 + distance / ROBUST_WIDTH
        common = distance.sum() / max(2.0 * len(distance), 1.0)
        each = np.bincount(sightings.line, weights=distance, minlength=len(lines))
        own *= (each + PRIOR_FREEDOM * common) / ((freedom + PRIOR_FREEDOM) * max(common, 1e-12))
        own = np.maximum(own, 1.0)
    return sightings._replace(information=sightings.information / own[sightings.line, None, None])
