"""How smooth height fields are held where no data tell: second differences of their heights."""

from functools import lru_cache

import numpy as np

from bsmap_cli.fit.heights import Knots
from bsmap_cli.model import Array

SMOOTH = 0.3
"""Metres: second differences of the heights are of this size or less, and no larger than the spans are long. Only where
there are no data does it matter."""


def smoothness(knots: Knots, size: Array | None = None) -> Array:
    """Information of second differences of neighbouring heights (first mixed ones of a bilinear patch are free).

    size : (2,) metres of the rectangle; where not given, spans are taken to be longer than SMOOTH.
    """
    spans = np.array(knots.shape) - (knots.degree_s, knots.degree_t)
    loose = np.full(2, SMOOTH) if size is None else np.minimum(SMOOTH, size / spans)
    along_s, along_t, every = _smoothness(*knots.shape)
    return along_s / loose[0] ** 2 + along_t / loose[1] ** 2 + every


@lru_cache(maxsize=256)
def _smoothness(ns: int, nt: int) -> tuple[Array, Array, Array]:
    """Squares of second differences along s and along t, and what keeps heights that no others bear."""
    rows = np.kron(_second(ns), np.eye(nt)), np.kron(np.eye(ns), _second(nt))
    out = rows[0].T @ rows[0], rows[1].T @ rows[1], 1e-6 / SMOOTH**2 * np.eye(ns * nt)
    for matrix in out:
        matrix.flags.writeable = False
    return out


def _second(n: int) -> Array:
    return np.diff(np.eye(n), 2, axis=0) if n > 2 else np.zeros((1, n))
