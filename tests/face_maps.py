"""Small maps of trimmed faces over planes, as `bsmap fit` makes them, of known truth."""

from dataclasses import replace

import numpy as np

from bsmap_cli.model import (
    BSplineSurface,
    Crease,
    DataSet,
    HeightCovariance,
    Placement,
    PosePart,
    Residuals,
    SurfaceMap,
    TrimLoop,
)

FLAT = np.array([0.0, 0.0, 1.0, 1.0])
SIGMA = 5e-4
"""Metres, of the control heights."""


def loop_of(corners, holes=()):
    """Trim loops in parameters of a rectangle ((s0, t0), (s1, t1)) with holes, as shares of the surface."""
    rings = [box(*corners)] + [box(*hole)[::-1] for hole in holes]
    return tuple(TrimLoop(ring, np.full(len(ring), -1)) for ring in rings)


def box(low, high):
    return np.array([low, (high[0], low[1]), high, (low[0], high[1])], dtype=float)


def wall(name, start, end, *, heights=(0.0, 2.5), offset=0.0, sensor=1.5, pose=None, noise=None, holes=()):
    """Wall along x from `start` to `end` at y = offset, seen from y = sensor by the set its name begins with.

    heights : z of lower and upper side.  noise : (2, 2) added to the control heights.  holes : in metres, (x, z) both.
    """
    x, z = np.meshgrid([start, end], heights, indexing="ij")
    y = offset + (np.zeros((2, 2)) if noise is None else noise)
    data_set = name.split("/")[0]
    covariance = np.zeros((3, 3)) if pose is None else pose
    part = PosePart(data_set, np.array([(start + end) / 2, sensor]), covariance)
    size, low = np.array([end - start, heights[1] - heights[0]]), np.array([start, heights[0]])
    shares = [[(np.array(corner) - low) / size for corner in hole] for hole in holes]
    return BSplineSurface(
        name,
        (data_set,),
        1,
        1,
        FLAT,
        FLAT,
        np.stack([x, y, z], axis=-1),
        HeightCovariance(np.array([[[0.0, 1.0, 0.0]]]), SIGMA**2 * np.eye(4), (part,)),
        Residuals(1000, 0.008, 0.01, 0.02, 0.03),
        loop_of(((0.0, 0.0), (1.0, 1.0)), shares),
    )


def bow(x):
    """Shape of a bowed wall 4 m long: a parabola, 1 in the middle."""
    return 1.0 - (x / 2.0 - 1.0) ** 2


def bowed(surface, height):
    """A wall from 0 to 4 m that bends by `height` metres, quadratic along x."""
    P = surface.control_points
    middle = P.mean(axis=0) + np.array([0.0, 2.0 * height, 0.0])
    return BSplineSurface(
        **{
            **vars(surface),
            "degree_u": 2,
            "knots_u": np.array([0.0, 0.0, 0.0, 1.0, 1.0, 1.0]),
            "control_points": np.stack([P[0], middle, P[1]]),
            "covariance": HeightCovariance(
                surface.covariance.directions, SIGMA**2 * np.eye(6), surface.covariance.pose
            ),
        }
    )


def floor(name, start, end, *, far=3.0, sensor=1.5, pose=None):
    """Floor z = 0 over x from `start` to `end` and y from 0 to `far`."""
    x, y = np.meshgrid([start, end], [0.0, far], indexing="ij")
    data_set = name.split("/")[0]
    covariance = np.zeros((3, 3)) if pose is None else pose
    part = PosePart(data_set, np.array([(start + end) / 2, sensor]), covariance)
    return BSplineSurface(
        name,
        (data_set,),
        1,
        1,
        FLAT,
        FLAT,
        np.stack([x, y, np.zeros((2, 2))], axis=-1),
        HeightCovariance(np.array([[[0.0, 0.0, 1.0]]]), SIGMA**2 * np.eye(4), (part,)),
        Residuals(1000, 0.008, 0.01, 0.02, 0.03),
        loop_of(((0.0, 0.0), (1.0, 1.0))),
    )


def with_crease(first, second, number, start, end):
    """Both surfaces with the side v = 0 of their first loop marked as crease `number`, and the crease along x."""
    marked = []
    for surface in (first, second):
        loop = surface.trims[0]
        trims = (TrimLoop(loop.parameters, np.array([number, -1, -1, -1])), *surface.trims[1:])
        marked.append(BSplineSurface(**{**vars(surface), "trims": trims}))
    return *marked, Crease((first.name, second.name), np.array([[start, 0.0, 0.0], [end, 0.0, 0.0]]))


def map_of(*surfaces, creases=()):
    """Map of these surfaces and their data sets."""
    names = sorted({name for surface in surfaces for name in surface.data_sets})
    return SurfaceMap(
        surfaces, tuple(DataSet(name, "translation", 0, 20, 1000) for name in names), creases=tuple(creases)
    )


