"""bsmap run: the whole pipeline."""

import time
from collections.abc import Callable
from pathlib import Path

import click

from bsmap_cli.cli.cloud import make_cloud_file
from bsmap_cli.cli.fit import make_surfaces_file
from bsmap_cli.cli.merge import make_map_file
from bsmap_cli.cli.options import existing, force_option, input_argument, parameters, say
from bsmap_cli.cli.slam import make_slam_file
from bsmap_cli.errors import CannotWriteError
from bsmap_cli.params import CloudParams, FitParams, LogParams, MergeParams, SlamParams


@click.command()
@input_argument("LOG")
@click.option("--out-dir", type=click.Path(path_type=Path), help="Folder of all outputs (default: beside LOG).")
@parameters(LogParams)
@force_option
def run(log: Path, out_dir: Path | None, log_params: LogParams, force: bool) -> None:
    """All stages, with default options: LOG -> .slam.mcap, .tum, .cloud.ply, .surfaces.json, .map.json.

    For other options run the stages one by one: what is up to date is not made again.
    """
    existing(log)
    stem = _folder(out_dir or log.parent) / log.name.removesuffix(".mcap")
    slam, cloud, surfaces, whole = (
        stem.with_name(stem.name + ending) for ending in (".slam.mcap", ".cloud.ply", ".surfaces.json", ".map.json")
    )
    stages: list[Callable[[], None]] = [
        lambda: make_slam_file(log, slam, log_params, SlamParams(), force),
        lambda: make_cloud_file(slam, cloud, CloudParams(), force),
        lambda: make_surfaces_file(cloud, surfaces, FitParams(), force),
        lambda: make_map_file((surfaces,), whole, MergeParams(), force),
    ]
    seconds = []
    for stage in stages:
        begin = time.perf_counter()
        stage()
        seconds.append(time.perf_counter() - begin)
    names = ("slam", "cloud", "fit", "merge")
    say("seconds: " + ", ".join(f"{name} {s:.2f}" for name, s in zip(names, seconds, strict=True)))


def _folder(path: Path) -> Path:
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise CannotWriteError(f"{path}: no such folder can be made: {error.strerror}") from error
    return path
