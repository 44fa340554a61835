"""Checked way from the JSON of surfaces_json.py to the model: what is wrong is told by surface, field and value."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from bsmap_cli.core.bspline import clamped_knots
from bsmap_cli.core.uncertainty import FROM_THREE
from bsmap_cli.io.trim_loops import Sheet, sheet_of, unpack_loop, unpack_rims
from bsmap_cli.io.whole_numbers import CURVES, DIRECTIONS, POINTS, POSES, ROOTS, WEIGHTS, from_pose_root, from_whole
from bsmap_cli.model import (
    Array,
    BSplineSurface,
    Crease,
    DataSet,
    Decision,
    HeightCovariance,
    IntArray,
    Placement,
    PosePart,
    Residuals,
    SurfaceCovariance,
    SurfaceMap,
    TrimLoop,
)

# Rounding to 4 significant digits, or 6 decimals, makes a singular covariance indefinite by less than these.
BLOCK_TOLERANCE = 1e-3
CORRELATION_TOLERANCE = 1e-4
HEIGHT_TOLERANCE = 1e-6
OUTCOMES = ("merged", "refused", "moved")
LENGTH_TOLERANCE = 1e-4
"""Of directions, which are of length 1."""
MOVEMENTS = ("translation", "rotation", "unorganised")


class MalformedError(ValueError):
    """What is wrong in the file, without its name."""


def parse_map(plain: dict[str, Any]) -> SurfaceMap:
    """Surfaces of a file's JSON object; MalformedError where it does not make sense."""
    corners = from_whole(_points(plain, "corners", "file"), CURVES, (0,))
    poses = _poses(_get(plain, "poses", list, "file"))
    names = [_get(s, "name", str, f"surfaces[{i}]") for i, s in enumerate(_get(plain, "surfaces", list, "file"))]
    counts = Counter(names)
    if twice := sorted(name for name, count in counts.items() if count > 1):
        raise MalformedError(f"surfaces: the name {twice[0]!r} is there twice")
    creases = tuple(
        _crease(c, corners, names, f"creases[{i}]") for i, c in enumerate(_get(plain, "creases", list, "file"))
    )
    lines = [crease.points for crease in creases]
    surfaces = tuple(_surface(s, f"surfaces[{i}]", lines, poses) for i, s in enumerate(plain["surfaces"]))
    return SurfaceMap(
        surfaces=surfaces,
        data_sets=tuple(_data_set(d, f"data_sets[{i}]") for i, d in enumerate(_get(plain, "data_sets", list, "file"))),
        decisions=tuple(
            decision
            for i, run in enumerate(_get(plain, "decisions", list, "file"))
            for decision in _decisions(run, f"decisions[{i}]")
        ),
        notes=_get(plain, "notes", dict, "file"),
        creases=creases,
        corners=corners,
        placements=tuple(
            _placement(p, f"placements[{i}]") for i, p in enumerate(_get(plain, "placements", list, "file"))
        ),
    )


def _crease(plain: Any, corners: Array, surfaces: Sequence[str], where: str) -> Crease:
    numbers = _numbers(plain, "surfaces", 2, len(surfaces), "surface", where).tolist()
    if -1 in numbers:
        raise MalformedError(f"{where}: surfaces holds -1, wanted two numbers of surfaces")
    first, last = _numbers(plain, "corners", 2, len(corners), "corner", where).tolist()
    ends = [corners[k : k + 1] if k >= 0 else np.zeros((0, 3)) for k in (first, last)]
    inner = from_whole(_points(plain, "points", where), CURVES, (0,))
    points = np.concatenate([ends[0], inner, ends[1]])
    if len(points) < 2:
        raise MalformedError(f"{where}: has {len(points)} points with its corners, wanted 2 or more")
    return Crease((surfaces[numbers[0]], surfaces[numbers[1]]), points, (first, last))


def _points(plain: Any, key: str, where: str) -> Array:
    """Points (n, 3) of a key, which can be none."""
    return np.zeros((0, 3)) if _get(plain, key, list, where) == [] else _array(plain, key, (None, 3), where)


