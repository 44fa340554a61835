"""How the covariance of a surface's control points follows when the surface is cut, sampled, fused and fitted again."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from bsmap_cli.core.gaussian import pack, symmetric_sqrt, unpack
from bsmap_cli.model import Array, HeightCovariance, PosePart, SurfaceCovariance


def carry(covariance: SurfaceCovariance | HeightCovariance, along_u: Array, along_v: Array) -> SurfaceCovariance:
    """Covariance of points P' = sum_a sum_b U_ia V_jb P_ab, Eq. (33) for a map along u and v.

    The new blocks are exact under the structure of `SurfaceCovariance`. The new correlations U rho U' and V rho V',
    normalised, are exact where all blocks are equal, else an approximation. The pose parts stay as they are: rows of U
    and V that add up to one keep a common displacement.

    Parameters
    ----------
    along_u : (mu, nu), along_v : (mv, nv)
    """
    if isinstance(covariance, HeightCovariance):
        raise ValueError("height fields are not divided into patches")
    roots = symmetric_sqrt(unpack(covariance.blocks))
    pairs_v = np.einsum("jb,jc,bc->jbc", along_v, along_v, covariance.correlation_v)
    blocks = np.stack([_row_of_blocks(roots, covariance.correlation_u, row, pairs_v) for row in along_u])
    correlation_u = correlation(along_u @ covariance.correlation_u @ along_u.T)
    correlation_v = correlation(along_v @ covariance.correlation_v @ along_v.T)
    return SurfaceCovariance(pack(blocks), correlation_u, correlation_v, covariance.pose)


def _row_of_blocks(roots: Array, correlation_u: Array, row: Array, pairs_v: Array) -> Array:
    """Blocks (mv, 3, 3) of one new row: sum over a, b, c, d of U_a U_c rho_u[a, c] V_jb V_jd rho_v[b, d] L_ab L_cd'."""
    used = np.flatnonzero(row)
    weights = row[used, None] * row[used] * correlation_u[np.ix_(used, used)]
    local = roots[used]  # (a, nv, 3, 3)
    spread = np.tensordot(weights, local, axes=1)
    nv = local.shape[1]
    left = local.transpose(1, 2, 0, 3).reshape(nv * 3, -1)
    right = spread.transpose(1, 2, 0, 3).reshape(nv * 3, -1)
    products = (left @ right.T).reshape(nv, 3, nv, 3)
    blocks = np.einsum("jbc,bxcy->jxy", pairs_v, products, optimize=True)
    return (blocks + np.swapaxes(blocks, -1, -2)) / 2


def correlation(covariance: Array) -> Array:
    """Correlation matrix (n, n) of a covariance matrix; a component without variance is correlated with none."""
    deviations = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    outer = np.outer(deviations, deviations)
    result = np.divide(covariance, outer, out=np.zeros_like(covariance), where=outer > 0.0)
    np.fill_diagonal(result, 1.0)
    return (result + result.T) / 2


def fuse_blocks(first: Array, second_variance: Array, normals: Array, gains: Array) -> Array:
    """Sensor part (n, 3, 3) of points S moved by a share of the distance to their feet, S + g n n'(T - S).

    (I - g n n') C1 (I - g n n')' + g^2 (n' C2 n) n n', which is Eq. (37) along the normal for the optimal gain and
    stays right when g was chosen with the pose part in view.

    Parameters
    ----------
    first : (n, 3, 3) sensor part of S.  second_variance : (n,) of T along the normal.
    normals : (n, 3).  gains : (n,)
    """
    along = normals[:, :, None] * normals[:, None, :]
    keep = np.eye(3) - gains[:, None, None] * along
    return keep @ first @ np.swapaxes(keep, -1, -2) + (gains**2 * second_variance)[:, None, None] * along


def share_pose(first: Sequence[PosePart], second: Sequence[PosePart], gain: float) -> tuple[PosePart, ...]:
    """Pose parts of (1 - gain) first + gain second; parts of the same data set are one error, their shares add."""
    shares: dict[str, PosePart] = {}
    for parts, factor in ((first, 1.0 - gain), (second, gain)):
        for part in parts:
            known = shares.get(part.data_set)
            weight = factor * part.weight + (known.weight if known else 0.0)
            shares[part.data_set] = replace(part, weight=weight)
    return tuple(shares.values())
