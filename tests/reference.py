"""Slow, naive twins that the tests compare with."""

import numpy as np
from scipy.optimize import minimize


def naive_basis(knots, degree, i, u):
    """Basis function i at one parameter by the recursion of Cox and de Boor, 0/0 = 0."""
    if degree == 0:
        last = u == knots[-1] and knots[i] < u == knots[i + 1]
        return 1.0 if knots[i] <= u < knots[i + 1] or last else 0.0
    value = 0.0
    if knots[i + degree] > knots[i]:
        value += (u - knots[i]) / (knots[i + degree] - knots[i]) * naive_basis(knots, degree - 1, i, u)
    if knots[i + degree + 1] > knots[i + 1]:
        ratio = (knots[i + degree + 1] - u) / (knots[i + degree + 1] - knots[i + 1])
        value += ratio * naive_basis(knots, degree - 1, i + 1, u)
    return value


def naive_surface(surface, u, v):
    """One point of a surface by the double sum, Eq. (19)."""
    nu, nv = surface.control_points.shape[:2]
    point = np.zeros(surface.control_points.shape[2])
    for i in range(nu):
        for j in range(nv):
            weight = naive_basis(surface.knots_u, surface.degree_u, i, u)
            weight *= naive_basis(surface.knots_v, surface.degree_v, j, v)
            point += weight * surface.control_points[i, j]
    return point


def brute_force_distance(evaluate, point, samples_u, samples_v, grid, starts=5):
    """Distance of a point to a surface: the best of many samples, each refined by a bounded optimiser.

    evaluate(u, v) -> (3,);  grid : (len(samples_u), len(samples_v), 3) points at the samples.
    """
    squared = ((grid - point) ** 2).sum(axis=2)
    best = np.inf
    padded = np.pad(squared, 1, constant_values=np.inf)
    neighbours = [
        padded[1 + a : 1 + a + squared.shape[0], 1 + b : 1 + b + squared.shape[1]]
        for a in (-1, 0, 1)
        for b in (-1, 0, 1)
        if a or b
    ]
    minima = np.argwhere(np.all([squared <= other for other in neighbours], axis=0))
    minima = minima[np.argsort(squared[tuple(minima.T)])][:starts]
    for i, j in minima:
        start = np.array([samples_u[i], samples_v[j]])
        found = minimize(
            lambda x: ((evaluate(*x) - point) ** 2).sum(),
            start,
            bounds=[(0, 1), (0, 1)],
            method="L-BFGS-B",
            options={"ftol": 1e-16, "gtol": 1e-12},
        )
        best = min(best, found.fun, squared[i, j])
    return np.sqrt(best)
