"""bsmap merge: B-spline surfaces of one run or several -> one map."""

from pathlib import Path
from typing import Any

import click

from bsmap_cli.cli.options import force_option, input_argument, output_option, parameters, say
from bsmap_cli.cli.plots import check_plots, draw_plots, plot_option
from bsmap_cli.cli.stage import Result, beside, run_stage
from bsmap_cli.errors import PlacementError
from bsmap_cli.params import MergeParams
from bsmap_cli.track import Track


@click.command()
@input_argument("SURFACES_JSON", many=True)
@output_option
@parameters(MergeParams)
@plot_option
@force_option
def merge(
    surfaces_json: tuple[Path, ...],
    output: Path | None,
    merge_params: MergeParams,
    plots: tuple[Path, ...],
    force: bool,
) -> None:
    """One map of surfaces of one survey or several, or of a map and new surveys: X.map.json (X of the first survey)."""
    surveys = [path for path in surfaces_json if ".map.json" not in path.name]
    output = output or beside([*surveys, *surfaces_json][0], ".map.json", [".surfaces.json", ".map.json"])
    check_plots(plots, [*surfaces_json, output])
    make_map_file(surfaces_json, output, merge_params, force)
    if plots:
        _draw(surfaces_json, output, plots)


def make_map_file(inputs: tuple[Path, ...], output: Path, merge_params: MergeParams, force: bool) -> None:
    """The stage's work."""

    def compute(track: Track) -> Result:
        from bsmap_cli.cli.stage import map_figures
        from bsmap_cli.core.trims import rims_of
        from bsmap_cli.io.surfaces_json import read_surfaces, write_surfaces
        from bsmap_cli.merge import merge_surfaces

        maps = [read_surfaces(path) for path in inputs]
        try:
            merged = merge_surfaces(maps, merge_params, track=track)
        except PlacementError as error:
            raise PlacementError(error.survey, error.reason, str(inputs[error.survey])) from error
        for decision in merged.decisions:
            if decision.outcome == "moved":
                say(_moved(decision))
        outcomes = [decision.outcome for decision in merged.decisions]
        figures = {
            **map_figures(merged),
            "creases": len(merged.creases),
            "corners": len(merged.corners),
            "rims": sum(len(rims_of(surface)) for surface in merged.surfaces),
            "merged": outcomes.count("merged"),
            "refused": outcomes.count("refused"),
            **({"moved": outcomes.count("moved")} if len(inputs) > 1 else {}),
            **{f"placed {inputs[p.survey].name}": _told(p) for p in merged.placements},
        }
        return Result([lambda path, provenance: write_surfaces(path, merged, provenance)], figures)

    run_stage("merge", list(inputs), [output], [merge_params], compute, force)


def _told(placement: Any) -> str:
    """A model.Placement in a few words."""
    from bsmap_cli.merge.alignment import described

    return f"at {described(placement.pose)} ({placement.verdict}: rival {placement.rival:.0%})"


def _moved(decision: Any) -> str:
    """A model.Decision on what moved in one line."""
    names = " and ".join(name for name in (decision.first, decision.second) if name)
    figures = decision.figures
    offset = f", {100.0 * figures['offset']:.1f} cm apart" if "offset" in figures else ""
    return f"moved: {names} ({figures['area']:.2f} m2{offset}): {decision.reason}"


def _draw(inputs: tuple[Path, ...], output: Path, plots: tuple[Path, ...]) -> None:
    from bsmap_cli.io.surfaces_json import read_surfaces
    from bsmap_cli.merge.alignment import in_one_frame
    from bsmap_cli.merge.inputs import unite
    from bsmap_cli.picture import draw_merge

    merged = read_surfaces(output)
    before = unite(in_one_frame([read_surfaces(path) for path in inputs], merged.placements)).whole
    title = output.name.removesuffix(".map.json")
    draw_plots(plots, lambda path, ending: draw_merge(path, ending, before, merged, title))
