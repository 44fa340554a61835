"""bsmap simulate: a scene -> a robot's log, and the truth."""

from dataclasses import dataclass
from pathlib import Path

import click

from bsmap_cli.cli.options import force_option, parameters
from bsmap_cli.cli.stage import Result, beside, run_stage
from bsmap_cli.params import SimulateParams
from bsmap_cli.track import Track


@click.command()
@click.argument("scene")
@click.option("-o", "--output", type=click.Path(path_type=Path), metavar="FILE", help="Log (default: SCENE.mcap).")
@parameters(SimulateParams)
@force_option
def simulate(scene: str, output: Path | None, simulate_params: SimulateParams, force: bool) -> None:
    """Log of a simulated robot in SCENE (room, corridor, loop, walls, steps, office), with FILE.truth.tum and .ply."""

    def compute(track: Track) -> Result:
        from bsmap_cli.io.log import write_scans
        from bsmap_cli.io.mesh_ply import write_mesh
        from bsmap_cli.io.tum import write_tum
        from bsmap_cli.simulate import simulate_scene

        made = simulate_scene(scene, simulate_params, track=track)
        log = made.log
        return Result(
            [
                lambda path, provenance: write_scans(
                    path, log.horizontal, log.vertical, made.odometry_time_ns, made.odometry_poses, provenance
                ),
                lambda path, provenance: write_tum(path, made.truth, provenance),
                lambda path, provenance: write_mesh(path, made.vertices, made.triangles, provenance),
            ],
            {"scans": len(log.horizontal.time_ns), "triangles": len(made.triangles)},
        )

    output = output or Path(f"{scene}.mcap")
    truth = [beside(output, ending, [".mcap"]) for ending in (".truth.tum", ".truth.ply")]
    run_stage("simulate", [], [output, *truth], [_Scene(scene), simulate_params], compute, force)


@dataclass(frozen=True)
class _Scene:
    """The scene's name as a parameter: it stands in for the input file that this stage has not."""

    scene: str
