"""Upright round faces of known truth, as `bsmap fit` makes them, and the floor around a pillar."""

from dataclasses import replace

import numpy as np
from face_maps import plate

from bsmap_cli.core.bspline import evaluate_surface
from bsmap_cli.fit.heights import CylinderBase, HeightField, least_knots
from bsmap_cli.fit.surfaces import spline_over
from bsmap_cli.model import BSplineSurface, Crease, PosePart, Residuals, TrimLoop

RESIDUALS = Residuals(1000, 0.008, 0.01, 0.02, 0.03)


def arc(name, radius, start, end, *, sensor, sigma=5e-4, rng=None, height=2.5, marks=(-1, -1, -1, -1), sides=24):
    """Face of a cylinder about z, from angle `start` to `end`, its heights drawn with `sigma` where rng is given.

    marks : creases along the lower, last, upper and first border.  sides : along the lower and the upper border.
    """
    base = CylinderBase(np.zeros(2), radius, (start + end) / 2)
    half = (end - start) / 2 * radius
    low, high = np.array([-half, 0.0]), np.array([half, height])
    knots = least_knots(base, low, high)
    heights = np.zeros(knots.shape) if rng is None else rng.normal(0.0, sigma, knots.shape)
    field = HeightField(base, low, high, knots, heights)
    part = PosePart(name.split("/")[0], np.asarray(sensor, dtype=float), np.zeros((3, 3)))
    spline, covariance = spline_over(field, sigma**2 * np.eye(knots.size), (part,))
    u = np.linspace(0.0, 1.0, sides + 1)
    lower = np.column_stack([u, np.zeros(sides + 1)])
    loop = np.concatenate([lower, np.column_stack([u[::-1], np.ones(sides + 1)])])
    creases = np.concatenate([np.full(sides, marks[0]), [marks[1]], np.full(sides, marks[2]), [marks[3]]])
    return BSplineSurface(name, (name.split("/")[0],), *spline, covariance, RESIDUALS, (TrimLoop(loop, creases),))


def floor_around(name, pillar, number, *, half=1.0, sensor=(0.0, -2.0)):
    """Square floor, in which the lower border of a round face is crease `number`, and the crease.

    Behind the face its hole is wider than the pillar: it lies in the shadow.
    """
    vertices = pillar.trims[0].parameters
    line = evaluate_surface(pillar, *vertices[: len(vertices) // 2].T)
    first, last = (np.arctan2(*line[k, 1::-1]) for k in (0, -1))
    angles = np.linspace(first, last - 2.0 * np.pi if last > first else last, 12)[1:-1]
    shadow = 1.3 * np.hypot(*line[0, :2]) * np.column_stack([np.cos(angles), np.sin(angles)])
    flat = plate(name, (-half, -half, 0), (2 * half, 0, 0), (0, 2 * half, 0), sensor)
    hole = np.concatenate([line[::-1, :2], shadow])
    marks = np.concatenate([np.full(len(line) - 1, number), np.full(len(shadow) + 1, -1)])
    loop = TrimLoop((hole + half) / (2 * half), marks)
    return replace(flat, trims=(*flat.trims, loop)), Crease((pillar.name, name), line)
