"""bsmap import: logs of other formats -> MCAP."""

from pathlib import Path

import click

from bsmap_cli.cli.options import force_option, input_argument, output_option
from bsmap_cli.cli.stage import Result, beside, run_stage
from bsmap_cli.track import Track


@click.command("import")
@input_argument("FILE")
@output_option
@force_option
def import_log(file: Path, output: Path | None, force: bool) -> None:
    """CARMEN log (.log, .clf, plain or .gz) to MCAP with ROS 2 messages: FILE.mcap."""

    def compute(track: Track) -> Result:
        from bsmap_cli.io.carmen import import_carmen
        from bsmap_cli.io.log import write_log

        log = import_carmen(file)
        return Result(
            [lambda path, provenance: write_log(path, log.rows, log.mounts, provenance)], {"messages": len(log.rows)}
        )

    output = output or beside(file, ".mcap", [".log.gz", ".clf.gz", ".gz"])
    run_stage("import", [file], [output], [], compute, force)
