"""The artifact of `fit` and `merge`: B-spline surfaces as JSON (.surfaces.json, .map.json; .gz by name).

    {"format": "bsmap-surfaces", "version": 5, "units": "metres, radians, frame map",
     "bsmap-provenance": {...},
     "data_sets": [{"name", "movement": "translation" | "rotation", "first_scan", "last_scan", "points"}, ...],
     "poses": [{"data_set", "centre": [x, y], "covariance": [xx, xy, xt, yy, yt, tt],
                "trajectory": name, "modes": k x 3, or null where it is not known what poses have in common}, ...],
     "surfaces": [surface, ...],
     "decisions": [{"first", "second", "outcome": "merged" | "refused" | "moved", "reason", "figures": {...}}, ...],
     "corners": k x 3 points in which creases end together,
     "creases": [{"surfaces": [name, name], "corners": [first, last], "points": k x 3 polyline}, ...],
                             corners: their numbers, -1 for a free end; corners are not among the points
     "placements": [{"survey", "pose": [x, y, turn], "height", "covariance": [xx, xy, xt, yy, yt, tt],
                     "matched", "denied", "rival", "rival_pose": [x, y, turn] or null, "verdict": "unique"}, ...],
                             of maps that were brought into this frame, by their numbers among the inputs from 0 on
     "notes": {...}}

    surface = {"name", "data_sets": [names],
     "degree_u", "degree_v",
     "knots_u", "knots_v":     full clamped knot vectors on [0, 1]: nu + degree_u + 1 and nv + degree_v + 1 numbers
     "control_points":         nu x nv x 3
     "covariance": {
        "blocks":              nu x nv x 6: xx, xy, xz, yy, yz, zz of the control points' sensor part
        "correlation_u", "correlation_v":   upper triangles row by row, nu (nu + 1) / 2 and nv (nv + 1) / 2 numbers
        or, of control points that move along given directions only,
        "directions":          nu or 1 x nv or 1 x 3 unit vectors
        "root":                lower triangle L column by column, n (n + 1) / 2 integers, n = nu nv: the heights'
                               covariance is L L', in units of 1e-8 m; or, of one that is nearly singular,
        "matrix":              its upper triangle row by row, in square metres
        and "pose": [{"data_set", "weight"}, ...]},
     "trims": [{"parameters": k x 2, u and v of a closed polygon,
                "creases": k numbers of the creases along the sides from each vertex to the next, -1 for none}, ...]
                             no trims: the whole surface; else what the loops together wind around counter-clockwise
     "residuals": {"points", "mean", "rms", "percentile_95", "maximum"}}

model/surfaces.py tells what each is. Numbers are rounded to what they are worth, for the bytes of a map matter:
coordinates, correlations and weights to 1e-6, directions to 1e-7, knots to 1e-10, creases, corners and parameters of
trims to 1e-5, covariances to 4 (those of heights that are nearly singular to
7) and residuals to 6 significant digits. A map that was read is written again byte for byte.
"""

import gzip
import json
import zlib
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from bsmap_cli.core.gaussian import rounded_root
from bsmap_cli.errors import BadInputError, MissingInputError
from bsmap_cli.io.artifact import Provenance, atomic_output, plain_json
from bsmap_cli.io.surfaces_check import ROOT_UNIT, MalformedError, parse_map
from bsmap_cli.model import (
    Array,
    BSplineSurface,
    Crease,
    HeightCovariance,
    Placement,
    PosePart,
    SurfaceCovariance,
    SurfaceMap,
    TrimLoop,
)

FORMAT = "bsmap-surfaces"
VERSION = 5
LEAST_ROOT = 200.0
"""Units that the diagonal of a root has at least, so that rounding changes no variance by a percent."""


def write_surfaces(path: Path | str, surfaces: SurfaceMap, provenance: Provenance | None = None) -> None:
    """Write surfaces, one a line; gzip where the name ends in .gz.

    Raises
    ------
    CannotWriteError
        The file cannot be written.
    ValueError
        A number is not finite.
    """
    head = {"format": FORMAT, "version": VERSION, "units": "metres, radians, frame map"}
    if provenance is not None:
        head |= {"bsmap-provenance": provenance.to_dict()}
    parts = [
        _dumps(head)[1:-1],
        _list("data_sets", [plain_json(asdict(data_set)) for data_set in surfaces.data_sets]),
        _list("poses", [_pose_part(part) for part in _poses(surfaces)]),
        _list("surfaces", [_surface(surface) for surface in surfaces.surfaces]),
        _list("decisions", [plain_json(asdict(decision)) for decision in surfaces.decisions]),
        _list("corners", _rounded(surfaces.corners, 5)),
        _list("creases", [_crease(crease) for crease in surfaces.creases]),
        _list("placements", [_placement(placement) for placement in surfaces.placements]),
        f'"notes":{_dumps(plain_json(surfaces.notes))}',
    ]
    content = ("{" + ",\n".join(parts) + "}\n").encode()
    with atomic_output(path) as temporary:
        packed = str(path).endswith(".gz")
        temporary.write_bytes(gzip.compress(content, 9, mtime=0) if packed else content)


def _dumps(value: Any) -> str:
    return json.dumps(value, separators=(",", ":"), allow_nan=False)


def _list(key: str, values: list[Any]) -> str:
    return f'"{key}":[\n' + ",\n".join(map(_dumps, values)) + "]"


