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


def central_differences(function, at, step=1e-6, angles=()):
    """Jacobian of a vector function at (n,) by central differences; differences of outputs in `angles` are wrapped."""
    columns = []
    for i in range(len(at)):
        h = np.zeros(len(at))
        h[i] = step
        difference = np.asarray(function(at + h)) - np.asarray(function(at - h))
        for k in angles:
            difference[..., k] = (difference[..., k] + np.pi) % (2 * np.pi) - np.pi
        columns.append(difference / (2 * step))
    return np.stack(columns, axis=-1)


def polar_line_fit(rho, phi, weights):
    """Weighted total least squares line (alpha, r) of polar points by the paper's double sums N/D, Eq. (2)-(3)."""
    total = sum(weights)
    numerator = denominator = 0.0
    for i in range(len(rho)):
        for j in range(len(rho)):
            if j > i:
                numerator += weights[i] * weights[j] * rho[i] * rho[j] * np.sin(phi[i] + phi[j]) * 2 / total
                denominator += weights[i] * weights[j] * rho[i] * rho[j] * np.cos(phi[i] + phi[j]) * 2 / total
        numerator += (weights[i] - total) * weights[i] * rho[i] ** 2 * np.sin(2 * phi[i]) / total
        denominator += (weights[i] - total) * weights[i] * rho[i] ** 2 * np.cos(2 * phi[i]) / total
    alpha = 0.5 * np.arctan2(numerator, denominator)
    r = sum(w * p * np.cos(f - alpha) for w, p, f in zip(weights, rho, phi, strict=True)) / total
    return (alpha, r) if r >= 0 else (alpha + np.pi, -r)


class DenseLineFilter:
    """Textbook EKF over pose and lines with full matrices: P - K S K', the twin of slam/filter.py."""

    def __init__(self, pose, covariance):
        self.mean, self.P = np.array(pose, float), np.array(covariance, float)

    def lines(self):
        return self.mean[3:].reshape(-1, 2)

    def predict(self, u, Q):
        x, y, theta = self.mean[:3]
        c, s = np.cos(theta), np.sin(theta)
        self.mean[:3] = x + c * u[0] - s * u[1], y + s * u[0] + c * u[1], theta + u[2]
        F, G = np.eye(len(self.mean)), np.zeros((len(self.mean), 3))
        F[:2, 2] = -s * u[0] - c * u[1], c * u[0] - s * u[1]
        G[:3] = [[c, -s, 0], [s, c, 0], [0, 0, 1]]
        self.P = F @ self.P @ F.T + G @ Q @ G.T

    def update(self, line, z, R):
        x, y, theta = self.mean[:3]
        alpha, r = self.lines()[line]
        c, s = np.cos(alpha), np.sin(alpha)
        H = np.zeros((2, len(self.mean)))
        H[:, :3] = [[0, 0, -1], [-c, -s, 0]]
        H[:, 3 + 2 * line : 5 + 2 * line] = [[1, 0], [x * s - y * c, 1]]
        return self._correct(H, np.array([z[0] - (alpha - theta), z[1] - (r - x * c - y * s)]), R)

    def constrain_equal(self, first, second, R):
        H = np.zeros((2, len(self.mean)))
        H[:, 3 + 2 * first : 5 + 2 * first] = np.eye(2)
        H[:, 3 + 2 * second : 5 + 2 * second] = -np.eye(2)
        return self._correct(H, self.lines()[second] - self.lines()[first], R)

    def _correct(self, H, v, R):
        v[0] = (v[0] + np.pi) % (2 * np.pi) - np.pi
        S = H @ self.P @ H.T + R
        K = self.P @ H.T @ np.linalg.inv(S)
        self.mean = self.mean + K @ v
        self.P = self.P - K @ S @ K.T
        return v @ np.linalg.inv(S) @ v

    def augment(self, z, R):
        n, (x, y, theta) = len(self.mean), self.mean[:3]
        alpha = z[0] + theta
        c, s = np.cos(alpha), np.sin(alpha)
        G_x, G_z = np.zeros((2, n)), np.array([[1, 0], [y * c - x * s, 1]])
        G_x[:, :3] = [[0, 0, 1], [c, s, y * c - x * s]]
        self.mean = np.append(self.mean, [alpha, z[1] + x * c + y * s])
        corner = G_x @ self.P @ G_x.T + G_z @ R @ G_z.T
        self.P = np.block([[self.P, self.P @ G_x.T], [G_x @ self.P, corner]])

    def remove(self, line):
        """The last line takes the removed one's place, as in slam/filter.py."""
        order = list(range((len(self.mean) - 3) // 2))
        last = order.pop()
        if line != last:
            order[line] = last
        index = np.r_[0, 1, 2, (3 + 2 * np.array(order, int)[:, None] + [0, 1]).ravel()].astype(int)
        self.mean, self.P = self.mean[index], self.P[np.ix_(index, index)]
