"""The artifact of `fit` and `merge`: round trip, bytes, and every refusal by its message."""

import copy
import gzip
import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bsmap_cli.core.uncertainty import FROM_THREE, is_plane
from bsmap_cli.errors import BadInputError, MissingInputError
from bsmap_cli.io.artifact import Provenance, is_up_to_date, read_provenance
from bsmap_cli.io.surfaces_json import read_surfaces, write_surfaces
from bsmap_cli.model import (
    BSplineSurface,
    DataSet,
    Decision,
    HeightCovariance,
    PosePart,
    Residuals,
    SurfaceCovariance,
    SurfaceMap,
)

MADE = Provenance("fit", "0.1.0", {"bound_u": 0.01}, (("a.cloud.ply", "0" * 64),), "e" * 56, {"surfaces": 2})


ENDS = np.array([0.0, 0.0, 1.0, 1.0])


def correlation(rng: np.random.Generator, n: int) -> np.ndarray:
    half = rng.normal(size=(n, n + 3))
    C = half @ half.T
    s = np.sqrt(np.diag(C))
    return C / np.outer(s, s)


def surface(name: str = "translation-0", nu: int = 7, nv: int = 5) -> BSplineSurface:
    rng = np.random.default_rng(4)
    half = rng.normal(size=(nu, nv, 3, 3)) * 1e-3
    C = half @ half.swapaxes(-1, -2)
    pose = rng.normal(size=(3, 3)) * 1e-2
    part = PosePart(name, rng.normal(size=2), pose @ pose.T, 0.625, pose[:, :2], "1a2b")
    knots = [np.r_[[0.0] * 4, np.sort(rng.uniform(size=n - 4)), [1.0] * 4] for n in (nu, nv)]
    blocks = C[..., [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    return BSplineSurface(
        name,
        (name,),
        3,
        3,
        *knots,
        rng.normal(size=(nu, nv, 3)) * 5,
        SurfaceCovariance(blocks, correlation(rng, nu), correlation(rng, nv), (part,)),
        Residuals(1234, 0.0041234567, 0.005, 0.0099, 0.031),
    )


def surface_map() -> SurfaceMap:
    return SurfaceMap(
        (surface(), surface("rotation-1", 4, 4)),
        (DataSet("translation-0", "translation", 0, 19, 900), DataSet("rotation-1", "rotation", 19, 30, 334)),
        (Decision("translation-0", "rotation-1", "refused", "too far", {"distance": 0.25}),),
        {"seed": np.int64(3), "worst": math.inf},
    )


@pytest.mark.parametrize("name", ["a.surfaces.json", "a.map.json.gz"])
def test_surfaces_come_back_to_what_the_numbers_are_worth(tmp_path: Path, name: str) -> None:
    made, path = surface_map(), tmp_path / name
    write_surfaces(path, made, MADE)
    read = read_surfaces(path)
    assert (read.data_sets, read.decisions) == (made.data_sets, made.decisions)
    assert read.notes == {"seed": 3, "worst": "inf"}
    for one, other in zip(read.surfaces, made.surfaces, strict=True):
        assert (one.name, one.data_sets, one.degree_u, one.degree_v) == (other.name, other.data_sets, 3, 3)
        np.testing.assert_allclose(one.knots_u, other.knots_u, atol=1e-10)
        np.testing.assert_allclose(one.knots_v, other.knots_v, atol=1e-10)
        np.testing.assert_allclose(one.control_points, other.control_points, atol=0.51e-5)
        np.testing.assert_allclose(one.covariance.blocks, other.covariance.blocks, rtol=0.51e-3)
        np.testing.assert_allclose(one.covariance.correlation_u, other.covariance.correlation_u, atol=0.51e-6)
        np.testing.assert_allclose(one.covariance.correlation_v, other.covariance.correlation_v, atol=0.51e-6)
        (part,), (wanted,) = one.covariance.pose, other.covariance.pose
        assert (part.data_set, part.weight) == (wanted.data_set, wanted.weight)
        np.testing.assert_allclose(part.covariance, wanted.covariance, atol=5e-7)
        np.testing.assert_allclose(part.centre, wanted.centre, atol=0.51e-4)
        np.testing.assert_allclose(part.modes, wanted.modes, atol=0.51e-5)
        assert part.trajectory == wanted.trajectory
        assert one.residuals.points == other.residuals.points
        assert one.residuals.mean == pytest.approx(other.residuals.mean, rel=0.51e-1)
    assert read_provenance(path) == MADE
    assert is_up_to_date(path, MADE.fingerprint)


def test_what_was_read_is_written_byte_for_byte(tmp_path: Path) -> None:
    for name in ("a.json", "a.json.gz"):
        write_surfaces(tmp_path / name, surface_map(), MADE)
        write_surfaces(tmp_path / f"again-{name}", read_surfaces(tmp_path / name), MADE)
        assert (tmp_path / name).read_bytes() == (tmp_path / f"again-{name}").read_bytes()
    assert gzip.decompress((tmp_path / "a.json.gz").read_bytes()) == (tmp_path / "a.json").read_bytes()


def test_empty_map(tmp_path: Path) -> None:
    write_surfaces(tmp_path / "a.json", SurfaceMap((), ()))
    read = read_surfaces(tmp_path / "a.json")
    assert (read.surfaces, read.data_sets, read.decisions, read.notes, read.creases) == ((), (), (), {}, ())
    assert read.corners.shape == (0, 3)


def test_number_that_is_not_finite_is_not_written(tmp_path: Path) -> None:
    bad = surface()
    bad.control_points[0, 0, 0] = np.nan
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_surfaces(tmp_path / "a.json", SurfaceMap((bad,), ()))
    assert not list(tmp_path.iterdir())


def test_rounding_of_a_singular_covariance_is_accepted(tmp_path: Path) -> None:
    flat = surface()
    direction = np.array([0.123456, 0.654321, 0.333333])
    flat.covariance.blocks[:] = np.outer(direction, direction)[[0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    ones = replace(flat.covariance, correlation_u=np.ones((7, 7)))
    write_surfaces(tmp_path / "a.json", SurfaceMap((replace(flat, covariance=ones),), ()))
    read_surfaces(tmp_path / "a.json")


def test_covariance_of_a_plane_comes_back_as_that_of_a_plane(tmp_path: Path) -> None:
    """Of four heights that lie in a plane the covariance of three is written: 6 numbers, which are rounded."""
    rng = np.random.default_rng(7)
    F = FROM_THREE @ np.tril(rng.normal(size=(3, 3)) * 1e-3 + np.eye(3) * 2e-3)
    curved = surface(nu=4, nv=4)
    known = HeightCovariance(np.array([[[0.0, 0.0, 1.0]]]), F @ F.T, curved.covariance.pose)
    net = curved.control_points[:2, :2]
    flat = BSplineSurface(curved.name, curved.data_sets, 1, 1, ENDS, ENDS, net, known, curved.residuals)
    data_sets = surface_map().data_sets[:1]
    write_surfaces(tmp_path / "a.json", SurfaceMap((flat,), data_sets))
    plain = json.loads((tmp_path / "a.json").read_text())
    assert len(plain["surfaces"][0]["covariance"]["root"]) == 6
    read = read_surfaces(tmp_path / "a.json")
    matrix = read.surfaces[0].covariance.matrix
    assert is_plane(matrix)
    np.testing.assert_allclose(matrix, F @ F.T, rtol=0.0, atol=0.02 * np.diag(F @ F.T).max())
    write_surfaces(tmp_path / "b.json", read)
    assert (tmp_path / "a.json").read_bytes() == (tmp_path / "b.json").read_bytes()


def change(*path: Any, to: Any) -> Callable[[Any], None]:
    """Function that sets a value deep in a JSON object, or removes it where `to` is None."""

    def apply(plain: Any) -> None:
        for key in path[:-1]:
            plain = plain[key]
        if to is None:
            del plain[path[-1]]
        else:
            plain[path[-1]] = to

    return apply


S = "surfaces", 0
WHERE = r"a\.json: surfaces\[0\] \(translation-0\): "
WRONG = [
    (change("format", to="other"), r"is JSON, but not surfaces of bsmap"),
    (change("version", to=9), r"is of version 9, this bsmap reads 8"),
    (change("surfaces", to=None), r"file: surfaces is missing"),
    (change("notes", to=[]), r"file: notes is \[\], wanted an object"),
    (change(*S, to="x"), r"surfaces\[0\]: is 'x', wanted an object"),
    (change("surfaces", 1, "name", to="translation-0"), r"the name 'translation-0' is there twice"),
    (change(*S, "degree_u", to=0), WHERE + "degree_u is 0, wanted 1 or more"),
    (change(*S, "degree_u", to=2.5), WHERE + "degree_u is 2.5, wanted an integer"),
    (change(*S, "degree_v", to=True), WHERE + "degree_v is True, wanted an integer"),
    (change(*S, "degree_v", to=2), WHERE + "control_points is 7 x 5 x 3, wanted 7 x 4 x 3"),
    (change(*S, "knots_u", 0, to=0.999), WHERE + r"knots_u must ascend, but knot 0 is 0\.999 and knot 1"),
    (change(*S, "knots_u", 0, to=-0.1), WHERE + r"knots_u: knot -0\.1 lies outside \(0, 1\)"),
    (change(*S, "knots_u", 0, to=0.0), WHERE + r"knots_u: knot 0\.0 lies outside \(0, 1\)"),
    (change(*S, "knots_v", to=[]), WHERE + "control_points is 7 x 5 x 3, wanted 7 x 4 x 3"),
    (change(*S, "knots_u", to=[0.5] * 4), WHERE + r"knots_u: knot 0\.5 is there too often for degree 3"),
    (change(*S, "knots_u", 1, to=None), WHERE + "control_points is 7 x 5 x 3, wanted 6 x 5 x 3"),
    (change(*S, "knots_u", to="0.5"), WHERE + r"knots_u is '0\.5', wanted"),
    (change(*S, "control_points", 2, 1, 0, to=math.nan), WHERE + r"control_points\[2\]\[1\]\[0\] is nan, wanted a fi"),
    (change(*S, "control_points", 2, 1, to=[1, 2]), WHERE + "control_points: its rows are of different lengths"),
    (change(*S, "covariance", "blocks", 1, 2, 0, to=-1.0), r"covariance: blocks\[1\]\[2\] is not positive semidefin"),
    (
        change(*S, "covariance", "correlation_u", 1, to=1.5),
        r"correlation_u is not positive semidefinite \(eigenvalue -",
    ),
    (change(*S, "covariance", "correlation_u", 0, to=2.0), r"correlation_u has a diagonal that is not 1"),
    (change(*S, "covariance", "correlation_v", 3, to=None), r"covariance: correlation_v is 14, wanted 15"),
    (change("poses", 0, "own", to=[1, 2]), r"poses\[0\]: own is 2, wanted 6"),
    (change(*S, "covariance", "weights", 0, to="1"), r"covariance: weights holds '1', wanted whole numbers or null"),
    (change(*S, "covariance", "weights", to=[1, 2]), r"weights is 2, wanted 1, as many as data_sets"),
    (change("poses", 1, to=None), r"covariance: weights: there is no pose of data set 'translation-0'"),
    (change("poses", 1, "modes", to=[[0.0, 0.0, 0.0]]), r"poses\[1\]: has 1 modes, others of its trajectory 2"),
    (change(*S, "covariance", to=None), WHERE + "covariance is missing"),
    (change(*S, "residuals", 2, to=math.inf), WHERE + r"residuals\[2\] is inf, wanted a finite number"),
    (change(*S, "residuals", 0, to=-1), WHERE + r"residuals\[0\] is -1, wanted a whole number, 0 or more"),
    (change(*S, "data_sets", to=[1]), WHERE + r"data_sets is \[1\], wanted a list of strings"),
    (change("data_sets", 0, "movement", to="fly"), r"data_sets\[0\] \(translation-0\): movement is 'fly', wanted tr"),
    (
        change("decisions", 0, "outcome", to="maybe"),
        r"decisions\[0\]: outcome is 'maybe', wanted merged, refused, moved",
    ),
    (change("decisions", 0, "pairs", 0, to=["a", "b"]), r"decisions\[0\]: pairs\[0\] is .* wanted two names and 1 fig"),
    (change("decisions", 0, "pairs", 0, 0, to=3), r"decisions\[0\]: pairs\[0\] begins with \[3, .* wanted two names"),
]


@pytest.mark.parametrize(("wrong", "message"), WRONG)
def test_what_is_wrong_is_named(tmp_path: Path, wrong: Callable[[Any], None], message: str) -> None:
    path = tmp_path / "a.json"
    write_surfaces(path, surface_map())
    plain = copy.deepcopy(json.loads(path.read_text()))
    wrong(plain)
    path.write_text(json.dumps(plain))
    with pytest.raises(BadInputError, match=message):
        read_surfaces(path)


def test_cut_or_foreign_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    with pytest.raises(MissingInputError, match="No such file"):
        read_surfaces(path)
    for packed in (False, True):
        write_surfaces(path if not packed else tmp_path / "a.json.gz", surface_map())
        content = (tmp_path / ("a.json.gz" if packed else "a.json")).read_bytes()
        for size in (len(content) - 3, len(content) // 2, 5):
            path.write_bytes(content[:size])
            with pytest.raises(
                BadInputError, match=r"a\.json: (is not JSON, or was cut|was cut or is damaged) \(.*again"
            ):
                read_surfaces(path)
    for content in (b"", b"ply\n\xff", b"[1]", b'{"format": 1}'):
        path.write_bytes(content)
        with pytest.raises(BadInputError, match=r"is not JSON|is JSON, but not surfaces of bsmap"):
            read_surfaces(path)
