"""bsmap fit: point cloud -> B-spline surfaces."""

from pathlib import Path

import click

from bsmap_cli.cli.options import force_option, input_argument, output_option, parameters
from bsmap_cli.cli.stage import Result, beside, run_stage
from bsmap_cli.params import FitParams
from bsmap_cli.track import Track


@click.command()
@input_argument("CLOUD_PLY")
@output_option
@parameters(FitParams)
@force_option
def fit(cloud_ply: Path, output: Path | None, fit_params: FitParams, force: bool) -> None:
    """B-spline surfaces with covariance, one for each smooth face of each movement of the robot: X.surfaces.json."""
    make_surfaces_file(cloud_ply, output or beside(cloud_ply, ".surfaces.json", [".cloud.ply"]), fit_params, force)


def make_surfaces_file(cloud_ply: Path, output: Path, fit_params: FitParams, force: bool) -> None:
    """The stage's work."""

    def compute(track: Track) -> Result:
        from bsmap_cli.cli.stage import map_figures
        from bsmap_cli.fit import fit_surfaces
        from bsmap_cli.io.cloud_ply import read_cloud
        from bsmap_cli.io.surfaces_json import write_surfaces

        surfaces = fit_surfaces(read_cloud(cloud_ply), fit_params, track=track)
        return Result([lambda path, provenance: write_surfaces(path, surfaces, provenance)], map_figures(surfaces))

    run_stage("fit", [cloud_ply], [output], [fit_params], compute, force)
