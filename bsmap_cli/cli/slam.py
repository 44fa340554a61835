"""bsmap slam: a robot's log -> trajectory and line map."""

from pathlib import Path
from typing import Any

import click

from bsmap_cli.cli.options import force_option, input_argument, output_option, parameters
from bsmap_cli.cli.plots import check_plots, draw_plots, plot_option
from bsmap_cli.cli.stage import Result, beside, run_stage
from bsmap_cli.params import LogParams, SlamParams
from bsmap_cli.track import Track


@click.command()
@input_argument("LOG")
@output_option
@parameters(LogParams, SlamParams)
@plot_option
@force_option
def slam(
    log: Path,
    output: Path | None,
    log_params: LogParams,
    slam_params: SlamParams,
    plots: tuple[Path, ...],
    force: bool,
) -> None:
    """Trajectory and line map from the horizontal laser: LOG.slam.mcap and LOG.tum."""
    output = output or beside(log, ".slam.mcap", [".mcap"])
    check_plots(plots, [log, output, _tum_of(output)])
    make_slam_file(log, output, log_params, slam_params, force)
    if plots:
        _draw(output, plots)


def make_slam_file(log: Path, output: Path, log_params: LogParams, slam_params: SlamParams, force: bool) -> None:
    """The stage's work: `output`, and beside it the trajectory as TUM."""

    def compute(track: Track) -> Result:
        from bsmap_cli.io.log import read_log
        from bsmap_cli.io.slam_mcap import write_slam
        from bsmap_cli.io.tum import write_tum
        from bsmap_cli.slam import run_slam

        result = run_slam(read_log(log, log_params), slam_params, track=track)
        return Result(
            [
                lambda path, provenance: write_slam(path, result, provenance),
                lambda path, provenance: write_tum(path, result.trajectory, provenance),
            ],
            _figures(result),
        )

    run_stage("slam", [log], [output, _tum_of(output)], [log_params, slam_params], compute, force)


def _tum_of(output: Path) -> Path:
    return beside(output, ".tum", [".slam.mcap", ".mcap"])


def _figures(result: Any) -> dict[str, Any]:
    """Figures of a model.SlamMap for the report."""
    statistics, held = result.statistics, result.closures.held
    return {
        "scans": len(result.trajectory.time_ns),
        "lines": len(result.lines.hits),
        "matched_per_scan": float(statistics.matched.sum() / max(int((statistics.new > 0).sum()), 1)),
        "innovation_consistency": float(statistics.nis.sum() / max(int(statistics.dof.sum()), 1)),
        "loops_closed": int(held.sum()),
        "loops_refused": int((~held).sum()),
    }


def _draw(output: Path, plots: tuple[Path, ...]) -> None:
    from bsmap_cli.io.slam_mcap import read_slam
    from bsmap_cli.picture import draw_slam

    result, title = read_slam(output), output.name.removesuffix(".slam.mcap")
    draw_plots(plots, lambda path, ending: draw_slam(path, ending, result, title))
