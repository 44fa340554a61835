"""Which side of a surface the sensor saw: the two faces of a thin wall look opposite ways and are never one.

A surface map does not hold the sensor's path, only the centre of each data set. The side is therefore voted for: along
u (the scan line) the normal S_u x S_v can change sides, as it does at the zenith of a rotation, where v runs forward on
the one side and back on the other; along v it does not. So all points of one u vote together, each by how squarely it
looks at the centre: recesses seen at a slant from there do not turn the wall around them.
"""

from typing import NamedTuple

import numpy as np

from bsmap_cli.core.pieces import Pieces, evaluate_pieces
from bsmap_cli.model import Array, BSplineSurface

SENSOR_HEIGHT = 0.5
"""Metres above the ground (z = 0) at which the sensor is taken to be: above the floor, below any ceiling."""
VOTES_U, VOTES_V = 96, 32


class Facing(NamedTuple):
    """Visible side of a surface, or of a piece of it.

    signs : (k,) +1 or -1 for k equal parts of u, -1 where S_u x S_v points away from the sensor.
    start, end : the piece's interval of u, in the parameter of the surface for which the signs were found.
    """

    signs: Array
    start: float = 0.0
    end: float = 1.0

    def at(self, u: Array) -> Array:
        """Signs (n,) at parameters u (n,) of the piece."""
        whole = self.start + (self.end - self.start) * u
        return self.signs[np.clip((whole * len(self.signs)).astype(int), 0, len(self.signs) - 1)]

    def piece(self, a: float, b: float) -> "Facing":
        """Facing of the part [a, b] of this piece."""
        width = self.end - self.start
        return Facing(self.signs, self.start + width * a, self.start + width * b)


def sensor_position(surface: BSplineSurface) -> Array:
    """Mean place (3,) in map of the sensors that saw a surface: the centres of its data sets, by their shares."""
    shares = np.array([part.weight for part in surface.covariance.pose])
    centres = np.array([part.centre for part in surface.covariance.pose])
    return np.append(shares @ centres / shares.sum(), SENSOR_HEIGHT)


def visible_side(surface: BSplineSurface, pieces: Pieces) -> Facing:
    """Find the side of a surface that looks at its sensor; `pieces` are its own."""
    u, v = (np.arange(VOTES_U) + 0.5) / VOTES_U, (np.arange(VOTES_V) + 0.5) / VOTES_V
    grid_u, grid_v = np.meshgrid(u, v, indexing="ij")
    S, Su, Sv = evaluate_pieces(pieces, grid_u.ravel(), grid_v.ravel(), 1).transpose(0, 2, 1)
    towards = sensor_position(surface) - S
    towards /= np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-12)
    votes = np.einsum("nk,nk->n", np.cross(Su, Sv), towards).reshape(VOTES_U, VOTES_V).sum(axis=1)
    return Facing(np.where(votes < 0.0, -1.0, 1.0))


def visible_normals(pieces: Pieces, facing: Facing, u: Array, v: Array) -> Array:
    """Unit normals (n, 3) on the visible side at parameters u, v (n,); zero where the surface has a pole."""
    return seen_points(pieces, facing, u, v)[1]


def seen_points(pieces: Pieces, facing: Facing, u: Array, v: Array) -> tuple[Array, Array]:
    """Points (n, 3) of a surface and their normals as in `visible_normals`."""
    S, Su, Sv = evaluate_pieces(pieces, u, v, 1).transpose(0, 2, 1)
    normals = np.cross(Su, Sv)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = facing.at(u)[:, None] * np.divide(normals, lengths, out=np.zeros_like(normals), where=lengths > 1e-12)
    return S, normals
