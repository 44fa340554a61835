"""The paper's method: one B-spline surface with covariance for each data set, method.md sections 6-8."""

import logging
from typing import Any

from bsmap_cli.errors import BsmapError
from bsmap_cli.fit.lines import ScanLines, gather_lines, pose_part
from bsmap_cli.fit.movement import Movement, divide
from bsmap_cli.fit.surface import SurfaceFit, fit_scan_lines
from bsmap_cli.model import BSplineSurface, DataSet, Decision, PointCloud, SurfaceCovariance, SurfaceMap
from bsmap_cli.params import FitParams
from bsmap_cli.track import Track, silent

logger = logging.getLogger(__name__)


def fit_paper(cloud: PointCloud, params: FitParams, *, track: Track = silent) -> SurfaceMap:
    """Divide the cloud into data sets by movement and fit a surface to each.

    A set with too few scans or points is left out; a Decision says so. The notes hold, for each surface, its
    largest errors along u and v and whether the bounds are met.

    Raises
    ------
    BsmapError
        Where no data set gives a surface.
    """
    surfaces, data_sets, refused, notes = [], [], [], {}
    movements = divide(cloud.scan_poses, params.set_length)
    for number, movement in enumerate(movements):
        track("data sets", number, len(movements))
        name = f"set-{number + 1:02d}"
        lines = gather_lines(cloud, movement, params.degree_u + 1)
        first, last = int(movement.scans[0]), int(movement.scans[-1])
        data_sets.append(DataSet(name, movement.kind, first, last, len(lines.points)))
        try:
            fit = fit_scan_lines(lines, params)
        except BsmapError as error:
            refused.append(Decision(name, "", "refused", str(error), {"scans": lines.n_lines}))
            logger.warning("%s left out: %s", name, error)
            continue
        surfaces.append(_as_surface(cloud, movement, name, fit))
        notes[name] = _note(name, lines, fit, params)
    track("data sets", len(movements), len(movements))
    if not surfaces:
        raise BsmapError(_nothing_to_fit(cloud, movements))
    return SurfaceMap(tuple(surfaces), tuple(data_sets), tuple(refused), {"fit": notes})


def _as_surface(cloud: PointCloud, movement: Movement, name: str, fit: SurfaceFit) -> BSplineSurface:
    pose = (pose_part(cloud, movement, name),)
    covariance = SurfaceCovariance(fit.blocks, fit.correlation_u, fit.correlation_v, pose)
    return BSplineSurface(name, (name,), *fit.spline, covariance, fit.residuals)


def _note(name: str, lines: ScanLines, fit: SurfaceFit, params: FitParams) -> dict[str, Any]:
    """Figures of a surface; warns where a bound is not met, for then the surface has all the knots the data bear."""
    met_u, met_v = fit.error_u <= params.bound_u, fit.error_v <= params.bound_v
    for direction, met, error, bound in (
        ("along", met_u, fit.error_u, params.bound_u),
        ("across", met_v, fit.error_v, params.bound_v),
    ):
        if not met:
            message = "%s: largest error %s the scan lines is %.3f m, over the bound of %.3f m: no room for more knots"
            logger.warning(message, name, direction, error, bound)
    return {
        "scans": lines.n_lines,
        "error_u": fit.error_u,
        "error_v": fit.error_v,
        "bound_u_met": met_u,
        "bound_v_met": met_v,
    }


def _nothing_to_fit(cloud: PointCloud, movements: list[Movement]) -> str:
    if not movements:
        return f"no surface can be fitted: the robot stands still in all of the cloud's {len(cloud.scan_poses)} scans"
    return f"no surface can be fitted: {len(cloud.points)} points in {len(movements)} data sets are too few"