def plate(name, origin, along_u, along_v, sensor, creases=(-1, -1, -1, -1)):
    """Flat face origin + u along_u + v along_v, seen from `sensor` (2,); creases along v = 0, u = 1, v = 1, u = 0."""
    origin, along_u, along_v = (np.asarray(a, dtype=float) for a in (origin, along_u, along_v))
    net = np.array([[origin + u * along_u + v * along_v for v in (0, 1)] for u in (0, 1)])
    normal = np.cross(along_u, along_v)
    data_set = name.split("/")[0]
    return BSplineSurface(
        name,
        (data_set,),
        1,
        1,
        FLAT,
        FLAT,
        net,
        HeightCovariance(
            (normal / np.linalg.norm(normal))[None, None],
            SIGMA**2 * np.eye(4),
            (PosePart(data_set, np.asarray(sensor, dtype=float), np.zeros((3, 3))),),
        ),
        Residuals(1000, 0.008, 0.01, 0.02, 0.03),
        (TrimLoop(box((0.0, 0.0), (1.0, 1.0)), np.array(creases)),),
    )


SIDES = {
    "floor": ("000", "100", "110", "010"),
    "ceiling": ("001", "101", "111", "011"),
    "south": ("000", "100", "101", "001"),
    "north": ("010", "110", "111", "011"),
    "west": ("000", "010", "011", "001"),
    "east": ("100", "110", "111", "101"),
}
"""Corners of the sides of a box, in the order of a plate's: x, y, z low (0) or high (1)."""


def boxed(data_set, low, high, sides=tuple(SIDES)):
    """Map of the inside of a box, as one data set sees it: some of its sides, with creases between those."""
    low, high = np.asarray(low, dtype=float), np.asarray(high, dtype=float)
    at = {f"{i}{j}{k}": np.where([i, j, k], high, low) for i in (0, 1) for j in (0, 1) for k in (0, 1)}
    edges, plates = {}, []
    for side in sides:
        ring = SIDES[side]
        for start, end in zip(ring, ring[1:] + ring[:1], strict=True):
            edges.setdefault(tuple(sorted((start, end))), []).append(side)
    shared = [edge for edge, two in edges.items() if len(two) == 2]
    for side in sides:
        ring = SIDES[side]
        pairs = [tuple(sorted(pair)) for pair in zip(ring, ring[1:] + ring[:1], strict=True)]
        marks = [shared.index(pair) if pair in shared else -1 for pair in pairs]
        origin, u, v = at[ring[0]], at[ring[1]] - at[ring[0]], at[ring[3]] - at[ring[0]]
        plates.append(plate(f"{data_set}/{side}", origin, u, v, (low + high)[:2] / 2, marks))
    lines = [
        Crease(tuple(f"{data_set}/{side}" for side in edges[edge]), np.array([at[edge[0]], at[edge[1]]]))
        for edge in shared
    ]
    return map_of(*plates, creases=lines)


ROOM = (0.0, 0.0, 0.0), (6.0, 4.0, 2.5)
"""Lowest and highest corner of `room`."""
ROOM_POSE = np.diag([0.002**2, 0.003**2, 1e-7])
"""Covariance of its data set's pose."""


def with_poses(surface_map):
    """The map with ROOM_POSE as error of pose of all data sets."""

    def known(surface):
        part = replace(surface.covariance.pose[0], covariance=ROOM_POSE)
        return replace(surface, covariance=replace(surface.covariance, pose=(part,)))

    return replace(surface_map, surfaces=tuple(known(surface) for surface in surface_map.surfaces))


def cupboard(data_set, x, y, wide=1.0, deep=0.6, high=1.8):
    """Two sides of a cupboard that stands in the corner of highest y and lowest x, as seen from the room."""
    return (
        plate(f"{data_set}/front", (x, y - deep, 0.0), (wide, 0.0, 0.0), (0.0, 0.0, high), (3.0, 2.0)),
        plate(f"{data_set}/side", (x + wide, y - deep, 0.0), (0.0, deep, 0.0), (0.0, 0.0, high), (3.0, 2.0)),
    )


def room(data_set="set-01", noise=0.0, seed=0, extra=True):
    """A room with a cupboard in one corner."""
    made = with_poses(boxed(data_set, *ROOM))
    pieces = with_poses(map_of(*cupboard(data_set, 0.0, 4.0))).surfaces if extra else ()
    rng = np.random.default_rng(seed)
    shifted = (
        replace(s, control_points=s.control_points + noise * rng.standard_normal() * s.covariance.directions)
        for s in (*made.surfaces, *pieces)
    )
    return replace(made, surfaces=tuple(shifted))


def put(x, y, degrees, height=0.0, covariance=None):
    """Placement that says where a map is to be laid, and no more."""
    covariance = np.zeros((3, 3)) if covariance is None else covariance
    pose = np.array([x, y, np.radians(degrees)])
    return Placement(0, pose, height, covariance, 0.0, 0.0, 0.0, None, "unique")
