"""Options that commands share: parameter classes as options, output, force; progress on stderr."""

import dataclasses
import math
import operator
import stat
import sys
import time
import types
import typing
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any

import click

from bsmap_cli.errors import MissingInputError
from bsmap_cli.track import Track, silent

Command = Callable[..., Any]

output_option = click.option(
    "-o", "--output", type=click.Path(path_type=Path), metavar="FILE", help="Output (default: beside the input)."
)
force_option = click.option("--force", is_flag=True, help="Compute even when the output is up to date.")


def input_argument(name: str, many: bool = False) -> Callable[[Command], Command]:
    """Argument for one input file, or for one and more."""
    kind = click.Path(path_type=Path)
    metavar = name + ("..." if many else "")
    return click.argument(name.lower(), type=kind, metavar=metavar, nargs=-1 if many else 1, required=True)


def parameters(*classes: type) -> Callable[[Command], Command]:
    """Give a command an option for each field; it gets one instance a class, named like it: slam_params."""

    def decorate(command: Command) -> Command:
        @wraps(command)
        def with_instances(**kwargs: Any) -> Any:
            for owner in classes:
                values = {f.name: kwargs.pop(_key(owner, f)) for f in dataclasses.fields(owner)}
                kwargs[_snake(owner.__name__)] = owner(**values)
            return command(**kwargs)

        wrapper: Command = with_instances
        for owner in reversed(classes):
            hints = typing.get_type_hints(owner)
            for f in reversed(dataclasses.fields(owner)):
                wrapper = _option(owner, f, hints[f.name])(wrapper)
        return wrapper

    return decorate


def _snake(name: str) -> str:
    return "".join("_" + c.lower() if c.isupper() else c for c in name).lstrip("_")


def _key(owner: type, f: "dataclasses.Field[Any]") -> str:
    return f"{_snake(owner.__name__)}_{f.name}"


def _option(owner: type, f: "dataclasses.Field[Any]", hint: Any) -> Callable[[Command], Command]:
    meta = f.metadata
    default: Any = f.default
    flag = "--" + (meta["name"] or f.name).replace("_", "-")
    if hint is bool:
        return click.option(f"{flag}/--no-{flag[2:]}", _key(owner, f), default=default, help=meta["help"])
    kinds = [t for t in typing.get_args(hint) if t is not types.NoneType] if typing.get_args(hint) else [hint]
    kind: Any = click.Choice(meta["choices"]) if meta["choices"] else kinds[0]
    in_degrees = meta["unit"] == "rad"
    shown = math.degrees(default) if in_degrees and default is not None else default
    unit = "deg" if in_degrees else meta["unit"]
    help = meta["help"] + (f" [{unit}]" if unit else "")

    def convert(ctx: click.Context, option: click.Parameter, value: Any) -> Any:
        if not in_degrees or value is None:
            return value
        # The default is handed on untouched: degrees and back would change its last bit.
        radians = default if value == shown else math.radians(value)
        for limit, beyond in ((meta["min"], operator.lt), (meta["max"], operator.gt)):
            if limit is not None and beyond(radians, limit):
                raise click.BadParameter(
                    f"{value:g} is beyond the limit of {math.degrees(limit):g} degrees", ctx, option
                )
        return radians

    key, has_default = _key(owner, f), default is not None
    return click.option(flag, key, type=kind, default=shown, show_default=has_default, help=help, callback=convert)


def existing(path: Path) -> Path:
    """The path, if a file is there; MissingInputError names it otherwise."""
    try:
        is_folder = stat.S_ISDIR(path.stat().st_mode)
    except (FileNotFoundError, NotADirectoryError) as error:
        raise MissingInputError(f"{path}: no such file") from error
    except OSError as error:  # no permission, name too long, broken medium
        raise MissingInputError(f"{path}: {error.strerror or error}") from error
    if is_folder:
        raise MissingInputError(f"{path}: is a folder, a file is wanted")
    return path


def is_quiet() -> bool:
    """Whether -q was given to the group."""
    context = click.get_current_context(silent=True)
    return bool(context and (context.find_root().obj or {}).get("quiet"))


def say(message: str) -> None:
    """One line for the person at the terminal, on stderr; nothing with -q."""
    if not is_quiet():
        click.echo(message, err=True)


def progress() -> Track:
    """Track that rewrites one line on a terminal; silent in pipes and with -q."""
    if is_quiet() or not sys.stderr.isatty():
        return silent
    last = 0.0

    def show(what: str, done: int, total: int) -> None:
        nonlocal last
        now = time.monotonic()
        if done >= total:
            click.echo("\r\033[K", nl=False, err=True)
        elif now - last > 0.1:
            last = now
            click.echo(f"\r\033[K{what} {done}/{total}", nl=False, err=True)

    return show
