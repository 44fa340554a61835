"""The artifact of `fit` and `merge`: B-spline surfaces as JSON (.surfaces.json, .map.json; .gz by name).

    {"format": "bsmap-surfaces", "version": 8, "units": "metres, radians, frame map",
     "bsmap-provenance": {...},
     "data_sets": [{"name", "movement": "translation" | "rotation", "first_scan", "last_scan", "points"}, ...],
     "poses": [{"data_set", "centre": [x, y], "trajectory": name,
                "own": [xx, xy, xt, yy, yt, tt], symmetric root of the covariance of what of (x, y, theta) the data set
                       has in common with no other one,
                "modes": k x 3, or null where it is not known what poses have in common}, ...],
                             both in units of 0.01 mm and 1e-6 rad
     "surfaces": [surface, ...],
     "decisions": [{"outcome": "merged" | "refused" | "moved", "reason", "figures": [names],
                    "pairs": [[first, second, value of each figure, ...], ...]}, ...],
     "corners": k x 3 points in which creases end together, units of 0.1 mm, D
     "creases": [{"surfaces": [number, number], "corners": [first, last],
                  "points": k x 3 polyline, units of 0.1 mm, D}, ...],
                             corners: their numbers, -1 for a free end; corners are not among the points
     "placements": [{"survey", "pose": [x, y, turn], "height", "covariance": [xx, xy, xt, yy, yt, tt],
                     "matched", "denied", "rival", "rival_pose": [x, y, turn] or null, "verdict": "unique"}, ...],
                             of maps that were brought into this frame, by their numbers among the inputs from 0 on
     "notes": {...}}

    surface = {"name", "data_sets": [names],
     "degree_u", "degree_v",
     "knots_u", "knots_v":     inner knots of clamped knot vectors on [0, 1]: nu - degree_u - 1 and nv - degree_v - 1
     "control_points":         nu x nv x 3, units of 0.01 mm, D along v and then along u
     "covariance": {
        "blocks":              nu x nv x 6: xx, xy, xz, yy, yz, zz of the control points' sensor part
        "correlation_u", "correlation_v":   upper triangles row by row, nu (nu + 1) / 2 and nv (nv + 1) / 2 numbers
        or, of control points that move along given directions only,
        "directions":          nu or 1 x nv or 1 x 3 unit vectors, units of 1e-5
        "scale", "root":       lower triangle L column by column, n (n + 1) / 2 numbers, n = nu nv: the heights'
                               covariance is L L', in units of scale times 1e-8 m; 6 numbers where n = 4: of the first
                               three heights, all four lie in a plane; or, of one that is nearly singular,
        "matrix":              its upper triangle row by row, in square metres
        and "weights":         of the poses of the data sets, units of 1e-4; null for one without, [] where none has}
     "trims": [{"parameters": k x 2, u and v of a closed polygon, in steps of which 1 has ceil(2000 l): l is the longest
                              way in metres along the control points of one v, or of one u; trim_loops.py tells from
                              where each vertex is counted,
                "creases": k numbers of the creases along the sides from each vertex to the next: 0 for none, 1 for the
                              first, -1 where the loop runs along it backwards,
                "rims": [[first side, how many, metres within which the edge of the thing runs along them, in units of
                          1 mm], ...] of what creases tell nothing of}, ...]
                             no trims: the whole surface; else what the loops together wind around counter-clockwise
     "residuals": [points, mean, rms, percentile_95, maximum],
     "side":                   1: S_u x S_v points to the sensor that saw the surface, -1: away from it, 0: not known}

model/surfaces.py tells what each is. What has units is in whole numbers of them; D: the first one, and of each other
the difference to the one before. Others are rounded to what they are worth: correlations to 1e-6, knots to 1e-10,
places of poses to 1e-4, covariances to 4 (those of heights that are nearly singular to 7) and residuals to 2
significant digits. A map that was read is written again byte for byte.
"""