def _surface(surface: BSplineSurface) -> dict[str, Any]:
    residuals = surface.residuals
    return {
        "name": surface.name,
        "data_sets": list(surface.data_sets),
        "degree_u": int(surface.degree_u),
        "degree_v": int(surface.degree_v),
        "knots_u": _rounded(surface.knots_u, 10),
        "knots_v": _rounded(surface.knots_v, 10),
        "control_points": _rounded(surface.control_points, 6),
        "covariance": _covariance(surface.covariance),
        "residuals": {"points": int(residuals.points)}
        | {name: _significant(value, 6) for name, value in asdict(residuals).items() if name != "points"},
        "trims": [_loop(loop) for loop in surface.trims],
    }


def _loop(loop: TrimLoop) -> dict[str, Any]:
    return {"parameters": _rounded(loop.parameters, 5), "creases": np.asarray(loop.creases).tolist()}


def _crease(crease: Crease) -> dict[str, Any]:
    first, last = (corner >= 0 for corner in crease.corners)
    points = crease.points[int(first) : len(crease.points) - int(last)]
    return {
        "surfaces": list(crease.surfaces),
        "corners": [int(corner) for corner in crease.corners],
        "points": _rounded(points, 5),
    }


def _covariance(covariance: SurfaceCovariance | HeightCovariance) -> dict[str, Any]:
    if isinstance(covariance, HeightCovariance):
        return {
            "directions": _rounded(covariance.directions, 7),
            **_heights(covariance.matrix),
            "pose": _shares(covariance),
        }
    return {
        "blocks": _significant(covariance.blocks, 4),
        "correlation_u": _rounded(_upper(covariance.correlation_u), 6),
        "correlation_v": _rounded(_upper(covariance.correlation_v), 6),
        "pose": _shares(covariance),
    }


def _heights(matrix: Array) -> dict[str, Any]:
    """Covariance of heights by its root, which needs fewer digits: what is small is no difference of what is large."""
    root = rounded_root(matrix, ROOT_UNIT, LEAST_ROOT)
    if root is None:
        return {"matrix": _significant(_upper(matrix), 7)}
    return {"root": _upper(root.T).astype(int).tolist()}


def _shares(covariance: SurfaceCovariance | HeightCovariance) -> list[dict[str, Any]]:
    return [{"data_set": part.data_set, "weight": _rounded(part.weight, 6)} for part in covariance.pose]


def _poses(surfaces: SurfaceMap) -> list[PosePart]:
    """Errors of pose of all data sets that surfaces refer to, each once; ValueError where surfaces tell two of one."""
    found: dict[str, PosePart] = {}
    for surface in surfaces.surfaces:
        for part in surface.covariance.pose:
            before = found.setdefault(part.data_set, part)
            if not np.array_equal(before.covariance, part.covariance) or not np.array_equal(before.centre, part.centre):
                raise ValueError(f"surface {surface.name}: another error of pose of data set {part.data_set}")
    return [found[name] for name in sorted(found)]


def _pose_part(part: PosePart) -> dict[str, Any]:
    return {
        "data_set": part.data_set,
        "centre": _rounded(part.centre, 6),
        "covariance": _significant(_upper(part.covariance), 4),
        "trajectory": part.trajectory,
        "modes": None if part.modes is None else _significant(part.modes.T, 4),
    }


def _placement(placement: Placement) -> dict[str, Any]:
    arrays = {
        "pose": placement.pose.tolist(),
        "covariance": _significant(_upper(placement.covariance), 4),
        "rival_pose": None if placement.rival_pose is None else placement.rival_pose.tolist(),
    }
    return {name: arrays[name] if name in arrays else plain_json(value) for name, value in vars(placement).items()}


def _upper(matrix: Array) -> Array:
    """Upper triangle of a matrix, row by row."""
    return np.asarray(matrix)[np.triu_indices(len(matrix))]


def _rounded(values: ArrayLike, decimals: int) -> Any:
    return (np.round(np.asarray(values, dtype=float), decimals) + 0.0).tolist()  # + 0.0 turns -0.0 into 0.0


def _significant(values: Any, digits: int) -> Any:
    """Nested lists of the values rounded to significant digits."""
    array = np.asarray(values, dtype=float) + 0.0
    rounded = [float(f"{value:.{digits - 1}e}") for value in array.ravel().tolist()]
    return np.array(rounded).reshape(array.shape).tolist()


def read_surfaces(path: Path | str) -> SurfaceMap:
    """Read surfaces, and check all of them.

    Raises
    ------
    MissingInputError
        There is no such file.
    BadInputError
        It is not such a file, of another version, cut, or wrong in itself; the message names surface, field and value.
    """
    plain = _load(path)
    try:
        return parse_map(plain)
    except MalformedError as error:
        raise BadInputError(f"{path}: {error}") from error


def _content(path: Path | str) -> bytes:
    try:
        content = Path(path).read_bytes()
        return gzip.decompress(content) if content.startswith(b"\x1f\x8b") else content
    except (EOFError, gzip.BadGzipFile, zlib.error) as error:
        raise BadInputError(f"{path}: was cut or is damaged ({error}); make it again") from error
    except OSError as error:
        raise MissingInputError(f"{path}: {error.strerror or error}") from error


def _load(path: Path | str) -> dict[str, Any]:
    try:
        plain = json.loads(_content(path))
    except ValueError as error:  # UnicodeDecodeError and JSONDecodeError are ValueErrors
        raise BadInputError(f"{path}: is not JSON, or was cut ({error}); make it again") from error
    if not isinstance(plain, dict) or plain.get("format") != FORMAT:
        raise BadInputError(f"{path}: is JSON, but not surfaces of bsmap (its `format` is not {FORMAT!r})")
    if plain.get("version") != VERSION:
        raise BadInputError(
            f"{path}: is of version {plain.get('version')!r}, this bsmap reads {VERSION}; make it again"
        )
    return plain
