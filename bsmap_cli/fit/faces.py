"""PointCloud -> SurfaceMap: one trimmed B-spline surface for each smooth face of each data set."""

import logging
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from bsmap_cli.core.sides import side_towards
from bsmap_cli.errors import BsmapError
from bsmap_cli.fit.beams import BeamGrid, make_grid
from bsmap_cli.fit.division import Faces, find_faces
from bsmap_cli.fit.labels import feet_of_faces
from bsmap_cli.fit.lines import pose_part
from bsmap_cli.fit.movement import Movement, divide
from bsmap_cli.fit.surface import residuals_of
from bsmap_cli.fit.surfaces import spline_of
from bsmap_cli.fit.trimming import Trims, trim
from bsmap_cli.model import BSplineSurface, Crease, DataSet, Decision, IntArray, PointCloud, SurfaceMap
from bsmap_cli.params import FitParams
from bsmap_cli.track import Track, silent

logger = logging.getLogger(__name__)

VOTES = 100
"""Beams that tell from which side a face was seen, about."""


class _Set(NamedTuple):
    """What one data set gave: surfaces in the order of the faces, creases, and figures for the notes."""

    surfaces: list[BSplineSurface]
    creases: list[Crease]
    figures: dict[str, Any]


def fit_faces(cloud: PointCloud, params: FitParams, *, track: Track = silent) -> SurfaceMap:
    """Divide the cloud into data sets by movement, each into smooth faces, and fit a trimmed surface to each face.

    A set in which no face is found is left out; a Decision says so. The notes tell for each set how many beams belong
    to no face.

    Raises
    ------
    BsmapError
        Where no data set gives a surface.
    """
    movements = divide(cloud.scan_poses, params.set_length)
    surfaces: list[BSplineSurface] = []
    creases: list[Crease] = []
    data_sets, refused, notes = [], [], {}
    for number, movement in enumerate(movements):
        track("data sets", number, len(movements))
        name = f"set-{number + 1:02d}"
        grid = make_grid(cloud, movement.scans)
        beams = int(grid.hit.sum())
        data_sets.append(DataSet(name, movement.kind, int(movement.scans[0]), int(movement.scans[-1]), beams))
        found = fit_set(cloud, movement.scans, name, grid, len(creases))
        if not found.surfaces:
            scans = len(grid.ranges)
            reason = f"no face in its {beams} points of {scans} scans"
            refused.append(Decision(name, "", "refused", reason, {"scans": scans}))
            logger.warning("%s left out: %s", name, reason)
            continue
        surfaces += found.surfaces
        creases += found.creases
        notes[name] = found.figures
    track("data sets", len(movements), len(movements))
    if not surfaces:
        raise BsmapError(_nothing_to_fit(cloud, movements))
    return SurfaceMap(tuple(surfaces), tuple(data_sets), tuple(refused), {"fit": notes}, tuple(creases))


def fit_set(cloud: PointCloud, scans: IntArray, name: str, grid: BeamGrid, first_crease: int) -> _Set:
    """Faces of one data set; its creases are numbered from `first_crease`."""
    if len(grid.ranges) < 2:
        return _Set([], [], {})
    faces = find_faces(grid)
    feet = feet_of_faces(grid, faces.labels, [fitted.field for fitted in faces.fitted])
    trims = trim(grid, faces, feet)
    pose = (pose_part(cloud, Movement("", scans), name),)
    kept = [number for number, loops in enumerate(trims.loops) if loops]
    names = {number: f"{name}/{rank + 1:02d}" for rank, number in enumerate(kept)}
    used, creases = _creases(trims, names, first_crease)
    surfaces = []
    for number in kept:
        spline, covariance = spline_of(faces.fitted[number], pose)
        beams = grid.directions[(faces.labels == number) & grid.hit]
        step = max(1, len(beams) // VOTES)
        side = side_towards(spline, feet[number].uv[::step], -beams[::step])
        residuals = residuals_of(np.abs(feet[number].beyond))
        loops = tuple(replace(loop, creases=used[loop.creases]) for loop in trims.loops[number])
        surfaces.append(BSplineSurface(names[number], (name,), *spline, covariance, residuals, loops, side))
    return _Set(surfaces, creases, _figures(grid, faces))


def _creases(trims: Trims, names: dict[int, str], first: int) -> tuple[IntArray, list[Crease]]:
    """New number of each crease (-1, also at the end, for none), and the creases between faces that are kept."""
    used = np.full(len(trims.creases) + 1, -1)
    creases: list[Crease] = []
    for number, line in enumerate(trims.creases):
        if all(face in names for face in line.faces):
            used[number] = first + len(creases)
            a, b = (names[face] for face in line.faces)
            creases.append(Crease((a, b), line.points))
    return used, creases


def _figures(grid: BeamGrid, faces: Faces) -> dict[str, Any]:
    beams = int(grid.hit.sum())
    in_faces = int(np.count_nonzero((faces.labels >= 0) & grid.hit))
    return {"beams": beams, "in_faces": in_faces, "rest": beams - in_faces, "range_sigma": faces.sigma}


def _nothing_to_fit(cloud: PointCloud, movements: list[Movement]) -> str:
    if not movements:
        return f"no surface can be fitted: the robot stands still in all of the cloud's {len(cloud.scan_poses)} scans"
    return f"no surface can be fitted: {len(cloud.points)} points in {len(movements)} data sets are too few"
