"""Beams against surfaces: crossings of known places, and the faces that beams are found on."""

import numpy as np
import pytest

from bsmap_cli.core.beams import cross
from bsmap_cli.core.bspline import TensorSpline, clamped_knots, evaluate_surface
from bsmap_cli.fit import fit_surfaces
from bsmap_cli.io.cloud_ply import read_cloud
from bsmap_cli.params import FitParams
from bsmap_cli.picture.fit import beams_on_faces


@pytest.fixture
def hill() -> TensorSpline:
    x, y = np.meshgrid(np.linspace(0, 2, 5), np.linspace(0, 3, 6), indexing="ij")
    points = np.stack([x, y, 0.2 * np.sin(2 * x) * np.cos(y)], axis=-1)
    return TensorSpline(3, 3, clamped_knots(3, [0.5]), clamped_knots(3, [0.3, 0.6]), points)


def test_beam_meets_the_surface_where_it_was_aimed(hill):
    rng = np.random.default_rng(0)
    u, v = rng.uniform(0.05, 0.95, (2, 200))
    origin = np.array([1.0, 1.5, 2.0])
    along = evaluate_surface(hill, u, v) - origin
    length = np.linalg.norm(along, axis=1)
    start_u, start_v = (np.clip(k + rng.normal(0, 0.02, 200), 0, 1) for k in (u, v))
    found = cross(hill, np.tile(origin, (200, 1)), along / length[:, None], start_u, start_v)
    np.testing.assert_allclose(found.length, length, atol=1e-6)
    np.testing.assert_allclose([found.u, found.v], [u, v], atol=1e-5)


def test_beam_beside_or_along_the_surface_meets_it_nowhere(hill):
    found = cross(
        hill, np.array([[9.0, 9.0, 2.0], [1.0, 1.5, 2.0]]), np.array([[0.0, 0, -1], [1, 0, 0]]), *np.full((2, 2), 0.5)
    )
    assert np.isnan(found.length).all()


def test_as_many_beams_are_found_on_faces_as_the_fit_put_there(made):
    cloud = read_cloud(made / "log.cloud.ply")
    surfaces = fit_surfaces(cloud, FitParams())
    beams = beams_on_faces(cloud, surfaces)
    kept = {number for s in surfaces.data_sets for number in range(s.first_scan, s.last_scan + 1)}
    inside = np.isin(beams.scan, sorted(kept))
    notes = surfaces.notes["fit"].values()
    wanted = sum(n["in_faces"] for n in notes) / sum(n["beams"] for n in notes)
    assert np.mean(beams.face[inside] >= 0) == pytest.approx(wanted, abs=0.02)
    assert np.nanstd(beams.residual) == pytest.approx(cloud.range_sigma, rel=0.1)
