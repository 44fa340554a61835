"""The part of surfaces' JSON that faces need: trims, creases, covariance of heights; every refusal by its message."""

import json
from dataclasses import replace

import numpy as np
import pytest

from bsmap_cli.errors import BadInputError
from bsmap_cli.io.surfaces_json import read_surfaces, write_surfaces
from bsmap_cli.model import (
    BSplineSurface,
    Crease,
    HeightCovariance,
    Placement,
    PosePart,
    Residuals,
    SurfaceMap,
    TrimLoop,
)

CORNERS = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])


def face(name, crease):
    net = np.zeros((2, 2, 3))
    net[1, :, 0] = net[:, 1, 1] = 2.0
    root = np.random.default_rng(0).normal(size=(4, 4)) * 1e-3
    covariance = HeightCovariance(
        np.array([[[0.0, 0.0, 1.0]]]), root @ root.T, (PosePart("d", np.zeros(2), np.eye(3) * 1e-6),)
    )
    knots = np.array([0.0, 0.0, 1.0, 1.0])
    loop = TrimLoop(CORNERS, np.array([crease, -1, -1, -1]), np.array([0.0, 0.04, 0.04, 0.0123]))
    return BSplineSurface(name, ("d",), 1, 1, knots, knots, net, covariance, Residuals(9, 0.0, 0.0, 0.0, 0.0), (loop,))


@pytest.fixture
def path(tmp_path):
    corners = np.array([[0.0, 0.0, 0.0]])
    crease = Crease(("a", "b"), np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]]), (0, -1))
    faces = face("a", 0), face("b", 0)
    write_surfaces(tmp_path / "a.json", SurfaceMap(faces, (), creases=(crease,), corners=corners))
    return tmp_path / "a.json"


