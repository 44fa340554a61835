"""Modes: what the errors of many poses have in common, columns of L where their covariance is L L' and own parts."""

import numpy as np

from bsmap_cli.model import Array

MOST_MODES = 12
"""Told of a trajectory at most."""
LEAST_SHARE = 0.01
"""Of the sum of variances, that a mode must have to be told."""
LEVER = 3.0
"""Metres at which an error of heading counts as one of position, for the choice of modes: where points are seen."""


def largest_positive(vectors: Array) -> Array:
    """Columns (n, k) turned so that the entry of the largest size is positive: a mode's sign is free, and so fixed."""
    largest = vectors[np.argmax(np.abs(vectors), axis=0), np.arange(vectors.shape[1])]
    return vectors * np.where(largest < 0.0, -1.0, 1.0)