def _surface(plain: Any, where: str, lines: Sequence[Array], poses: dict[str, PosePart]) -> BSplineSurface:
    name = _get(plain, "name", str, where)
    where = f"{where} ({name})"
    p, q = (_degree(plain, key, where) for key in ("degree_u", "degree_v"))
    knots_u, knots_v = _knots(plain, "knots_u", p, where), _knots(plain, "knots_v", q, where)
    nu, nv = len(knots_u) - p - 1, len(knots_v) - q - 1
    net = from_whole(_array(plain, "control_points", (nu, nv, 3), where), POINTS, (0, 1))
    data_sets, sheet = _names(plain, "data_sets", where), sheet_of(net)
    return BSplineSurface(
        name=name,
        data_sets=data_sets,
        degree_u=p,
        degree_v=q,
        knots_u=knots_u,
        knots_v=knots_v,
        control_points=net,
        covariance=_covariance(
            _get(plain, "covariance", dict, where), (nu, nv), data_sets, poses, f"{where}: covariance"
        ),
        residuals=_residuals(plain, where),
        trims=tuple(
            _loop(loop, sheet, lines, f"{where}: trims[{i}]")
            for i, loop in enumerate(_get(plain, "trims", list, where))
        ),
        side=_side(plain, where),
    )


def _side(plain: dict[str, Any], where: str) -> int:
    side = _get(plain, "side", int, where)
    if side not in (-1, 0, 1):
        raise MalformedError(f"{where}: side is {side}, wanted 1, -1 or 0")
    return side


def _loop(plain: Any, sheet: Sheet, lines: Sequence[Array], where: str) -> TrimLoop:
    numbers = _array(plain, "parameters", (None, 2), where)
    if len(numbers) < 3:
        raise MalformedError(f"{where}: parameters has {len(numbers)} vertices, wanted 3 or more")
    creases = _array(plain, "creases", (len(numbers),), where)
    bad = np.flatnonzero((creases != np.rint(creases)) | (np.abs(creases) > len(lines)))
    if len(bad):
        raise MalformedError(f"{where}: creases[{bad[0]}] is {creases[bad[0]]:g}, wanted 0 or a number of a crease")
    loop = unpack_loop(numbers, creases.astype(np.int64), sheet, lines)
    if np.any((loop.parameters < 0.0) | (loop.parameters > 1.0)):
        raise MalformedError(f"{where}: parameters lie outside [0, 1]")
    rims = np.zeros((0, 3)) if _get(plain, "rims", list, where) == [] else _array(plain, "rims", (None, 3), where)
    try:
        return unpack_rims(loop, np.rint(rims).astype(np.int64).tolist())
    except ValueError as error:
        raise MalformedError(f"{where}: {error}") from error


def _numbers(plain: Any, key: str, count: int, limit: int, what: str, where: str) -> IntArray:
    """(count,) numbers of things of which there are `limit`, or -1."""
    numbers = _array(plain, key, (count,), where)
    bad = np.flatnonzero((numbers != np.rint(numbers)) | (numbers < -1) | (numbers >= limit))
    if len(bad):
        raise MalformedError(f"{where}: {key}[{bad[0]}] is {numbers[bad[0]]:g}, wanted -1 or a number of a {what}")
    return numbers.astype(np.int64)


def _degree(plain: dict[str, Any], key: str, where: str) -> int:
    degree: int = _get(plain, key, int, where)
    if degree < 1:
        raise MalformedError(f"{where}: {key} is {degree}, wanted 1 or more")
    return degree


