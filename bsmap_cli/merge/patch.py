"""Pieces of surfaces: cutting them along iso-parametric lines without changing their shape."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bsmap_cli.core.bspline import design_matrix, restrict
from bsmap_cli.core.projection import project
from bsmap_cli.core.sampling import OFFSET, Samples, sample_surface
from bsmap_cli.merge.covariance import carry
from bsmap_cli.merge.facing import Facing, visible_normals, visible_side
from bsmap_cli.model import Array, BSplineSurface

OVERHANG = 0.02
"""Metres a point may lie outside a patch's edge and still count as on it: edges of patches are known no better."""
EVENLY = np.linspace(0.0, 1.0, 33)
"""Parameters across which lengths are means."""


class Window(NamedTuple):
    """Rectangle of the parameter domain."""

    u0: float
    u1: float
    v0: float
    v1: float


WHOLE = Window(0.0, 1.0, 0.0, 1.0)


@dataclass(frozen=True)
class Patch:
    """A surface on its way into the map, with what the search for overlaps needs at hand.

    box : (2, 3) lowest and highest coordinates of the control points; they enclose the surface.
    size : lengths along u and v in metres, means over the other direction.
    root : name of the surfaces of which it is a piece.
    lines : control points of curves spread evenly over the other direction, along u (nu, k, 3) and along v (nv, k, 3).
    """

    surface: BSplineSurface
    facing: Facing
    root: str
    samples: Samples
    box: Array
    size: tuple[float, float]
    lines: tuple[Array, Array]


class Landing(NamedTuple):
    """Points projected on a patch.

    u, v : (n,) parameters of the feet.  foot, normal : (n, 3), the normal on the visible side.
    hit : (n,) bool, near enough, on the patch and seen from the same side.
    opposite : (n,) bool, near enough, on the patch, but seen from the other side.
    """

    u: Array
    v: Array
    foot: Array
    normal: Array
    hit: NDArray[np.bool_]
    opposite: NDArray[np.bool_]


def make_patch(surface: BSplineSurface, facing: Facing | None = None, root: str = "") -> Patch:
    """Patch of a surface; without `facing` its visible side is found from its data sets' centres."""
    samples = sample_surface(surface)
    facing = visible_side(surface, samples.pieces) if facing is None else facing
    corners = surface.control_points.reshape(-1, 3)
    box = np.stack([corners.min(axis=0), corners.max(axis=0)])
    lines = _lines(surface)
    size = _line_length(surface, lines, 0, EVENLY), _line_length(surface, lines, 1, EVENLY)
    return Patch(surface, facing, root or surface.name, samples, box, size, lines)


def _lines(surface: BSplineSurface) -> tuple[Array, Array]:
    at_u = design_matrix(surface.knots_u, surface.degree_u, EVENLY)
    at_v = design_matrix(surface.knots_v, surface.degree_v, EVENLY)
    return at_v @ surface.control_points, np.tensordot(surface.control_points, at_u, (0, 1)).transpose(0, 2, 1)


def _line_length(surface: BSplineSurface, lines: tuple[Array, Array], axis: int, along: Array) -> float:
    """Mean length of the lines along an axis (0: u, 1: v), through the parameters `along` (n,)."""
    knots, degree = ((surface.knots_u, surface.degree_u), (surface.knots_v, surface.degree_v))[axis]
    n, k, _ = lines[axis].shape
    points = (design_matrix(knots, degree, along) @ lines[axis].reshape(n, -1)).reshape(-1, k, 3)
    steps = np.diff(points, axis=0)
    return float(np.sqrt(np.einsum("nkd,nkd->nk", steps, steps)).sum() / k)


def width(patch: Patch, axis: int, a: float, b: float) -> float:
    """Mean length in metres of the strip from parameter a to b along an axis (0: u, 1: v)."""
    if b <= a:
        return 0.0
    return _line_length(patch.surface, patch.lines, axis, np.linspace(a, b, 17))


