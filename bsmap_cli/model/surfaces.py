"""B-spline surfaces with covariance, trims and creases: SurfaceMap, of data sets, then of the map."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bsmap_cli.model.arrays import Array, IntArray, check


@dataclass(frozen=True)
class PosePart:
    """Error that all points of a data set share, for it comes from the robot's pose.

    covariance : (3, 3) of (x, y, theta) in map; a rotation by theta turns about `centre` (2,), metres in map.
    weight : share of this data set in the surface (1 before merging); the shares of a surface's parts add up to 1.
    modes : (3, k) of that covariance what the data sets of one trajectory have in common, as in Trajectory; sets a and
    b of the same `trajectory` have the covariance modes_a modes_b', others none. None where it is not known.
    A point p has the covariance  J C J',  J = [[1, 0, -(p_y - c_y)], [0, 1, p_x - c_x], [0, 0, 0]].
    """

    data_set: str
    centre: Array
    covariance: Array
    weight: float = 1.0
    modes: Array | None = None
    trajectory: str = ""

    def __post_init__(self) -> None:
        check(self, centre=(2,), covariance=(3, 3))
        if self.modes is not None:
            check(self, modes=(3, None))

    @property
    def own(self) -> Array:
        """(3, 3) covariance of what this data set has in common with no other."""
        return self.covariance if self.modes is None else self.covariance - self.modes @ self.modes.T


@dataclass(frozen=True)
class SurfaceCovariance:
    """Covariance of a surface's control points: a sensor part and the pose parts of its data sets.

    Sensor part of control points (i, j) and (k, l):  L_ij (rho_u[i, k] rho_v[j, l]) L_kl',  L the symmetric square
    roots of `blocks`. The blocks on the diagonal are exact (A C_Q A', Eq. 32-33); the correlation is that of equal
    noise on all points, which is separable: an approximation that keeps the map small and any point's covariance at
    hand.

    blocks : (nu, nv, 6) xx, xy, xz, yy, yz, zz.  correlation_u : (nu, nu).  correlation_v : (nv, nv).
    """

    blocks: Array
    correlation_u: Array
    correlation_v: Array
    pose: tuple[PosePart, ...]

    def __post_init__(self) -> None:
        nu, nv = np.shape(self.correlation_u)[0], np.shape(self.correlation_v)[0]
        check(self, blocks=(nu, nv, 6), correlation_u=(nu, nu), correlation_v=(nv, nv))


@dataclass(frozen=True)
class HeightCovariance:
    """Covariance of a surface whose control points move along given directions only: a sensor part and pose parts.

    The surface was fitted as a field of scalar heights; control point (i, j) moves by its height along its direction.
    A point S(u, v) has the sensor part G M G', column (i, j) of G being N_i(u) N_j(v) d_ij: exact, and small.

    directions : (nu or 1, nv or 1, 3) unit vectors in map; where there is 1, it holds for all.
    matrix : (nu * nv, nu * nv) of the heights, square metres, heights in the order of the control points.
    """

    directions: Array
    matrix: Array
    pose: tuple[PosePart, ...]

    def __post_init__(self) -> None:
        size = len(self.matrix)
        check(self, directions=(None, None, 3), matrix=(size, size))


@dataclass(frozen=True)
class TrimLoop:
    """Closed polygon in a surface's parameters.

    parameters : (k, 2) u, v in [0, 1].
    creases : (k,) number in SurfaceMap.creases of the crease that the side from this vertex to the next one runs
    along, -1 for an open border.
    rims : (k,) metres within which a side of an open border follows the edge of the thing, 0 where the face may go on
    behind what was seen; None where no side follows one.
    """

    parameters: Array
    creases: IntArray
    rims: Array | None = None

    def __post_init__(self) -> None:
        check(self, parameters=(None, 2), creases=(len(self.parameters),))
        if self.rims is not None:
            check(self, rims=(len(self.parameters),))


@dataclass(frozen=True)
class Crease:
    """Curve in which two surfaces meet: a polyline (k, 3) in map, which the trim loops of both refer to.

    corners : numbers in SurfaceMap.corners of its first and its last point, -1 for a free end.
    """

    surfaces: tuple[str, str]
    points: Array
    corners: tuple[int, int] = (-1, -1)

    def __post_init__(self) -> None:
        check(self, points=(None, 3))


@dataclass(frozen=True)
class Residuals:
    """Distances of the data to the surface at the parameters of the fit, metres."""

    points: int
    mean: float
    rms: float
    percentile_95: float
    maximum: float


@dataclass(frozen=True)
class BSplineSurface:
    """Tensor-product B-spline surface S(u, v) on [0, 1] x [0, 1] in map, Eq. (19).

    knots_u : (nu + p + 1,), knots_v : (nv + q + 1,), clamped.  control_points : (nu, nv, 3).
    name : of the surface, unique in its map.  data_sets : it was fitted to.
    trims : what of it was seen: the points around which the loops together wind counter-clockwise, holes being run
    around clockwise. Loops may overlap. Without trims it is the whole surface.
    side : +1 where S_u x S_v points to the sensor that saw it, -1 where it points away, 0 where that is not known.
    """

    name: str
    data_sets: tuple[str, ...]
    degree_u: int
    degree_v: int
    knots_u: Array
    knots_v: Array
    control_points: Array
    covariance: SurfaceCovariance | HeightCovariance
    residuals: Residuals
    trims: tuple[TrimLoop, ...] = ()
    side: int = 0

    def __post_init__(self) -> None:
        nu, nv = len(self.knots_u) - self.degree_u - 1, len(self.knots_v) - self.degree_v - 1
        check(self, control_points=(nu, nv, 3))
        if isinstance(self.covariance, HeightCovariance):
            fits = len(self.covariance.matrix) == nu * nv
            fits &= all(k in (1, n) for k, n in zip(self.covariance.directions.shape, (nu, nv), strict=False))
            shape: tuple[int, ...] = self.covariance.matrix.shape
        else:
            shape = np.shape(self.covariance.blocks)
            fits = shape == (nu, nv, 6)
        if not fits:
            raise ValueError(f"covariance of shape {shape} for {nu} x {nv} control points")


@dataclass(frozen=True)
class DataSet:
    """A run of vertical scans in one kind of movement, from which surfaces were fitted; or points without any order.

    movement : "translation", "rotation", or "unorganised" (then without scans: first and last are 0).
    """

    name: str
    movement: str
    first_scan: int
    last_scan: int
    points: int


@dataclass(frozen=True)
class Decision:
    """What merging did with two surfaces or patches (or with one, `second` being empty), and why."""

    first: str
    second: str
    outcome: str  # "merged", "refused", or "moved": not the same in two surveys
    reason: str
    figures: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Placement:
    """Where a map was laid that had a frame of its own, in that of the map it was merged with.

    survey : its number among the maps given.  pose : (3,) x, y, turn of its frame.  height : metres.
    covariance : (3, 3) of the pose, the turn about its place.
    matched, denied : square metres of walls that lie on walls, and that stand where the other map saw bare floor.
    rival : score of the second best placement as a share of this one's, 0 where there is none.  rival_pose : (3,).
    verdict : "unique": no other placement comes near it.
    """

    survey: int
    pose: Array
    height: float
    covariance: Array
    matched: float
    denied: float
    rival: float
    rival_pose: Array | None
    verdict: str

    def __post_init__(self) -> None:
        check(self, pose=(3,), covariance=(3, 3))


@dataclass(frozen=True)
class SurfaceMap:
    """B-spline surfaces, of data sets (after fit) or of the map (after merge).

    creases : to which the trims of the surfaces refer.  corners : (k, 3) in map, points in which creases end together.
    placements : of maps that were brought into this frame.
    """

    surfaces: tuple[BSplineSurface, ...]
    data_sets: tuple[DataSet, ...]
    decisions: tuple[Decision, ...] = ()
    notes: dict[str, Any] = field(default_factory=dict)
    creases: tuple[Crease, ...] = ()
    corners: Array = field(default_factory=lambda: np.zeros((0, 3)))
    placements: tuple[Placement, ...] = ()

    def __post_init__(self) -> None:
        check(self, corners=(None, 3))
