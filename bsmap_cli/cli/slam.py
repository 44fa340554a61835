"""bsmap slam: a robot's log -> trajectory and line map."""

from pathlib import Path

import click

from bsmap_cli.cli.options import force_option, input_argument, output_option, parameters
from bsmap_cli.cli.stage import Result, beside, run_stage
from bsmap_cli.params import LogParams, SlamParams
from bsmap_cli.track import Track


@click.command()
@input_argument("LOG")
@output_option
@parameters(LogParams, SlamParams)
@force_option
def slam(log: Path, output: Path | None, log_params: LogParams, slam_params: SlamParams, force: bool) -> None:
    """Trajectory and line map from the horizontal laser: LOG.slam.mcap and LOG.tum."""
    make_slam_file(log, output or beside(log, ".slam.mcap", [".mcap"]), log_params, slam_params, force)


def make_slam_file(log: Path, output: Path, log_params: LogParams, slam_params: SlamParams, force: bool) -> None:
    """The stage's work: `output`, and beside it the trajectory as TUM."""

    def compute(track: Track) -> Result:
        from bsmap_cli.io.log import read_log
        from bsmap_cli.io.slam_mcap import write_slam
        from bsmap_cli.io.tum import write_tum
        from bsmap_cli.slam import run_slam

        result = run_slam(read_log(log, log_params), slam_params, track=track)
        statistics, trajectory = result.statistics, result.trajectory
        figures = {
            "scans": len(trajectory.time_ns),
            "lines": len(result.lines.hits),
            "matched_per_scan": float(statistics.matched.mean()),
            "innovation_consistency": float(statistics.nis.sum() / max(int(statistics.dof.sum()), 1)),
        }
        return Result(
            [
                lambda path, provenance: write_slam(path, result, provenance),
                lambda path, provenance: write_tum(path, trajectory, provenance),
            ],
            figures,
        )

    tum = beside(output, ".tum", [".slam.mcap", ".mcap"])
    run_stage("slam", [log], [output, tum], [log_params, slam_params], compute, force)
