"""A box room as scattered points of known truth, in an order that means nothing."""

from pathlib import Path

import numpy as np

from bsmap_cli.model import Array

SIZE = np.array([5.0, 4.0, 2.5])
"""Metres; the room stands on the origin."""
DOOR = (np.array([2.0, 0.0]), np.array([3.0, 2.0]))
WINDOW = (np.array([1.0, 0.8]), np.array([2.0, 1.8]))
"""Corners in x or y and z of the openings in the walls y = 0 and x = 0."""


def box_room(count: int = 60_000, sigma: float = 0.005, seed: int = 0) -> Array:
    """Points (n, 3) on floor, ceiling and walls; none in the door and the window."""
    rng = np.random.default_rng(seed)
    sides = []
    for axis in range(3):
        others = [k for k in range(3) if k != axis]
        for level in (0.0, SIZE[axis]):
            share = np.prod(SIZE[others]) / (2.0 * sum(np.prod(np.delete(SIZE, k)) for k in range(3)))
            points = np.empty((int(count * share), 3))
            points[:, others] = rng.random((len(points), 2)) * SIZE[others]
            points[:, axis] = level
            if level == 0.0 and axis < 2:
                low, high = (WINDOW, DOOR)[axis]
                points = points[~np.all((points[:, others] > low) & (points[:, others] < high), axis=1)]
            points[:, axis] += rng.normal(0.0, sigma, len(points))
            sides.append(points)
    return np.asarray(rng.permutation(np.concatenate(sides)))


def write_ply(path: Path, points: Array, kind: str = "float", form: str = "binary_little_endian") -> Path:
    """A PLY file as other programs write it, with a color between the coordinates and an intensity behind them."""
    order = ">" if form == "binary_big_endian" else "<"
    real = order + ("f4" if kind == "float" else "f8")
    rows = np.zeros(len(points), [("x", real), ("red", "u1"), ("y", real), ("z", real), ("intensity", order + "f4")])
    for axis, name in enumerate("xyz"):
        rows[name] = points[:, axis]
    names = f"property {kind} x\nproperty uchar red\nproperty {kind} y\nproperty {kind} z\nproperty float intensity\n"
    header = f"ply\nformat {form} 1.0\ncomment another program\nelement vertex {len(points)}\n{names}end_header\n"
    body = rows.tobytes() if form != "ascii" else "".join(" ".join(map(repr, r)) + "\n" for r in rows.tolist()).encode()
    path.write_bytes(header.encode() + body)
    return path
