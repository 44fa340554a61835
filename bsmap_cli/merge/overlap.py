"""Where two patches show the same place: outline by projected boundaries, and the rectangles to cut, section 9.

The paper cuts at the corners of the overlap. Overlaps are not rectangles in general (a tunnel of a translation meets
one of a rotation at an angle), so the rectangle is chosen here by its content: the area of its cells inside the
overlap, less a price for those outside.
"""

from typing import NamedTuple

import numpy as np

from bsmap_cli.core.bspline import evaluate_grid
from bsmap_cli.merge.facing import seen_points
from bsmap_cli.merge.patch import Landing, Patch, Window, land, width
from bsmap_cli.model import Array

CELLS = 32
"""Most cells along either direction when an overlap is sampled."""
PRICE_KEPT, PRICE_REPLACED = 1.0, 20.0
"""Price of a cell outside the overlap, in cells inside: in the patch whose shape is kept, where such a cell stays as it
is, and in the patch that is replaced, where it would leave a hole."""


class Outline(NamedTuple):
    """Boundary points of two patches that lie on the other.

    first, second : windows around them in the parameters of either patch; None where there are none.
    opposite : how many lie on the other patch, but face the other way.
    """

    first: Window | None
    second: Window | None
    opposite: int


class Rectangle(NamedTuple):
    """Part of a patch's domain that overlaps another patch.

    area : square metres of the overlap inside it.  share : of the overlap that it holds.  filled : share of the
    rectangle that lies in the overlap.
    """

    window: Window
    area: float
    share: float
    filled: float


def outline(first: Patch, second: Patch, distance: float) -> Outline:
    """Project the boundary of each patch on the other and collect what lands, in the parameters of both."""
    on_first: list[Array] = []
    on_second: list[Array] = []
    opposite = 0
    for a, b, at_a, at_b in ((first, second, on_first, on_second), (second, first, on_second, on_first)):
        uv = _boundary(a, distance)
        landing = land_parameters(a, uv[0], uv[1], b, distance)
        at_a.append(uv[:, landing.hit])
        at_b.append(np.stack([landing.u, landing.v])[:, landing.hit])
        opposite += int(np.count_nonzero(landing.opposite))
    return Outline(_window(np.hstack(on_first)), _window(np.hstack(on_second)), opposite)


def land_parameters(patch: Patch, u: Array, v: Array, target: Patch, distance: float) -> Landing:
    """Land the points of a patch at parameters u, v (n,) on another."""
    return land(*seen_points(patch.samples.pieces, patch.facing, u, v), target, distance)


def _boundary(patch: Patch, step: float) -> Array:
    """Parameters (2, n) around the edge of a patch, about `step` metres apart."""
    n, m = (int(np.ceil(length / step)) + 2 for length in patch.size)
    u, v = np.linspace(0.0, 1.0, n), np.linspace(0.0, 1.0, m)
    sides = [(u, np.zeros(n)), (u, np.ones(n)), (np.zeros(m), v), (np.ones(m), v)]
    return np.hstack([np.stack(side) for side in sides])


def _window(uv: Array) -> Window | None:
    if not uv.shape[1]:
        return None
    (u0, v0), (u1, v1) = uv.min(axis=1), uv.max(axis=1)
    return Window(float(u0), float(u1), float(v0), float(v1)) if u1 > u0 and v1 > v0 else None


def rectangle(patch: Patch, window: Window, other: Patch, distance: float, price: float) -> Rectangle | None:
    """Rectangle of a patch with the largest area inside its overlap with another, less `price` times that outside.

    Returns None where no cell of the window is in the overlap.
    """
    n, m = _cells(patch, window, distance)
    u, v = np.linspace(window.u0, window.u1, n + 1), np.linspace(window.v0, window.v1, m + 1)
    grid_u, grid_v = np.meshgrid(u, v, indexing="ij")
    hit = land_parameters(patch, grid_u.ravel(), grid_v.ravel(), other, distance).hit.reshape(n + 1, m + 1)
    inside = hit[:-1, :-1] & hit[1:, :-1] & hit[:-1, 1:] & hit[1:, 1:]
    if not inside.any():
        return None
    areas = _areas(evaluate_grid(patch.surface, u, v))
    i0, i1, j0, j1 = best_rectangle(np.where(inside, areas, -price * areas))
    held, total = areas[i0:i1, j0:j1], inside[i0:i1, j0:j1]
    area = float(held[total].sum())
    chosen = Window(float(u[i0]), float(u[i1]), float(v[j0]), float(v[j1]))
    return Rectangle(chosen, area, area / float(areas[inside].sum()), area / float(held.sum()))


def _cells(patch: Patch, window: Window, step: float) -> tuple[int, int]:
    lengths = width(patch, 0, window.u0, window.u1), width(patch, 1, window.v0, window.v1)
    n, m = (int(np.clip(np.ceil(length / step), 2, CELLS)) for length in lengths)
    return n, m


def _areas(points: Array) -> Array:
    """Areas (n, m) of the cells of a grid of points (n + 1, m + 1, 3): half the cross product of the diagonals."""
    one, other = points[1:, 1:] - points[:-1, :-1], points[1:, :-1] - points[:-1, 1:]
    return np.linalg.norm(np.cross(one, other), axis=2) / 2


def best_rectangle(values: Array) -> tuple[int, int, int, int]:
    """Rows i0:i1 and columns j0:j1 with the largest sum of `values` (n, m); the first one of equals.

    Kadane's algorithm along the columns for all pairs of rows at once.
    """
    n, m = values.shape
    down = np.concatenate([np.zeros((1, m)), np.cumsum(values, axis=0)])
    tops, bottoms = np.triu_indices(n + 1, 1)
    across = np.cumsum(down[bottoms] - down[tops], axis=1)
    before = np.concatenate([np.zeros((len(tops), 1)), across[:, :-1]], axis=1)
    lowest = np.minimum.accumulate(before, axis=1)
    pair, last = np.unravel_index(np.argmax(across - lowest), across.shape)
    first = int(np.argmin(before[pair, : last + 1]))
    return int(tops[pair]), int(bottoms[pair]), first, int(last) + 1


def snap(patch: Patch, window: Window, margin: float) -> Window:
    """Window whose sides are moved to the patch's edge where they lie within `margin` metres of it."""
    u0 = 0.0 if width(patch, 0, 0.0, window.u0) < margin else window.u0
    u1 = 1.0 if width(patch, 0, window.u1, 1.0) < margin else window.u1
    v0 = 0.0 if width(patch, 1, 0.0, window.v0) < margin else window.v0
    v1 = 1.0 if width(patch, 1, window.v1, 1.0) < margin else window.v1
    return Window(u0, u1, v0, v1)


def touches(first: Patch, second: Patch, distance: float) -> bool:
    """Whether the bounding boxes of two patches come within `distance` metres of each other."""
    apart = np.maximum(first.box[0] - second.box[1], second.box[0] - first.box[1])
    return bool(np.all(apart <= distance))
