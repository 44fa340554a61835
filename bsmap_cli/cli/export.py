"""bsmap export: a map -> files for other programs."""

from pathlib import Path
from typing import Any

import click

from bsmap_cli.cli.options import force_option, input_argument, parameters
from bsmap_cli.cli.stage import Result, run_stage
from bsmap_cli.params import ExportParams
from bsmap_cli.track import Track


@click.command()
@input_argument("MAP_JSON")
@click.option(
    "--to",
    "outputs",
    type=click.Path(path_type=Path),
    metavar="FILE",
    multiple=True,
    required=True,
    help="File to write, more than once for several; its ending tells the format: .ply, .obj, .stl, .glb meshes, "
    ".json surfaces in geomdl's layout.",
)
@parameters(ExportParams)
@force_option
def export(map_json: Path, outputs: tuple[Path, ...], export_params: ExportParams, force: bool) -> None:
    """Meshes and surfaces of a map (or of unmerged surfaces)."""
    for output in outputs:
        make_export_file(map_json, output, export_params, force)


def make_export_file(map_json: Path, output: Path, export_params: ExportParams, force: bool) -> None:
    """The stage's work for one file."""
    from bsmap_cli.export import choose_format

    # Before any work, for a wrong name should not cost a minute.
    file_format = choose_format(output, export_params.format)

    def compute(track: Track) -> Result:
        from bsmap_cli.export import export_map
        from bsmap_cli.io.surfaces_json import read_surfaces

        surfaces = read_surfaces(map_json)

        def write(path: Path, provenance: Any) -> None:
            content = export_map(surfaces, file_format, export_params, provenance=provenance.to_dict(), track=track)
            path.write_bytes(content)

        return Result([write], {"surfaces": len(surfaces.surfaces)})

    run_stage("export", [map_json], [output], [export_params], compute, force)
