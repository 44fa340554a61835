"""bsmap evaluate: the artifacts of a run against the truth of a simulated log."""

import json
from pathlib import Path
from typing import Any

import click

from bsmap_cli.cli.options import existing, input_argument, say
from bsmap_cli.errors import MissingInputError

SAMPLE_STEP = 0.02
"""Metres between samples of a surface."""


@click.command()
@input_argument("RUN")
@click.option(
    "--truth",
    type=click.Path(path_type=Path),
    required=True,
    metavar="LOG",
    help="The simulated log (or its name without .mcap), beside which .truth.tum and .truth.ply lie.",
)
@click.option("--json", "as_json", is_flag=True, help="Print JSON instead of a table.")
@click.option("--picture", type=click.Path(path_type=Path), help="Picture (default: RUN.png; PNG, SVG or PDF).")
def evaluate(run: Path, truth: Path, as_json: bool, picture: Path | None) -> None:
    """Errors of a run's trajectory, cloud, surfaces and map to the truth of a simulated log; and a picture.

    RUN is the folder of `bsmap run --out-dir`, or the artifacts' common name without ending. The map is laid over the
    scene by the trajectory.
    """
    from bsmap_cli.evaluate import Mesh, evaluate_run
    from bsmap_cli.io.artifact import atomic_output
    from bsmap_cli.io.cloud_ply import read_cloud
    from bsmap_cli.io.mesh_ply import read_mesh
    from bsmap_cli.io.slam_mcap import read_slam
    from bsmap_cli.io.surfaces_json import read_surfaces
    from bsmap_cli.io.tum import read_tum
    from bsmap_cli.picture import draw_run

    stem = _stem(run)
    slam, cloud, surfaces, whole = (
        existing(stem.with_name(stem.name + ending))
        for ending in (".slam.mcap", ".cloud.ply", ".surfaces.json", ".map.json")
    )
    base = truth.with_name(truth.name.removesuffix(".mcap"))
    truth_tum, truth_ply = (existing(base.with_name(base.name + end)) for end in (".truth.tum", ".truth.ply"))
    maps = [read_surfaces(surfaces), read_surfaces(whole)]
    slam_map, points, mesh = read_slam(slam), read_cloud(cloud), Mesh(*read_mesh(truth_ply))
    rows = evaluate_run(slam_map.trajectory, points, maps, read_tum(truth_tum), mesh, SAMPLE_STEP)
    rows["map bytes / cloud bytes"] = whole.stat().st_size / (12 * len(points.points))
    click.echo(json.dumps(rows) if as_json else _table(rows))
    picture = picture or stem.with_name(stem.name + ".png")
    with atomic_output(picture) as path:
        draw_run(path, picture.suffix, slam_map, points, maps)
    say(f"{picture}: picture")


def _stem(run: Path) -> Path:
    """Common name of a run's artifacts."""
    if not run.is_dir():
        return run.with_name(run.name.removesuffix(".mcap"))
    found = sorted(run.glob("*.slam.mcap"))
    if len(found) != 1:
        raise MissingInputError(f"{run}: holds {len(found)} runs (*.slam.mcap); name one of them without its ending")
    return found[0].with_name(found[0].name.removesuffix(".slam.mcap"))


def _table(rows: dict[str, Any]) -> str:
    width = max(map(len, rows))
    return "\n".join(f"{name:{width}}  {value:.5g}" for name, value in rows.items())
