"""Newton's descents to the feet of many points on one surface, Eq. (34-36), all at once.

Safeguarded: where the Hessian is not positive definite its eigenvalues count by their size, steps are limited and
halved where the distance grows, and along an edge of the domain only the other parameter moves.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bsmap_cli.core.pieces import Pieces, evaluate_pieces
from bsmap_cli.model import Array

COINCIDENCE = 1e-9
"""Metres: a foot this near to its point is the end."""
LAST_STEP = 1e-5
"""Metres: a step this short is the last one; by Newton's quadratic convergence it leaves some 1e-10 m."""
LAST_GAIN = 1e-11
"""Metres that a step must promise to come nearer: at a centre of curvature steps stay long, but in vain."""
ITERATIONS = 40
LEAST_CURVATURE = 0.05
"""Least eigenvalue of the Hessian in unit tangents; 1 far from all centres of curvature."""
MODEL = 2.0
"""Times the decrease of the squared distance that a step promises by which a start may still come nearer."""


class Feet(NamedTuple):
    """Parameters uv (2, n) of feet and their squared distances (n,)."""

    uv: Array
    squared: Array


class _Descent(NamedTuple):
    """Descents still under way, long axis last.

    number : (n,) of the point.  point : (3, n).  longest : (n,) metres.  bound : (n,) squared distance to get below.
    uv, squared : best parameters (2, n) and their squared distance (n,).  step : (2, n) from there.
    gain : (n,) decrease of the squared distance that the step promises.  trial : (2, n) parameters to try.
    """

    number: NDArray[np.intp]
    point: Array
    longest: Array
    bound: Array
    uv: Array
    squared: Array
    step: Array
    gain: Array
    trial: Array


def descend(pieces: Pieces, points: Array, uv: Array, longest: Array, bound: Array | None = None) -> Feet:
    """Newton from parameters uv (2, n) for points (3, n), steps no longer than `longest` (n,) metres.

    A descent that does not promise to get below its bound, a squared distance (n,), ends where it is.
    """
    n = points.shape[1]
    unknown, feet = np.full(n, np.inf), Feet(uv.copy(), np.full(n, np.inf))
    bound = unknown if bound is None else bound
    now = _Descent(np.arange(n), points, longest, bound, uv, unknown, np.zeros((2, n)), unknown, uv)
    for _ in range(ITERATIONS):
        now, done, convex = _advance(now, evaluate_pieces(pieces, now.trial[0], now.trial[1], 2))
        if done.any():
            number = now.number[done]
            feet.uv[:, number] = np.where(convex, now.trial, now.uv)[:, done]
            feet.squared[number] = now.squared[done]
            going = np.flatnonzero(~done)
            now = _Descent._make(field.take(going, axis=-1) for field in now)
        if not len(now.number):
            return feet
    feet.uv[:, now.number], feet.squared[now.number] = now.uv, now.squared
    return feet


def _advance(now: _Descent, jets: Array) -> tuple[_Descent, NDArray[np.bool_], NDArray[np.bool_]]:
    """Judge the trials by their jets (6, 3, n), take the next; which descents are done, which steps are Newton's."""
    r = jets[0] - now.point
    squared = dot(r, r)
    better = squared < now.squared
    newton = _newton_step(jets, r, now.trial)
    uv, squared, step, gain = now.trial, squared, newton.step, newton.gain
    if not better.all():
        uv, squared = np.where(better, uv, now.uv), np.where(better, squared, now.squared)
        step, gain = np.where(better, step, now.step / 2), np.where(better, gain, now.gain / 2)
    trial = _inside(uv + step)
    shift = newton.length(trial - uv)
    sure = newton.convex & better
    hopeless = sure & (squared - MODEL * gain > now.bound)
    done = (shift <= LAST_STEP) | (gain <= 2 * LAST_GAIN * np.sqrt(squared)) | (squared <= COINCIDENCE**2) | hopeless
    far = (shift > now.longest) & ~done
    if far.any():
        step = np.where(far, step * (now.longest / np.where(far, shift, 1.0)), step)
        trial = _inside(uv + step)
    now = now._replace(uv=uv, squared=squared, step=step, gain=gain, trial=trial)
    return now, done, sure


