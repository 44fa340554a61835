"""Picture of a fit: which face each beam lies on, residuals along the beam, control nets with their covariance."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bsmap_cli.core.beams import beam_origins, cross
from bsmap_cli.core.projection import project
from bsmap_cli.core.trims import inside_trims
from bsmap_cli.core.uncertainty import control_point_covariances
from bsmap_cli.model import Array, BSplineSurface, IntArray, PointCloud, SurfaceMap
from bsmap_cli.picture.figure import new_figure, save
from bsmap_cli.picture.views import FRONT, PLAN, View, box, colors, heights, round_number, set_up

WIDTH, GRID, HISTOGRAM = 11.0, 3.2, 2.2
"""Inches: of the figure, of the height of a grid of scans and beams, of the histogram."""
MOST_SCANS = 1500
"""Drawn; of longer clouds every second scan, or every third, and so on."""
LABEL_ROOM = 0.11
"""Inches around a face's number that must be the face's own."""
EDGE = 0.02
"""Metres beyond its outline up to which a beam is on a face: outlines run along the outermost beams."""
RIM = 0.1
"""Metres around its control points in which a surface is looked for."""
ELLIPSE = 0.012
"""Share of the view's size that the half axis of a usual ellipse takes, at most."""


class Beams(NamedTuple):
    """Beams drawn: row and column in the grid, face (-1 of none), residual along the beam, metres (nan of none)."""

    scan: IntArray
    beam: IntArray
    face: IntArray
    residual: Array


def draw_fit(path: Path, ending: str, cloud: PointCloud, surfaces: SurfaceMap, title: str = "") -> None:
    """Write a picture to `path` in the format of `ending` (.png, .svg, .pdf)."""
    step = max(1, -(-len(cloud.scan_time_ns) // MOST_SCANS))
    beams = beams_on_faces(cloud, surfaces, step)
    limits = box([surface.control_points.reshape(-1, 3) for surface in surfaces.surfaces])
    nets = heights(limits, WIDTH - 1.0, (PLAN, FRONT), 1.6, 10.0)
    rows = [GRID, GRID, HISTOGRAM, *(height + 0.5 for height in nets)]
    figure = new_figure(WIDTH, sum(rows) + 0.9)
    axes = figure.subplots(5, 1, height_ratios=rows)
    axes[1].sharex(axes[0])
    palette = colors(len(surfaces.surfaces))
    _draw_faces(axes[0], beams, cloud, surfaces, step)
    _draw_residuals(figure, axes[1], beams, cloud, step)
    _draw_histogram(axes[2], beams)
    for below, view in zip(axes[3:], (PLAN, FRONT), strict=True):
        _draw_nets(below, view, surfaces.surfaces, palette, limits)
    if title:
        figure.suptitle(title)
    save(figure, path, ending)


def beams_on_faces(cloud: PointCloud, surfaces: SurfaceMap, step: int = 1) -> Beams:
    """The face that each beam of every `step`-th scan lies on: of those of its data set that it meets within their
    trims, no farther off than the fit's largest residual, the nearest one.
    """
    index = np.flatnonzero(cloud.scan_index % step == 0)
    scan, points = cloud.scan_index[index].astype(np.int64), cloud.points[index]
    origins = beam_origins(cloud, index)
    ranges = np.linalg.norm(points - origins, axis=1)
    directions = (points - origins) / np.maximum(ranges, 1e-9)[:, None]
    face, residual = np.full(len(index), -1), np.full(len(index), np.nan)
    nearest, owner = np.full(len(index), np.inf), _owner(surfaces, len(cloud.scan_time_ns))
    for number, surface in enumerate(surfaces.surfaces):
        some = np.flatnonzero((owner[scan] == _set_of(surface, surfaces)) & _near(surface, points))
        feet = project(surface, points[some], within=RIM)
        close = (feet.distance <= surface.residuals.maximum) & (feet.distance < nearest[some])
        some, feet_u, feet_v, distance = some[close], feet.u[close], feet.v[close], feet.distance[close]
        u, v, length = cross(surface, origins[some], directions[some], feet_u, feet_v)
        met = np.isfinite(length) & _on_face(surface, np.column_stack([u, v]))
        some = some[met]
        face[some], nearest[some], residual[some] = number, distance[met], ranges[some] - length[met]
    return Beams(scan // step, cloud.beam_index[index].astype(np.int64), face, residual)


def _owner(surfaces: SurfaceMap, scans: int) -> IntArray:
    """(scans,) number of each scan's data set, -1 of none; of a scan that two share, the later one."""
    owner = np.full(scans, -1)
    for number, data_set in enumerate(surfaces.data_sets):
        owner[data_set.first_scan : data_set.last_scan + 1] = number
    return owner


def _set_of(surface: BSplineSurface, surfaces: SurfaceMap) -> int:
    names = [data_set.name for data_set in surfaces.data_sets]
    return names.index(surface.data_sets[0])


def _near(surface: BSplineSurface, points: Array) -> NDArray[np.bool_]:
    """(n,) whether points lie in the box of the control points, which holds all of the surface, or its rim."""
    P = surface.control_points.reshape(-1, 3)
    rim = max(RIM, surface.residuals.maximum)
    return np.all((points >= P.min(axis=0) - rim) & (points <= P.max(axis=0) + rim), axis=1)


def _on_face(surface: BSplineSurface, parameters: Array) -> NDArray[np.bool_]:
    """(n,) whether points at parameters (n, 2) lie inside the trims or about EDGE beside them."""
    P = surface.control_points
    along_u = np.linalg.norm(np.diff(P, axis=0), axis=2).sum(axis=0).max()
    along_v = np.linalg.norm(np.diff(P, axis=1), axis=2).sum(axis=1).max()
    inside = inside_trims(surface, parameters)
    for offset in EDGE / np.maximum([along_u, along_v], EDGE) * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]]):
        outside = np.flatnonzero(~inside)
        inside[outside] = inside_trims(surface, parameters[outside] + offset)
    return inside


