"""bsmap fit: point cloud -> B-spline surfaces."""

import logging
from pathlib import Path
from typing import Any

import click

from bsmap_cli.cli.options import force_option, input_argument, output_option, parameters
from bsmap_cli.cli.plots import check_plots, draw_plots, plot_option
from bsmap_cli.cli.stage import Result, beside, run_stage
from bsmap_cli.errors import ParameterError
from bsmap_cli.params import FitParams
from bsmap_cli.track import Track

logger = logging.getLogger(__name__)


@click.command()
@input_argument("CLOUD_PLY")
@output_option
@parameters(FitParams)
@plot_option
@force_option
def fit(cloud_ply: Path, output: Path | None, fit_params: FitParams, plots: tuple[Path, ...], force: bool) -> None:
    """B-spline surfaces with covariance, one for each smooth face of each movement of the robot: X.surfaces.json.

    Any other PLY file of points is read, too; without the order of its scans the fit is less exact, and --plot, which
    shows scans and beams, is refused.
    """
    output = output or beside(cloud_ply, ".surfaces.json", [".cloud.ply"])
    check_plots(plots, [cloud_ply, output])
    if plots:
        _check_scan_order(cloud_ply)
    make_surfaces_file(cloud_ply, output, fit_params, force)
    if plots:
        _draw(cloud_ply, output, plots)


def make_surfaces_file(cloud_ply: Path, output: Path, fit_params: FitParams, force: bool) -> None:
    """The stage's work."""

    def compute(track: Track) -> Result:
        from bsmap_cli.cli.stage import map_figures
        from bsmap_cli.fit import fit_surfaces
        from bsmap_cli.io.cloud_ply import read_cloud
        from bsmap_cli.io.points_ply import is_organised
        from bsmap_cli.io.surfaces_json import write_surfaces

        if is_organised(cloud_ply):
            surfaces = fit_surfaces(read_cloud(cloud_ply), fit_params, track=track)
            figures = map_figures(surfaces)
        else:
            surfaces = fit_points(cloud_ply, fit_params, track)
            figures = map_figures(surfaces) | unorganised_figures(surfaces)
        return Result([lambda path, provenance: write_surfaces(path, surfaces, provenance)], figures)

    run_stage("fit", [cloud_ply], [output], [fit_params], compute, force)


def fit_points(path: Path, fit_params: FitParams, track: Track) -> Any:
    """model.SurfaceMap of a cloud of another program, with a warning of what it lacks."""
    from bsmap_cli.fit import fit_unorganised
    from bsmap_cli.io.points_ply import read_points

    surfaces = fit_unorganised(read_points(path), fit_params, track=track)
    logger.warning("%s has no scan order: its faces are less exact and the covariance has no pose part", path)
    return surfaces


def unorganised_figures(surfaces: Any) -> dict[str, Any]:
    """Figures of a model.SurfaceMap that only points without scan order have."""
    notes = next(iter(surfaces.notes["fit"].values()))
    return {"rest": notes["rest"], "sigma": notes["sigma"], "scan_order": "none"}


def _check_scan_order(cloud_ply: Path) -> None:
    """Before any work: a picture of scans and beams needs them."""
    from bsmap_cli.io.points_ply import is_organised

    if not is_organised(cloud_ply):
        raise ParameterError(f"{cloud_ply}: has no scan order, and --plot shows scans and beams; leave --plot out")


def _draw(cloud_ply: Path, output: Path, plots: tuple[Path, ...]) -> None:
    from bsmap_cli.io.cloud_ply import read_cloud
    from bsmap_cli.io.surfaces_json import read_surfaces
    from bsmap_cli.picture import draw_fit

    cloud, surfaces, title = read_cloud(cloud_ply), read_surfaces(output), output.name.removesuffix(".surfaces.json")
    draw_plots(plots, lambda path, ending: draw_fit(path, ending, cloud, surfaces, title))
