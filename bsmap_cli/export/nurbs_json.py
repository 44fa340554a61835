"""Surfaces in the JSON layout of geomdl (NURBS-Python), as its `exchange.import_json` reads them."""

import json
from collections.abc import Mapping, Sequence
from typing import Any

from bsmap_cli.model import BSplineSurface


def write_nurbs_json(surfaces: Sequence[BSplineSurface], provenance: Mapping[str, Any] | None) -> bytes:
    """JSON of all surfaces; geomdl leaves the key `bsmap-provenance` alone."""
    shape = {"type": "surface", "count": len(surfaces), "data": [_to_dict(surface) for surface in surfaces]}
    head = {"bsmap-provenance": dict(provenance)} if provenance else {}
    return (json.dumps(head | {"shape": shape}, separators=(",", ":")) + "\n").encode("ascii")


def _to_dict(surface: BSplineSurface) -> dict[str, Any]:
    size_u, size_v = surface.control_points.shape[:2]
    return {
        "type": "spline",
        "name": surface.name,
        "rational": False,
        "dimension": 3,
        "degree_u": surface.degree_u,
        "degree_v": surface.degree_v,
        "knotvector_u": surface.knots_u.tolist(),
        "knotvector_v": surface.knots_v.tolist(),
        "size_u": size_u,
        "size_v": size_v,
        # geomdl counts along v first: point (i, j) is number i * size_v + j.
        "control_points": {"points": surface.control_points.reshape(-1, 3).tolist()},
    }
