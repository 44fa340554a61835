"""Small faces in what is left: planes through neighbouring beams of no face, by random samples (RANSAC).

Narrow faces (the side of a recess, a window's reveal) have too few beams in a scan for a piece, and furniture breaks
scan lines into many; together with the neighbouring scans they are planes all the same.
"""

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from bsmap_cli.fit.beams import BeamGrid
from bsmap_cli.model import Array, IntArray

FEWEST, FEWEST_SCANS = 16, 3
"""Beams and scans of a plane."""
SAMPLES = 80
"""Triples tried for each plane."""
TRIED = 10
"""Planes of the sample that are looked at, those with the most beams."""
PLANES = 8
"""Tried for in one connected patch of the rest."""
WITHIN = 3.0
"""Standard deviations along the beam that a plane's beams may lie off it."""
NOISY = 1.25
"""Standard deviations that they may in the mean of squares: points spread evenly over the gate have 1.7."""
INCIDENCE = 0.15
"""Smallest sine between beams and plane."""
REACH_SCANS, REACH_BEAMS = 4, 10
"""Of a triple around its first beam."""
EIGHT = np.ones((3, 3), dtype=int)


def find_planes(grid: BeamGrid, labels: IntArray, sigma: float, rng: np.random.Generator) -> IntArray:
    """Labels with new numbers for planes found among the beams of no face."""
    labels = labels.copy()
    patches, _ = ndimage.label((labels < 0) & grid.hit)
    for number, window in enumerate(ndimage.find_objects(patches), start=1):
        row, column = np.nonzero(patches[window] == number)
        rest = np.column_stack([row + window[0].start, column + window[1].start])
        for _ in range(PLANES):
            if len(rest) < FEWEST:
                break
            inside = _best_plane(grid, rest, sigma, rng)
            if inside is None:
                break
            labels[tuple(rest[inside].T)] = labels.max() + 1
            rest = rest[~inside]
    return labels


def _best_plane(grid: BeamGrid, rest: IntArray, sigma: float, rng: np.random.Generator) -> NDArray[np.bool_] | None:
    """Which of the beams (k, 2) lie on the plane with most of them, in one connected patch; None without any."""
    points, directions = grid.points[tuple(rest.T)], grid.directions[tuple(rest.T)]
    normals, offsets = _sampled_planes(points, rest, rng)
    if not len(normals):
        return None
    sine = normals @ directions.T
    miss = np.abs(offsets[:, None] - normals @ points.T) / np.maximum(np.abs(sine), INCIDENCE)
    inside = (miss < WITHIN * sigma) & (np.abs(sine) > INCIDENCE)
    # Beams all over a large patch lie in one plane by chance: those in one piece count.
    best = np.argsort(-inside.sum(axis=1), kind="stable")[:TRIED]
    masks = sorted((_connected(rest, inside[k]) for k in best), key=lambda mask: -int(mask.sum()))
    planes = (_settled_plane(points, directions, rest, mask, sigma) for mask in masks)
    return next((mask for mask in planes if mask is not None), None)


def _settled_plane(
    points: Array, directions: Array, rest: IntArray, mask: NDArray[np.bool_], sigma: float
) -> NDArray[np.bool_] | None:
    """Which of the beams (k, 2) lie on the plane through those of a mask (k,); None where these are no plane."""
    for _ in range(2):
        if mask.sum() < FEWEST:
            return None
        centre = points[mask].mean(axis=0)
        normal = np.linalg.eigh(np.cov((points[mask] - centre).T))[1][:, 0]
        sine = directions @ normal
        beyond = (points - centre) @ normal / np.where(np.abs(sine) > INCIDENCE, sine, np.inf)
        mask = _connected(rest, (np.abs(beyond) < WITHIN * sigma) & (np.abs(sine) > INCIDENCE))
    if mask.sum() < FEWEST or len(np.unique(rest[mask, 0])) < FEWEST_SCANS:
        return None
    return mask if np.sqrt(np.mean(beyond[mask] ** 2)) < NOISY * sigma else None


def _sampled_planes(points: Array, rest: IntArray, rng: np.random.Generator) -> tuple[Array, Array]:
    """Unit normals (k, 3) and offsets (k,) of planes through triples of beams near each other in the grid."""
    normals, offsets = [], []
    for first in rng.integers(len(rest), size=SAMPLES).tolist():
        away = np.abs(rest - rest[first])
        near = np.flatnonzero((away[:, 0] <= REACH_SCANS) & (away[:, 1] <= REACH_BEAMS))
        if len(near) < 3:
            continue
        start = points[first]
        second, third = rng.choice(near, 2, replace=False)
        normal = np.cross(points[second] - start, points[third] - start)
        length = np.linalg.norm(normal)
        if length > 1e-4:
            normals.append(normal / length)
            offsets.append(float(normal @ start / length))
    return np.array(normals).reshape(-1, 3), np.array(offsets)


def _connected(rest: IntArray, inside: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The largest patch of neighbouring beams among those inside."""
    if not inside.any():
        return inside
    low = rest.min(axis=0)
    image = np.zeros(rest.max(axis=0) - low + 1, dtype=bool)
    at = tuple((rest - low).T)
    image[at] = inside
    patches, _ = ndimage.label(image, EIGHT)
    sizes = np.bincount(patches.ravel())
    sizes[0] = 0
    return np.asarray(patches[at] == int(np.argmax(sizes)))
