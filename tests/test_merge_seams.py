"""Both faces' meshes have the same vertices along the crease that they share, and the measure of that."""

from functools import cache

import numpy as np
import pytest
from face_scenes import simulated_place
from shared_creases import seams

from bsmap_cli.export.tessellation import Mesh, tessellate_map
from bsmap_cli.fit import fit_surfaces
from bsmap_cli.merge import merge_surfaces
from bsmap_cli.model import Crease
from bsmap_cli.params import FitParams, MergeParams


@cache
def merged_place(scene):
    return merge_surfaces([fit_surfaces(simulated_place(scene).cloud, FitParams(method="faces"))], MergeParams())


def seams_of(surface_map, tolerance):
    meshes = tessellate_map(surface_map, tolerance)
    return seams(surface_map.creases, dict(zip([s.name for s in surface_map.surfaces], meshes, strict=True)))


@pytest.mark.parametrize("scene", ["room", "steps", "walls"])
@pytest.mark.parametrize("tolerance", [0.0005, 0.05])
def test_both_faces_of_a_crease_have_the_same_border_there_to_the_last_bit(scene, tolerance):
    result = merged_place(scene)
    found = seams_of(result, tolerance)
    assert found.sides == sum(len(crease.points) - 1 for crease in result.creases) > 30
    assert (found.open, found.gap) == (0, 0.0)


def square(low, high, middle=()):
    """Mesh of a square from `low` to `high` in the plane z = 0, with more vertices on its right side."""
    corners = [[low, 0.0, 0.0], [high, 0.0, 0.0], *middle, [high, 1.0, 0.0], [low, 1.0, 0.0]]
    fan = [[0, k, k + 1] for k in range(1, len(corners) - 1)]
    return Mesh(np.array(corners), np.array(fan))


@pytest.mark.parametrize(
    ("middle", "high", "is_open", "gap"),
    [
        ((), 1.0, 0, 0.0),
        ([[1.0, 0.5, 0.0]], 1.0, 1, 0.0),  # a vertex that the other face has not, though nothing gapes
        ([[1.003, 0.5, 0.0]], 1.0, 1, 0.003),
        ((), 0.8, 1, 0.2),  # the border of one face ends before the crease
    ],
)
def test_seams_tell_vertices_that_one_face_alone_has_and_what_gapes(middle, high, is_open, gap):
    crease = Crease(("a", "b"), np.array([[1.0, 0.0, 0.0], [1.0, 1.0, 0.0]]))
    found = seams([crease], {"a": square(0.0, high, middle), "b": square(2.0, 1.0)})
    assert (found.sides, found.open) == (1, is_open)
    assert found.gap == pytest.approx(gap, abs=1e-12)
