"""What every stage does around its work: is the output up to date, compute, write all outputs or none, report."""

import dataclasses
import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any, NamedTuple

from bsmap_cli.cli.options import existing, progress, say
from bsmap_cli.errors import CannotWriteError, ParameterError
from bsmap_cli.track import Track

Writer = Callable[[Path, Any], object]
"""Writes one output to a path, with the provenance (io.artifact.Provenance)."""


class Result(NamedTuple):
    """A stage's writers, one an output in their order, and its figures for the report and the provenance."""

    writers: Sequence[Writer]
    figures: Mapping[str, Any]


def run_stage(
    stage: str,
    inputs: Sequence[Path],
    outputs: Sequence[Path],
    params: Sequence[Any],
    compute: Callable[[Track], Result],
    force: bool = False,
) -> None:
    """Make `outputs` from `inputs` unless they are up to date, which touches them, so that make is content."""
    from bsmap_cli.io import artifact

    for path in inputs:
        existing(path)
    check_outputs(inputs, outputs)
    provenance = artifact.make_provenance(stage, artifact.plain_parameters(*params), inputs)
    if not force and all(artifact.is_up_to_date(path, provenance.fingerprint) for path in outputs):
        for path in outputs:
            with suppress(PermissionError):  # somebody else's file is up to date all the same
                os.utime(path)
        say(f"{outputs[0]}: up to date")
        return
    result = compute(progress())
    provenance = dataclasses.replace(provenance, figures=dict(result.figures))
    with ExitStack() as stack:
        # Every sibling file is written before the first one takes its place.
        for path, write in reversed(list(zip(outputs, result.writers, strict=True))):
            write(stack.enter_context(artifact.atomic_output(path)), provenance)
    figures = ", ".join(f"{key.replace('_', ' ')} {_short(value)}" for key, value in result.figures.items())
    say(f"{', '.join(map(str, outputs))}: {figures}")


def check_outputs(inputs: Sequence[Path], outputs: Sequence[Path]) -> None:
    """Before any work: outputs must not be inputs or one file, and their folders must be there."""
    for k, path in enumerate(outputs):
        if any(path.resolve() == other.resolve() for other in inputs):
            raise ParameterError(f"{path}: is the input; name another output")
        if any(path.resolve() == other.resolve() for other in outputs[:k]):
            raise ParameterError(f"{path}: is the name of two outputs; name another one")
        if not path.parent.is_dir():
            raise CannotWriteError(f"{path}: there is no folder {path.parent}")
        if path.is_dir():
            raise CannotWriteError(f"{path}: is a folder; name another output")


def _short(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def beside(path: Path, ending: str, strip: Sequence[str]) -> Path:
    """Path beside `path` with `ending` in place of the first of the endings `strip` that it has (or its last one)."""
    for old in strip:
        if path.name.endswith(old):
            return path.with_name(path.name.removesuffix(old) + ending)
    return path.with_name(path.stem + ending)


def map_figures(surface_map: Any) -> dict[str, Any]:
    """Figures of a model.SurfaceMap for the report."""
    surfaces = surface_map.surfaces
    points = sum(s.residuals.points for s in surfaces)
    weighted = sum(s.residuals.mean * s.residuals.points for s in surfaces)
    return {
        "surfaces": len(surfaces),
        "control_points": sum(s.control_points.shape[0] * s.control_points.shape[1] for s in surfaces),
        "points": points,
        "mean_residual": weighted / points if points else 0.0,
    }
