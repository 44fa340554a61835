"""bsmap cloud: trajectory and vertical scans -> organised point cloud."""

from pathlib import Path

import click

from bsmap_cli.cli.options import force_option, input_argument, output_option, parameters
from bsmap_cli.cli.stage import Result, beside, run_stage
from bsmap_cli.params import CloudParams
from bsmap_cli.track import Track


@click.command()
@input_argument("SLAM_MCAP")
@output_option
@parameters(CloudParams)
@force_option
def cloud(slam_mcap: Path, output: Path | None, cloud_params: CloudParams, force: bool) -> None:
    """Organised 3D point cloud with covariance from the vertical laser: X.cloud.ply."""
    make_cloud_file(slam_mcap, output or beside(slam_mcap, ".cloud.ply", [".slam.mcap", ".mcap"]), cloud_params, force)


def make_cloud_file(slam_mcap: Path, output: Path, cloud_params: CloudParams, force: bool) -> None:
    """The stage's work."""

    def compute(track: Track) -> Result:
        from bsmap_cli.cloud import make_cloud
        from bsmap_cli.io.cloud_ply import write_cloud
        from bsmap_cli.io.slam_mcap import read_slam

        points = make_cloud(read_slam(slam_mcap), cloud_params, track=track)
        figures = {
            "points": len(points.points),
            "scans": len(points.scan_time_ns),
            "range_sigma": points.range_sigma,
        }
        return Result([lambda path, provenance: write_cloud(path, points, provenance)], figures)

    run_stage("cloud", [slam_mcap], [output], [cloud_params], compute, force)
