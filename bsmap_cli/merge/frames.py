"""Common bases of faces that are joined: the plane, or the upright cylinder, through all of them."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from bsmap_cli.fit.heights import Base, CylinderBase, HeightField, plane_base
from bsmap_cli.merge.bases import BasedFace, circle_through, normals, places_on
from bsmap_cli.model import Array

SLIT = 0.002
"""Metres left open of a face that goes all around: there its parameter begins and ends."""


class Frame(NamedTuple):
    """Common base of a group, and the rectangle from `low` (2,) to `high` (2,) that it fills, metres."""

    base: Base
    low: Array
    high: Array


def common_frame(faces: Sequence[BasedFace]) -> Frame:
    """Plane through all faces, its normal towards the sensors, or cylinder where they have one; and the rectangle
    around the faces' own.
    """
    points = np.concatenate([face.samples[face.areas > 0.0] for face in faces])
    weights = np.concatenate([face.areas[face.areas > 0.0] for face in faces])
    if any(face.round for face in faces):
        return _cylinder(faces, points, weights)
    centred = points - np.average(points, axis=0, weights=weights)
    normal = np.linalg.eigh(centred.T @ (weights[:, None] * centred))[1][:, 0]
    own = [normals(face.field.base, face.samples[:1])[0] for face in faces]
    votes = sum(face.area * face.facing * np.sign(n @ normal) for face, n in zip(faces, own, strict=True))
    first = normal[np.argmax(np.abs(normal))]
    normal = normal * (np.sign(votes) if votes != 0.0 else np.sign(first))
    base = plane_base(points, normal)
    corners = np.concatenate([base.local(corners_of(face.field))[:, :2] for face in faces])
    return Frame(base, corners.min(axis=0), corners.max(axis=0))


def _cylinder(faces: Sequence[BasedFace], points: Array, weights: Array) -> Frame:
    """Cylinder through points (n, 3), which begins and ends in the middle of the widest gap between the faces."""
    centre, radius = circle_through(points[:, :2], weights)
    arcs = np.sort([_arc(face, centre) for face in faces], axis=1)
    middle, half = _around(arcs, SLIT / radius)
    z = np.concatenate([corners_of(face.field)[:, 2] for face in faces])
    base = CylinderBase(centre, radius, middle)
    return Frame(base, np.array([-half * radius, z.min()]), np.array([half * radius, z.max()]))


def _arc(face: BasedFace, centre: Array) -> Array:
    """(2,) angles about a centre (2,) in which the rectangle of a face begins and ends."""
    u = np.linspace(0.0, 1.0, 33)
    x, y = (places_on(face.field, np.column_stack([u, np.full(len(u), 0.5)]))[:, :2] - centre).T
    return np.asarray(np.unwrap(np.arctan2(y, x))[[0, -1]])


def _around(arcs: Array, least: float) -> tuple[float, float]:
    """Angle in the middle of arcs (k, 2) on a circle, and half of the angle that they fill from one end to the other:
    all but their widest gap, or but the `least` one opposite to angle 0 where they go all around.
    """
    turn = 2.0 * np.pi
    first = arcs - (arcs[:, :1] - arcs[:, :1] % turn)
    often = np.concatenate([first - turn, first, first + turn])
    often = often[np.argsort(often[:, 0], kind="stable")]
    gaps = np.append(0.0, often[1:, 0] - np.maximum.accumulate(often[:, 1])[:-1])
    gaps[(often[:, 0] < 0.0) | (often[:, 0] >= turn)] = 0.0
    widest = int(np.argmax(gaps))
    if gaps[widest] <= least:
        return 0.0, (turn - least) / 2.0
    half = (turn - float(gaps[widest])) / 2.0
    return float(often[widest, 0]) + half, half


def corners_of(field: HeightField) -> Array:
    """(4, 3) corners of a field's rectangle, in map."""
    ends = np.array([0.0, 1.0])
    return places_on(field, np.stack(np.meshgrid(ends, ends, indexing="ij"), axis=-1).reshape(-1, 2))