def test_faces_come_back(path):
    read, made = read_surfaces(path), face("a", 0)
    (first, _), (crease,) = read.surfaces, read.creases
    np.testing.assert_array_equal(first.trims[0].parameters, CORNERS)
    np.testing.assert_array_equal(first.trims[0].creases, [0, -1, -1, -1])
    np.testing.assert_array_equal(first.trims[0].rims, [0.0, 0.04, 0.04, 0.012])
    deviations = np.sqrt(np.diag(made.covariance.matrix))
    off = np.abs(first.covariance.matrix - made.covariance.matrix)
    assert np.all(off < 0.01 * np.outer(deviations, deviations))
    assert crease.surfaces == ("a", "b")
    assert crease.corners == (0, -1)
    np.testing.assert_array_equal(crease.points, [[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
    np.testing.assert_array_equal(read.corners, [[0.0, 0.0, 0.0]])


@pytest.mark.parametrize("side", [-1, 0, 1])
def test_side_comes_back(tmp_path, side):
    write_surfaces(tmp_path / "s.json", SurfaceMap((replace(face("a", -1), side=side),), ()))
    assert read_surfaces(tmp_path / "s.json").surfaces[0].side == side


def test_side_that_is_none_is_refused(path):
    plain = json.loads(path.read_text())
    plain["surfaces"][0]["side"] = 2
    path.write_text(json.dumps(plain))
    with pytest.raises(BadInputError, match=r"surfaces\[0\] \(a\): side is 2, wanted 1, -1 or 0"):
        read_surfaces(path)


def test_corners_are_stored_once(path):
    plain = json.loads(path.read_text())
    assert plain["corners"] == [[0, 0, 0]]
    assert plain["creases"][0]["points"] == [[20_000, 0, 0]]


def test_placements_come_back(path):
    rng = np.random.default_rng(0)
    C = rng.normal(size=(3, 3))
    alone = Placement(2, rng.normal(size=3), 0.125, C @ C.T, 80.5, 0.25, 0.0, None, "unique")
    made = SurfaceMap((), (), placements=(alone, replace(alone, survey=1, rival=0.5, rival_pose=rng.normal(size=3))))
    write_surfaces(path, made)
    read = read_surfaces(path).placements
    assert [p.survey for p in read] == [2, 1]
    assert (read[0].rival_pose, read[1].rival) == (None, 0.5)
    np.testing.assert_array_equal(read[0].pose, alone.pose)
    np.testing.assert_array_equal(read[1].rival_pose, made.placements[1].rival_pose)
    np.testing.assert_allclose(read[0].covariance, alone.covariance, rtol=1e-3)
    first = path.read_bytes()
    write_surfaces(path, read_surfaces(path))
    assert path.read_bytes() == first


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("verdict", "likely", r"placements\[0\]: verdict is 'likely', wanted unique"),
        ("pose", [0.0, 0.0], r"placements\[0\]: pose is 2, wanted 3"),
        ("survey", -1, r"placements\[0\]: survey is -1, wanted 0 or more"),
        ("rival_pose", "here", r"placements\[0\]: rival_pose is 'here', wanted numbers"),
        ("covariance", [-1.0, 0.0, 0.0, 1.0, 0.0, 1.0], r"placements\[0\]: covariance is not positive semidefinite"),
    ],
)
def test_wrong_placement_is_named(path, name, value, message):
    write_surfaces(
        path, SurfaceMap((), (), placements=(Placement(0, np.zeros(3), 0, np.eye(3), 1, 0, 0, None, "unique"),))
    )
    plain = json.loads(path.read_text())
    plain["placements"][0][name] = value
    path.write_text(json.dumps(plain))
    with pytest.raises(BadInputError, match=message):
        read_surfaces(path)


def change(plain, value, *way):
    for key in way[:-1]:
        plain = plain[key]
    plain[way[-1]] = value


FIRST = ("surfaces", 0)
UPWARDS = {"directions": [[[0, 0, 100_000]]], "weights": []}


@pytest.mark.parametrize(
    ("value", "way", "message"),
    [
        ([0], ("creases", 0, "surfaces"), r"creases\[0\]: surfaces is 1, wanted 2"),
        ([0, 2], ("creases", 0, "surfaces"), r"creases\[0\]: surfaces\[1\] is 2, wanted -1 or a number of a surface"),
        ([0, -1], ("creases", 0, "surfaces"), r"creases\[0\]: surfaces holds -1, wanted two numbers of surfaces"),
        ([[0, 0]], ("creases", 0, "points"), r"points is 1 x 2, wanted any x 3"),
        ([], ("creases", 0, "points"), r"creases\[0\]: has 1 points with its corners, wanted 2 or more"),
        ([0, 1], ("creases", 0, "corners"), r"corners\[1\] is 1, wanted -1 or a number of a corner"),
        ([[0, 0]], ("corners",), r"corners is 1 x 2, wanted any x 3"),
        ([[0, 0], [1, 0]], (*FIRST, "trims", 0, "parameters"), "has 2 vertices, wanted 3 or more"),
        ([[0, 0], [4000, 0], [0, 4000], [-4000, 1]], (*FIRST, "trims", 0, "parameters"), r"lie outside \[0, 1\]"),
        ([0, 0, 2, 0], (*FIRST, "trims", 0, "creases"), r"creases\[2\] is 2, wanted 0 or a number of a crease"),
        ([0, 0, 0], (*FIRST, "trims", 0, "creases"), "creases is 3, wanted 4"),
        ([[0, 1, 40]], (*FIRST, "trims", 0, "rims"), r"rims\[0\] is 0, 1, 40, wanted sides without crease and a width"),
        ([[3, 2, 40]], (*FIRST, "trims", 0, "rims"), r"rims\[0\] is 3, 2, 40, wanted sides without"),
        ([[3, 0, 40]], (*FIRST, "trims", 0, "rims"), r"rims\[0\] is 3, 0, 40, wanted sides without"),
        ([[3, 1, 0]], (*FIRST, "trims", 0, "rims"), r"rims\[0\] is 3, 1, 0, wanted sides without"),
        ([[3, 1]], (*FIRST, "trims", 0, "rims"), "rims is 1 x 2, wanted any x 3"),
        ([[[0, 0, 200_000]]], (*FIRST, "covariance", "directions"), "directions are not of length 1"),
        (
            [[[0, 0, 100_000]]] * 3,
            (*FIRST, "covariance", "directions"),
            "directions is 3 x 1 x 3, wanted 2 or 1 x 2 or 1 x 3",
        ),
        ([1.0] * 9, (*FIRST, "covariance", "root"), "root is 9, wanted 10"),
        (UPWARDS | {"matrix": [-1.0] + [0.0] * 9}, (*FIRST, "covariance"), "matrix is not positive semidefinite"),
        (UPWARDS | {"matrix": [1.0] * 9}, (*FIRST, "covariance"), "matrix is 9, wanted 10"),
    ],
)
def test_what_is_wrong_is_named(path, value, way, message):
    plain = json.loads(path.read_text())
    change(plain, value, *way)
    path.write_text(json.dumps(plain))
    with pytest.raises(BadInputError, match=message):
        read_surfaces(path)


def test_covariance_of_the_wrong_size_is_refused():
    good = face("a", -1)
    with pytest.raises(ValueError, match=r"covariance of shape \(3, 3\) for 2 x 2 control points"):
        BSplineSurface(**{**vars(good), "covariance": HeightCovariance(good.covariance.directions, np.eye(3), ())})