import gzip
import json
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from bsmap_cli.core.bspline import inner_knots
from bsmap_cli.core.uncertainty import is_plane
from bsmap_cli.errors import BadInputError, MissingInputError
from bsmap_cli.io.artifact import Provenance, atomic_output, plain_json
from bsmap_cli.io.surfaces_check import MalformedError, parse_map
from bsmap_cli.io.trim_loops import Sheet, pack_loop, pack_rims, sheet_of
from bsmap_cli.io.whole_numbers import (
    CURVES,
    DIRECTIONS,
    POINTS,
    POSES,
    WEIGHTS,
    from_whole,
    pose_root,
    runs_of,
    scaled_root,
    whole,
)
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
VERSION = 8


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
    numbers = {surface.name: number for number, surface in enumerate(surfaces.surfaces)}
    lines = [_stored_line(crease) for crease in surfaces.creases]
    parts = [
        _dumps(head)[1:-1],
        _list("data_sets", [plain_json(asdict(data_set)) for data_set in surfaces.data_sets]),
        _list("poses", [_pose_part(part) for part in _poses(surfaces)]),
        _list("surfaces", [_surface(surface, lines) for surface in surfaces.surfaces]),
        _list("decisions", [plain_json(run) for run in runs_of(surfaces.decisions)]),
        _list("corners", whole(surfaces.corners, CURVES, (0,))),
        _list("creases", [_crease(crease, numbers) for crease in surfaces.creases]),
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


def _stored_line(crease: Crease) -> Array:
    """Points (k, 3) of a crease as the file has them."""
    return from_whole(np.array(whole(crease.points, CURVES)), CURVES)


def _surface(surface: BSplineSurface, lines: Sequence[Array]) -> dict[str, Any]:
    net = whole(surface.control_points, POINTS, (0, 1))
    sheet = sheet_of(from_whole(np.array(net), POINTS, (0, 1)))
    inner_u, inner_v = (
        inner_knots(knots, degree)
        for knots, degree in ((surface.knots_u, surface.degree_u), (surface.knots_v, surface.degree_v))
    )
    return {
        "name": surface.name,
        "data_sets": list(surface.data_sets),
        "degree_u": int(surface.degree_u),
        "degree_v": int(surface.degree_v),
        "knots_u": _rounded(inner_u, 10),
        "knots_v": _rounded(inner_v, 10),
        "control_points": net,
        "covariance": _covariance(surface.covariance) | {"weights": _weights(surface)},
        "residuals": [int(surface.residuals.points), *_significant(list(vars(surface.residuals).values())[1:], 2)],
        "trims": [_loop(loop, sheet, lines) for loop in surface.trims],
        "side": int(surface.side),
    }


def _loop(loop: TrimLoop, sheet: Sheet, lines: Sequence[Array]) -> dict[str, Any]:
    numbers, creases = pack_loop(loop, sheet, lines)
    return {"parameters": numbers.tolist(), "creases": creases.tolist(), "rims": pack_rims(loop)}


def _crease(crease: Crease, numbers: Mapping[str, int]) -> dict[str, Any]:
    first, last = (corner >= 0 for corner in crease.corners)
    points = crease.points[int(first) : len(crease.points) - int(last)]
    return {
        "surfaces": [numbers[name] for name in crease.surfaces],
        "corners": [int(corner) for corner in crease.corners],
        "points": whole(points, CURVES, (0,)),
    }


def _covariance(covariance: SurfaceCovariance | HeightCovariance) -> dict[str, Any]:
    if isinstance(covariance, HeightCovariance):
        return {"directions": whole(covariance.directions, DIRECTIONS), **_heights(covariance.matrix)}
    return {
        "blocks": _significant(covariance.blocks, 4),
        "correlation_u": _rounded(_upper(covariance.correlation_u), 6),
        "correlation_v": _rounded(_upper(covariance.correlation_v), 6),
    }


def _heights(matrix: Array) -> dict[str, Any]:
    """Covariance of heights by its root, which needs fewer digits: what is small is no difference of what is large."""
    found = scaled_root(matrix[:3, :3] if is_plane(matrix) else matrix)
    if found is None:
        return {"matrix": _significant(_upper(matrix), 7)}
    return {"scale": found[0], "root": _upper(found[1].T).astype(int).tolist()}


def _weights(surface: BSplineSurface) -> list[int | None]:
    """Of the data sets' poses, in the order of the surface's data sets; ValueError where a pose is of another one."""
    weights = {part.data_set: whole(part.weight, WEIGHTS) for part in surface.covariance.pose}
    if unknown := sorted(weights.keys() - set(surface.data_sets)):
        raise ValueError(f"surface {surface.name}: has the pose of {unknown[0]}, which is none of its data sets")
    return [weights.get(name) for name in surface.data_sets] if weights else []


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
        "centre": _rounded(part.centre, 4),
        "trajectory": part.trajectory,
        "own": pose_root(part.own),
        "modes": None if part.modes is None else whole(part.modes.T, POSES),
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
