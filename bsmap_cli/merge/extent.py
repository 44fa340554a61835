"""Surfaces over a plane that reach as far as their outlines: corners may lie beyond a surface's own rectangle."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from bsmap_cli.core.bspline import clamped_knots, design_matrix, inner_knots
from bsmap_cli.fit.heights import HeightField, greville
from bsmap_cli.merge.regions import GRID
from bsmap_cli.merge.shapes import Shape, parameters_along
from bsmap_cli.merge.topology import Ring
from bsmap_cli.model import Array, BSplineSurface, HeightCovariance, TrimLoop


def trimmed(surface: BSplineSurface, rings: Sequence[Ring], shape: Shape) -> BSplineSurface:
    """The surface with these outlines; one over a plane is extended where they lie beyond it.

    shape : that of the surface.
    """
    found = [parameters_along(shape, ring.points) for ring in rings]
    low, high = np.zeros(2), np.ones(2)
    if isinstance(shape, HeightField):
        lowest, highest = (f([f(uv, axis=0) for uv in found], axis=0) for f in (np.min, np.max))
        if (np.maximum(-lowest, highest - 1.0) * (shape.high - shape.low)).max() > 2.0 * GRID:
            low, high = np.minimum(lowest, 0.0), np.maximum(highest, 1.0)
            surface = extended(surface, low, high)
    inside = (np.clip((uv - low) / (high - low), 0.0, 1.0) for uv in found)
    loops = (TrimLoop(uv, ring.edges, ring.rims) for uv, ring in zip(inside, rings, strict=True))
    return replace(surface, trims=tuple(loops))


def extended(surface: BSplineSurface, low: Array, high: Array) -> BSplineSurface:
    """The same surface over the parameters from `low` (2,) <= 0 to `high` (2,) >= 1, without its trims.

    Beyond its ends it goes on straight, as height fields do; the new control points are linear in the old ones, and so
    is their covariance.
    """
    assert isinstance(surface.covariance, HeightCovariance)
    knots_u, by_u = _carry(surface.knots_u, surface.degree_u, low[0], high[0])
    knots_v, by_v = _carry(surface.knots_v, surface.degree_v, low[1], high[1])
    both = np.kron(by_u, by_v)
    matrix = both @ surface.covariance.matrix @ both.T
    return replace(
        surface,
        knots_u=knots_u,
        knots_v=knots_v,
        control_points=np.einsum("ai,bj,ijd->abd", by_u, by_v, surface.control_points),
        covariance=replace(surface.covariance, matrix=(matrix + matrix.T) / 2.0),
        trims=(),
    )


def _carry(knots: Array, degree: int, low: float, high: float) -> tuple[Array, Array]:
    """Knots over [low, high] brought to [0, 1], and the matrix (m, n) from old to new control points.

    With knots at the old ends, so many that only value and slope are the same on both sides of them.
    """
    ends = [end for end, beyond in ((0.0, low < 0.0), (1.0, high > 1.0)) if beyond for _ in range(degree - 1)]
    inner = np.append(inner_knots(knots, degree), ends)
    new = clamped_knots(degree, (inner - low) / (high - low))
    at = low + greville(new, degree) * (high - low)
    inside = np.clip(at, 0.0, 1.0)
    straight = (at - inside)[:, None] * design_matrix(knots, degree, inside, 1)
    basis = design_matrix(new, degree, (at - low) / (high - low))
    return new, np.asarray(np.linalg.solve(basis, design_matrix(knots, degree, inside) + straight), dtype=np.float64)