def _knots(plain: dict[str, Any], key: str, degree: int, where: str) -> Array:
    """Clamped knot vector on [0, 1] of inner knots, none of them more than `degree` times."""
    inner = np.zeros(0) if _get(plain, key, list, where) == [] else _array(plain, key, (None,), where)
    down = np.flatnonzero(np.diff(inner) < 0)
    if len(down):
        k = int(down[0])
        raise MalformedError(f"{where}: {key} must ascend, but knot {k} is {inner[k]} and knot {k + 1} {inner[k + 1]}")
    values, counts = np.unique(inner, return_counts=True)
    for value, count in zip(values.tolist(), counts.tolist(), strict=True):
        if count > degree or not 0.0 < value < 1.0:
            what = "is there too often for degree" if 0.0 < value < 1.0 else "lies outside (0, 1), of degree"
            raise MalformedError(f"{where}: {key}: knot {value} {what} {degree}")
    return clamped_knots(degree, inner)


def _covariance(
    plain: dict[str, Any], size: tuple[int, int], data_sets: Sequence[str], poses: dict[str, PosePart], where: str
) -> SurfaceCovariance | HeightCovariance:
    nu, nv = size
    pose = _pose(plain, data_sets, poses, where)
    if "directions" in plain:
        return _heights(plain, nu, nv, pose, where)
    blocks = _array(plain, "blocks", (nu, nv, 6), where)
    _check_blocks(blocks, where)
    return SurfaceCovariance(
        blocks=blocks,
        correlation_u=_correlation(plain, "correlation_u", nu, where),
        correlation_v=_correlation(plain, "correlation_v", nv, where),
        pose=pose,
    )


