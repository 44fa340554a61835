"""The option --plot, which commands share: pictures of a stage's result."""

from collections.abc import Callable, Sequence
from pathlib import Path

import click

from bsmap_cli.cli.options import say
from bsmap_cli.cli.stage import check_outputs
from bsmap_cli.errors import ParameterError

plot_option = click.option(
    "--plot", "plots", type=click.Path(path_type=Path), multiple=True, metavar="FILE",
    help="Picture of the result: PNG, SVG or PDF by its ending. May be given several times.",
)  # fmt: skip


def check_plots(plots: tuple[Path, ...], taken: Sequence[Path]) -> None:
    """Before any work: each is of a format known, and takes no other file's place."""
    for path in plots:
        if path.suffix.lower() not in (".png", ".svg", ".pdf"):
            raise ParameterError(f"{path}: pictures are made as .png, .svg and .pdf")
    check_outputs(taken, plots)


def draw_plots(plots: tuple[Path, ...], draw: Callable[[Path, str], None]) -> None:
    """Draw each, whole or not at all; `draw` gets the path to write to and the ending."""
    from bsmap_cli.io.artifact import atomic_output

    for plot in plots:
        with atomic_output(plot) as path:
            draw(path, plot.suffix.lower())
        say(f"{plot}: picture")