class _Newton(NamedTuple):
    """Newton's step (2, n), the decrease of the squared distance (n,) it promises, whether the Hessian is its own.

    metric : (3, n) first fundamental form.
    """

    step: Array
    gain: Array
    convex: NDArray[np.bool_]
    metric: Array

    def length(self, delta: Array) -> Array:
        """Metres (n,) of changes of the parameters (2, n)."""
        (a, b, c), (du, dv) = self.metric, delta
        return np.sqrt(np.maximum(a * du * du + 2 * b * du * dv + c * dv * dv, 0.0))


def _newton_step(jets: Array, r: Array, uv: Array) -> _Newton:
    """Newton's step on |S - Q|^2 / 2: gradient (f, g) and Hessian J of Eq. (35-36).

    At an edge that the gradient pushes against, the parameter across it stays and the step along it is Newton's for one
    variable.
    """
    _, Su, Sv, *_ = jets
    f, g, huu, huv, hvv = np.einsum("kdn,dn->kn", jets[1:], r)
    metric = np.array([dot(Su, Su), dot(Su, Sv), dot(Sv, Sv)])
    huu, huv, hvv = huu + metric[0], huv + metric[1], hvv + metric[2]
    at_edge = (uv <= 0.0) | (uv >= 1.0)
    if at_edge.any():
        held_u, held_v = at_edge & (np.where(uv <= 0.0, 1.0, -1.0) * np.stack([f, g]) > 0)
        f, g, huv = np.where(held_u, 0.0, f), np.where(held_v, 0.0, g), np.where(held_u | held_v, 0.0, huv)
        huu, hvv = np.where(held_u, metric[0], huu), np.where(held_v, metric[2], hvv)
    least = LEAST_CURVATURE**2
    convex = (huu > least * metric[0]) & (hvv > least * metric[2]) & (huu * hvv - huv**2 > least * huu * hvv)
    if not convex.all():
        bad = ~convex
        huu[bad], huv[bad], hvv[bad] = _made_convex(huu[bad], huv[bad], hvv[bad], metric[:, bad])
    determinant = huu * hvv - huv**2
    step = np.array([huv * g - hvv * f, huv * f - huu * g])
    step /= determinant
    return _Newton(step, -(f * step[0] + g * step[1]), convex, metric)


def _made_convex(huu: Array, huv: Array, hvv: Array, metric: Array) -> tuple[Array, Array, Array]:
    """Hessians with their eigenvalues, in unit tangents, by size and at least LEAST_CURVATURE.

    Nocedal and Wright (2006), section 3.4. At a pole, where a tangent vanishes, a share of the other one is its unit.
    """
    a, _, c = metric
    unit_u, unit_v = (np.sqrt(own + 1e-12 * other + 1e-300) for own, other in ((a, c), (c, a)))
    H = np.empty((len(huu), 2, 2))
    H[:, 0, 0], H[:, 1, 1] = huu / unit_u**2, hvv / unit_v**2
    H[:, 0, 1] = H[:, 1, 0] = huv / (unit_u * unit_v)
    values, vectors = np.linalg.eigh(H)
    values = np.maximum(np.abs(values), LEAST_CURVATURE)
    H = (vectors * values[:, None, :]) @ np.swapaxes(vectors, 1, 2)
    return H[:, 0, 0] * unit_u**2, H[:, 0, 1] * unit_u * unit_v, H[:, 1, 1] * unit_v**2


def _inside(uv: Array) -> Array:
    """Parameters brought into the domain; np.clip takes longer for few."""
    return np.minimum(np.maximum(uv, 0.0), 1.0)


def dot(a: Array, b: Array) -> Array:
    """Products (n,) of vectors (3, n)."""
    return np.einsum("dn,dn->n", a, b)