def land(points: Array, normals: Array, target: Patch, distance: float) -> Landing:
    """Project points on a patch, section 9; only those whose nearest sample is near enough are worth a Newton step.

    Parameters
    ----------
    points, normals : (n, 3), the normals on the side from which the points are seen; zero: seen from any side.
    distance : metres, largest distance to a foot.
    """
    n = len(points)
    u, v, foot, normal = np.zeros(n), np.zeros(n), np.zeros((n, 3)), np.zeros((n, 3))
    on, same = np.zeros(n, dtype=bool), np.zeros(n, dtype=bool)
    close = _near(points, target, distance)
    if len(close):
        found = project(target.surface, points[close], target.samples, distance)
        u[close], v[close], foot[close] = found.u, found.v, found.foot
        normal[close] = visible_normals(target.samples.pieces, target.facing, found.u, found.v)
        r = points[close] - found.foot
        aside = np.linalg.norm(r - np.einsum("nk,nk->n", r, normal[close])[:, None] * normal[close], axis=1)
        on[close] = (found.distance <= distance) & (found.on_surface | (aside <= OVERHANG))
        same[close] = np.einsum("nk,nk->n", normals[close], normal[close]) >= 0.0
    return Landing(u, v, foot, normal, on & same, on & ~same)


def _near(points: Array, target: Patch, distance: float) -> NDArray[np.intp]:
    """Numbers of the points (n, 3) that can have a foot within `distance`: by the patch's box, then by its samples."""
    inside = np.flatnonzero(np.all((points >= target.box[0] - distance) & (points <= target.box[1] + distance), axis=1))
    if not len(inside):
        return inside
    grid = target.samples.fine
    gap, nearest = grid.tree.query(points[inside], distance_upper_bound=distance + float(grid.reach.max()))
    # A foot lies beside the sample that is nearest to it, at most by a share of the cell.
    return inside[np.asarray(gap) <= np.hypot(distance, OFFSET * np.append(grid.reach, 0.0)[nearest])]


def cut(patch: Patch, window: Window, name: str) -> Patch:
    """Part of a patch over a window, exact by knot insertion; its covariance goes by the same linear map."""
    surface = patch.surface
    along_u = restrict(surface.knots_u, surface.degree_u, window.u0, window.u1)
    along_v = restrict(surface.knots_v, surface.degree_v, window.v0, window.v1)
    area = width(patch, 0, window.u0, window.u1) * width(patch, 1, window.v0, window.v1)
    share = area / (patch.size[0] * patch.size[1])
    piece = replace(
        surface,
        name=name,
        knots_u=along_u.knots,
        knots_v=along_v.knots,
        control_points=np.einsum("ia,jb,abk->ijk", along_u.matrix, along_v.matrix, surface.control_points),
        covariance=carry(surface.covariance, along_u.matrix, along_v.matrix),
        residuals=replace(surface.residuals, points=round(surface.residuals.points * min(share, 1.0))),
    )
    return make_patch(piece, patch.facing.piece(window.u0, window.u1), patch.root)


def surroundings(patch: Patch, window: Window) -> list[Window]:
    """The at most four rectangles around a window, cut so that the cuts are short."""
    u0, u1, v0, v1 = window
    across_u = [Window(0.0, u0, 0.0, 1.0), Window(u1, 1.0, 0.0, 1.0), Window(u0, u1, 0.0, v0), Window(u0, u1, v1, 1.0)]
    across_v = [Window(0.0, 1.0, 0.0, v0), Window(0.0, 1.0, v1, 1.0), Window(0.0, u0, v0, v1), Window(u1, 1.0, v0, v1)]
    # Full cuts across u are as long as the patch is along v; the short ones span the window.
    in_u, in_v = int(u0 > 0.0) + int(u1 < 1.0), int(v0 > 0.0) + int(v1 < 1.0)
    length_u, length_v = patch.size
    cost_u = in_u * length_v + in_v * (u1 - u0) * length_u
    cost_v = in_v * length_u + in_u * (v1 - v0) * length_v
    chosen = across_u if cost_u <= cost_v else across_v
    return [w for w in chosen if w.u1 > w.u0 and w.v1 > w.v0]
