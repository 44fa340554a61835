"""The command line: the group, the commands and the one boundary at which errors become exit codes."""

import logging
import os
import signal
import sys
from typing import Any

import click

from bsmap_cli import __version__
from bsmap_cli.cli.cloud import cloud
from bsmap_cli.cli.evaluate import evaluate
from bsmap_cli.cli.export import export
from bsmap_cli.cli.fit import fit
from bsmap_cli.cli.import_log import import_log
from bsmap_cli.cli.info import info
from bsmap_cli.cli.merge import merge
from bsmap_cli.cli.run import run
from bsmap_cli.cli.simulate import simulate
from bsmap_cli.cli.slam import slam
from bsmap_cli.errors import BsmapError

INTERRUPTED = 130


class InOrder(click.Group):
    """Group that lists its commands in the order of the pipeline."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(self.commands)

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command; click itself would make a failure of a reader that has gone."""
        try:
            return super().invoke(ctx)
        except BrokenPipeError:
            return _reader_gone()


AGAIN = 5.0
"""Seconds after which a run that was asked to stop is asked again; by then it has removed its unfinished files."""


@click.group(cls=InOrder, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.version_option(__version__, prog_name="bsmap")
@click.option("-q", "--quiet", is_flag=True, help="Show errors only.")
def cli(quiet: bool) -> None:
    """From the log of two perpendicular 2D laser range finders to a 3D map of B-spline surfaces.

    Every stage reads and writes a file beside its input and does nothing when that file is up to date. Exit codes:
    0 done, 1 failed, 2 usage, 3 maps that cannot be brought together, 65 bad input, 66 missing input, 69 missing
    library, 73 cannot write, 130 interrupted.
    """
    logging.basicConfig(format="bsmap: %(levelname)s: %(message)s", level=logging.ERROR if quiet else logging.WARNING)
    logging.addLevelName(logging.WARNING, "warning")
    logging.addLevelName(logging.ERROR, "error")
    click.get_current_context().obj = {"quiet": quiet}


for _command in (run, slam, cloud, fit, merge, export, info, import_log, simulate, evaluate):
    cli.add_command(_command)


def entry_point() -> None:
    """Run the command line; every error ends in one line on stderr and its exit code."""
    # A terminated run cleans up like an interrupted one: unfinished files are removed.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _stop)
    sys.exit(_guarded())


def _stop(number: int, _: object) -> None:
    """End the run. Python drops an exception that arises in some callbacks, as while it loads modules: ask again."""
    sys.unraisablehook = lambda _: None  # nor does it print one that was dropped
    if hasattr(signal, "setitimer"):
        signal.signal(signal.SIGALRM, lambda *_: _stop(number, None))
        signal.setitimer(signal.ITIMER_REAL, AGAIN)
    if number == signal.SIGINT:
        raise KeyboardInterrupt
    sys.exit(128 + number)


def _guarded() -> int:
    try:
        result = cli.main(standalone_mode=False)
        sys.stdout.flush()
        return result if isinstance(result, int) else 0
    except click.exceptions.Exit as stop:
        return stop.exit_code
    except (click.Abort, KeyboardInterrupt):
        return _fail("interrupted", INTERRUPTED)
    except click.ClickException as error:
        error.show()
        return error.exit_code
    except BsmapError as error:
        return _fail(str(error), error.exit_code)
    except BrokenPipeError:
        return _reader_gone()
    except MemoryError:
        return _fail("out of memory: use a machine with more, or a shorter log", 1)
    except Exception as error:
        if os.environ.get("BSMAP_DEBUG"):
            raise
        return _fail(f"internal error, please report it: {type(error).__name__}: {error} (BSMAP_DEBUG=1 shows more)", 1)


def _reader_gone() -> int:
    """Nothing is wrong when the reader of our output has gone (bsmap info | head)."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 0


def _fail(message: str, code: int) -> int:
    click.echo("bsmap: error: " + " ".join(message.split()), err=True)
    return code
