"""Edges of a scene of known truth that beams show: where both surfaces that meet in them were hit nearby."""

import numpy as np
import trimesh
from scipy.spatial import cKDTree

SHARPEST = np.radians(160.0)
BLUNTEST = np.radians(20.0)
"""Angles between normals: facets of curved walls meet in less, and what is folded back on itself is no edge."""
STEP = 0.02
"""Metres between samples of an edge."""
NEAR, ON = 0.08, 0.005
"""Metres from a sample to the nearest end of a beam, and from that end to the plane of the surface that it hit."""


def seen_edges(vertices, triangles, ends):
    """Samples (n, 3) of the edges of a mesh near which true ends (m, 3) of beams lie on both sides."""
    mesh = trimesh.Trimesh(vertices, triangles, process=False)
    mesh.merge_vertices()
    angle = mesh.face_adjacency_angles
    sharp = (angle > BLUNTEST) & (angle < SHARPEST)
    tree = cKDTree(ends)
    out = []
    for edge, faces in zip(mesh.face_adjacency_edges[sharp], mesh.face_adjacency[sharp], strict=True):
        a, b = mesh.vertices[edge]
        n = max(1, int(np.linalg.norm(b - a) / STEP))
        samples = a + (np.arange(n)[:, None] + 0.5) / n * (b - a)
        near = tree.query_ball_point(samples, NEAR)
        normals, origins = mesh.face_normals[faces], mesh.triangles[faces][:, 0]
        for sample, found in zip(samples, near, strict=True):
            # Ends on one side: in its plane, and off the other's.
            off = np.abs(np.einsum("nsd,sd->ns", ends[found].reshape(-1, 1, 3) - origins, normals))
            sides = [(off[:, k] < ON) & (off[:, 1 - k] > ON) for k in (0, 1)]
            if all(side.any() for side in sides):
                out.append(sample)
    return np.array(out).reshape(-1, 3)


def distance_to_lines(points, lines):
    """Distances (n,) of points (n, 3) to the nearest of polylines, each (k, 3)."""
    starts = np.concatenate([line[:-1] for line in lines])
    ways = np.concatenate([np.diff(line, axis=0) for line in lines])
    square = np.maximum(np.sum(ways**2, axis=1), 1e-18)
    best = np.full(len(points), np.inf)
    for start, way, length in zip(starts, ways, square, strict=True):
        t = np.clip((points - start) @ way / length, 0.0, 1.0)
        best = np.minimum(best, np.linalg.norm(points - start - t[:, None] * way, axis=1))
    return best