def _heights(plain: dict[str, Any], nu: int, nv: int, pose: tuple[PosePart, ...], where: str) -> HeightCovariance:
    directions = from_whole(_array(plain, "directions", (None, None, 3), where), DIRECTIONS)
    if directions.shape[0] not in (1, nu) or directions.shape[1] not in (1, nv):
        got = " x ".join(map(str, directions.shape))
        raise MalformedError(f"{where}: directions is {got}, wanted {nu} or 1 x {nv} or 1 x 3")
    if np.any(np.abs(np.linalg.norm(directions, axis=2) - 1.0) > LENGTH_TOLERANCE):
        raise MalformedError(f"{where}: directions are not of length 1")
    n = nu * nv
    if "root" in plain:
        root = _root(plain, n, where) * _get(plain, "scale", int, where) / ROOTS
        return HeightCovariance(directions, root @ root.T, pose)
    matrix = _symmetric(_array(plain, "matrix", (n * (n + 1) // 2,), where), n)
    eigenvalues = np.linalg.eigvalsh(matrix)
    if eigenvalues[0] < -HEIGHT_TOLERANCE * abs(eigenvalues[-1]):
        raise MalformedError(f"{where}: matrix is not positive semidefinite (eigenvalue {eigenvalues[0]:.3g})")
    return HeightCovariance(directions, matrix, pose)


def _root(plain: dict[str, Any], n: int, where: str) -> Array:
    """Root (n, n), or of a plane (4, 3), of the covariance of n heights, in the file's units."""
    numbers = _array(plain, "root", (None,), where)
    plane = n == 4 and len(numbers) == 6
    size = 3 if plane else n
    if len(numbers) != size * (size + 1) // 2:
        raise MalformedError(f"{where}: root is {len(numbers)}, wanted {n * (n + 1) // 2}")
    root = np.zeros((size, size))
    root.T[np.triu_indices(size)] = numbers
    return np.asarray(FROM_THREE @ root) if plane else root


def _pose(
    plain: dict[str, Any], data_sets: Sequence[str], poses: dict[str, PosePart], where: str
) -> tuple[PosePart, ...]:
    """Pose parts of a surface, by the weights of its data sets."""
    weights = _get(plain, "weights", list, where)
    if weights and len(weights) != len(data_sets):
        raise MalformedError(f"{where}: weights is {len(weights)}, wanted {len(data_sets)}, as many as data_sets")
    parts = []
    for name, weight in zip(data_sets, weights, strict=bool(weights)):
        if weight is None:
            continue
        if isinstance(weight, bool) or not isinstance(weight, int):
            raise MalformedError(f"{where}: weights holds {_short(weight)}, wanted whole numbers or null")
        if name not in poses:
            raise MalformedError(f"{where}: weights: there is no pose of data set {name!r}")
        parts.append(replace(poses[name], weight=weight / WEIGHTS))
    return tuple(parts)


def _poses(plain: list[Any]) -> dict[str, PosePart]:
    parts = [_pose_part(part, f"poses[{i}]") for i, part in enumerate(plain)]
    counts = dict[str, int]()
    for i, part in enumerate(parts):
        modes = part.modes.shape[1] if part.modes is not None else counts.get(part.trajectory, 0)
        if counts.setdefault(part.trajectory, modes) != modes:
            raise MalformedError(f"poses[{i}]: has {modes} modes, others of its trajectory {counts[part.trajectory]}")
    return {part.data_set: part for part in parts}


def _check_blocks(blocks: Array, where: str) -> None:
    eigenvalues = np.linalg.eigvalsh(blocks[..., [[0, 1, 2], [1, 3, 4], [2, 4, 5]]])
    bad = np.argwhere(eigenvalues[..., 0] < -BLOCK_TOLERANCE * np.abs(eigenvalues).max(axis=-1))
    if len(bad):
        i, j = bad[0].tolist()
        raise MalformedError(
            f"{where}: blocks[{i}][{j}] is not positive semidefinite (eigenvalue {eigenvalues[i, j, 0]:.3g})"
        )


def _correlation(plain: dict[str, Any], key: str, n: int, where: str) -> Array:
    matrix = _symmetric(_array(plain, key, (n * (n + 1) // 2,), where), n)
    if np.any(np.abs(np.diag(matrix) - 1.0) > 1e-5):
        raise MalformedError(f"{where}: {key} has a diagonal that is not 1")
    lowest = float(np.linalg.eigvalsh(matrix)[0])
    if lowest < -CORRELATION_TOLERANCE:
        raise MalformedError(f"{where}: {key} is not positive semidefinite (eigenvalue {lowest:.3g})")
    return matrix


def _symmetric(upper: Array, n: int) -> Array:
    matrix = np.zeros((n, n))
    matrix[np.triu_indices(n)] = upper
    return matrix + np.triu(matrix, 1).T


def _pose_covariance(plain: Any, where: str) -> Array:
    covariance = _symmetric(_array(plain, "covariance", (6,), where), 3)
    eigenvalues = np.linalg.eigvalsh(covariance)
    if eigenvalues[0] < -BLOCK_TOLERANCE * np.abs(eigenvalues).max():
        raise MalformedError(f"{where}: covariance is not positive semidefinite (eigenvalue {eigenvalues[0]:.3g})")
    return covariance


def _pose_part(plain: Any, where: str) -> PosePart:
    modes, covariance = _modes(plain, where), from_pose_root(_array(plain, "own", (6,), where))
    return PosePart(
        data_set=_get(plain, "data_set", str, where),
        centre=_array(plain, "centre", (2,), where),
        covariance=covariance if modes is None else covariance + modes @ modes.T,
        modes=modes,
        trajectory=_get(plain, "trajectory", str, where),
    )


def _modes(plain: dict[str, Any], where: str) -> Array | None:
    if plain.get("modes") is None:
        return None
    if plain["modes"] == []:
        return np.zeros((3, 0))
    return from_whole(_array(plain, "modes", (None, 3), where), POSES).T


def _residuals(plain: dict[str, Any], where: str) -> Residuals:
    points, *others = _array(plain, "residuals", (5,), where).tolist()
    if points < 0 or points != int(points):
        raise MalformedError(f"{where}: residuals[0] is {points:g}, wanted a whole number, 0 or more")
    return Residuals(int(points), *others)


def _data_set(plain: Any, where: str) -> DataSet:
    name, movement = _get(plain, "name", str, where), _get(plain, "movement", str, where)
    if movement not in MOVEMENTS:
        raise MalformedError(f"{where} ({name}): movement is {movement!r}, wanted {', '.join(MOVEMENTS)}")
    return DataSet(name, movement, *(_count(plain, key, where) for key in ("first_scan", "last_scan", "points")))


def _decisions(plain: Any, where: str) -> list[Decision]:
    outcome, reason = _get(plain, "outcome", str, where), _get(plain, "reason", str, where)
    if outcome not in OUTCOMES:
        raise MalformedError(f"{where}: outcome is {outcome!r}, wanted {', '.join(OUTCOMES)}")
    figures, found = _names(plain, "figures", where), []
    for i, pair in enumerate(_get(plain, "pairs", list, where)):
        if not isinstance(pair, list) or len(pair) != 2 + len(figures):
            raise MalformedError(f"{where}: pairs[{i}] is {_short(pair)}, wanted two names and {len(figures)} figures")
        if not all(isinstance(name, str) for name in pair[:2]):
            raise MalformedError(f"{where}: pairs[{i}] begins with {_short(pair[:2])}, wanted two names")
        found.append(Decision(pair[0], pair[1], outcome, reason, dict(zip(figures, pair[2:], strict=True))))
    return found


def _placement(plain: Any, where: str) -> Placement:
    verdict = _get(plain, "verdict", str, where)
    if verdict != "unique":
        raise MalformedError(f"{where}: verdict is {verdict!r}, wanted unique")
    return Placement(
        survey=_count(plain, "survey", where),
        pose=_array(plain, "pose", (3,), where),
        covariance=_pose_covariance(plain, where),
        rival_pose=None if plain.get("rival_pose") is None else _array(plain, "rival_pose", (3,), where),
        verdict=verdict,
        **{name: _number(plain, name, where) for name in ("height", "matched", "denied", "rival")},
    )


def _get(plain: Any, key: str, kind: type, where: str) -> Any:
    """Value of a key; it must be there and of a JSON type."""
    if not isinstance(plain, dict):
        raise MalformedError(f"{where}: is {_short(plain)}, wanted an object")
    if key not in plain:
        raise MalformedError(f"{where}: {key} is missing")
    value = plain[key]
    if not isinstance(value, kind) or isinstance(value, bool):
        names = {str: "a string", int: "an integer", list: "a list", dict: "an object"}
        raise MalformedError(f"{where}: {key} is {_short(value)}, wanted {names[kind]}")
    return value


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 40 else text[:37] + "..."


def _names(plain: dict[str, Any], key: str, where: str) -> tuple[str, ...]:
    names = _get(plain, key, list, where)
    if not all(isinstance(name, str) for name in names):
        raise MalformedError(f"{where}: {key} is {_short(names)}, wanted a list of strings")
    return tuple(names)


def _count(plain: dict[str, Any], key: str, where: str) -> int:
    count: int = _get(plain, key, int, where)
    if count < 0:
        raise MalformedError(f"{where}: {key} is {count}, wanted 0 or more")
    return count


def _number(plain: dict[str, Any], key: str, where: str) -> float:
    return float(_array(plain, key, (), where))


def _array(plain: Any, key: str, shape: tuple[int | None, ...], where: str) -> Array:
    """Numbers of a key as an array of `shape` (None: any length), all finite."""
    value = _get(plain, key, object, where)
    try:
        array = np.array(value)
    except ValueError:
        raise MalformedError(f"{where}: {key}: its rows are of different lengths") from None
    if array.dtype.kind not in "iuf":
        raise MalformedError(f"{where}: {key} is {_short(value)}, wanted numbers")
    if len(array.shape) != len(shape) or any(s not in (None, g) for s, g in zip(shape, array.shape, strict=True)):
        got, wanted = (" x ".join(str(s or "any") for s in sizes) or "one number" for sizes in (array.shape, shape))
        raise MalformedError(f"{where}: {key} is {got}, wanted {wanted}")
    bad = np.argwhere(~np.isfinite(array))
    if len(bad):
        index = "".join(f"[{i}]" for i in bad[0].tolist())
        raise MalformedError(f"{where}: {key}{index} is {array[tuple(bad[0])]}, wanted a finite number")
    return array.astype(float)