def _image(beams: Beams, cloud: PointCloud, step: int, values: Array | IntArray) -> tuple[Array, list[float]]:
    """Values of the beams as an image (beams, scans), nan where there is none, and its extent in scans and degrees."""
    first, last = int(cloud.beam_index.min(initial=0)), int(cloud.beam_index.max(initial=0))
    columns = -(-len(cloud.scan_time_ns) // step)
    image = np.full((last - first + 1, columns), np.nan)
    image[beams.beam - first, beams.scan] = values
    low, high = (np.degrees(cloud.angle_min + cloud.angle_increment * (k + d)) for k, d in ((first, -0.5), (last, 0.5)))
    return image, [-0.5 * step, (columns - 0.5) * step, low, high]


def _show(axes: Any, image: Array, extent: list[float], **how: Any) -> Any:
    axes.set(xlabel="scan", ylabel="beam [deg]", facecolor="white")
    return axes.imshow(image, extent=extent, origin="lower", aspect="auto", interpolation="nearest", **how)


def _draw_faces(axes: Any, beams: Beams, cloud: PointCloud, surfaces: SurfaceMap, step: int) -> None:
    from matplotlib.colors import ListedColormap

    image, extent = _image(beams, cloud, step, beams.face)
    count = len(surfaces.surfaces)
    table = ListedColormap([(0.75, 0.75, 0.75), *colors(count)])
    _show(axes, image, extent, cmap=table, vmin=-1.5, vmax=count - 0.5)
    for data_set in surfaces.data_sets[1:]:
        axes.axvline(data_set.first_scan, c="k", lw=0.7, ls="--")
    _number_faces(axes, image, extent, surfaces.surfaces)
    rest = int(np.count_nonzero(beams.face < 0))
    every = f", every {step}th scan" if step > 1 else ""
    axes.set_title(
        f"{count} faces of {len(surfaces.data_sets)} data sets (dashed: where they begin), numbered in each; "
        f"grey: {rest} of {len(beams.face)} beams on no face{every}",
        fontsize=9,
    )


def _number_faces(axes: Any, image: Array, extent: list[float], surfaces: Sequence[BSplineSurface]) -> None:
    """Number each face where it is widest, if the number has room there."""
    from scipy.ndimage import distance_transform_edt

    pixel = np.array([GRID * 0.75 / image.shape[0], (WIDTH - 1.0) / image.shape[1]])
    size = np.array([(extent[3] - extent[2]) / image.shape[0], (extent[1] - extent[0]) / image.shape[1]])
    for number, surface in enumerate(surfaces):
        deep = distance_transform_edt(np.pad(image == number, 1), sampling=pixel)[1:-1, 1:-1]
        row, column = np.unravel_index(np.argmax(deep), deep.shape)
        if deep[row, column] >= LABEL_ROOM:
            y, x = np.array([extent[2], extent[0]]) + (np.array([row, column]) + 0.5) * size
            axes.text(x, y, surface.name.split("/")[-1], fontsize=7, ha="center", va="center")


def _draw_residuals(figure: Any, axes: Any, beams: Beams, cloud: PointCloud, step: int) -> None:
    """Figure 15 of the paper, beam by beam: dark is in front of the surface, light behind it."""
    image, extent = _image(beams, cloud, step, 1e3 * beams.residual)
    limit = 3e3 * _spread(beams.residual)
    shown = _show(axes, image, extent, cmap="cividis", vmin=-limit, vmax=limit)
    figure.colorbar(shown, ax=axes, location="bottom", extend="both", shrink=0.5, aspect=50, label="[mm]")
    axes.set_title("residual along the beam (dark: in front of the surface; white: no return, or no face)", fontsize=9)


def _spread(residual: Array) -> float:
    """Standard deviation by the median, metres; 1 mm where there is none."""
    known = residual[np.isfinite(residual)]
    return max(1.4826 * float(np.median(np.abs(known))), 1e-3) if len(known) else 1e-3


def _draw_histogram(axes: Any, beams: Beams) -> None:
    known = 1e3 * beams.residual[np.isfinite(beams.residual)]
    axes.set(xlabel="residual along the beam [mm]", ylabel="beams", yscale="log")
    axes.set_title("no beam on a face", fontsize=9)
    if not len(known):
        return
    sigma = 1e3 * _spread(beams.residual)
    edges = np.linspace(-6 * sigma, 6 * sigma, 121)
    axes.hist(np.clip(known, edges[0], edges[-1]), bins=edges, color="0.65")
    x = (edges[1:] + edges[:-1]) / 2
    normal = len(known) * (edges[1] - edges[0]) / (sigma * np.sqrt(2 * np.pi)) * np.exp(-0.5 * (x / sigma) ** 2)
    axes.plot(x, normal, "k-", lw=1, label=f"normal, {sigma:.1f} mm (from the median)")
    axes.set(xlim=edges[[0, -1]], ylim=(0.5, None))
    axes.legend(loc="upper right", fontsize=8, frameon=False)
    inside, mean = np.sqrt(np.mean(known**2)), np.mean(np.abs(known))
    axes.set_title(
        f"rms {inside:.1f} mm, mean size {mean:.1f} mm, mean {np.mean(known):+.2f} mm, {len(known)} beams "
        "(outermost bars: all beyond)",
        fontsize=9,
    )


def _draw_nets(
    axes: Any, view: View, surfaces: Sequence[BSplineSurface], palette: Sequence[Any], limits: Array
) -> None:
    """Control nets, and the covariance of each control point as ellipse of one standard deviation, exaggerated."""
    from matplotlib.collections import EllipseCollection, LineCollection

    pick = list(view.axes)
    covariances = [control_point_covariances(s)[..., pick, :][..., pick].reshape(-1, 2, 2) for s in surfaces]
    values, vectors = np.linalg.eigh(np.concatenate([np.zeros((0, 2, 2)), *covariances]))
    half = np.sqrt(np.maximum(values, 0.0))
    size = float(np.max(limits[1, pick] - limits[0, pick]))
    usual = float(np.percentile(half[:, 1], 90)) if len(half) else 1.0
    times = round_number(ELLIPSE * size / max(usual, 1e-9))
    owner = np.repeat(np.arange(len(surfaces)), [len(c) for c in covariances]).astype(int)
    for surface, color in zip(surfaces, palette, strict=True):
        P = surface.control_points[..., pick]
        axes.add_collection(LineCollection([*P, *P.transpose(1, 0, 2)], colors=[color], linewidths=0.6, zorder=2))
    if len(half):
        points = np.concatenate([s.control_points[..., pick].reshape(-1, 2) for s in surfaces])
        ellipses = EllipseCollection(
            2 * times * half[:, 1], 2 * times * half[:, 0], np.degrees(np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1])),
            units="xy", offsets=points, offset_transform=axes.transData, facecolors="none",
            edgecolors=[palette[k] for k in owner], linewidths=0.7, zorder=3,
        )  # fmt: skip
        axes.add_collection(ellipses)
        axes.plot(*points.T, "k.", ms=1.2, zorder=4)
    what = f"{view.name}: {len(half)} control points and their nets; ellipses: one standard deviation, {times} times"
    set_up(axes, view, limits, what)
