"""Picture of a run: plan of trajectory, lines and cloud; the surfaces before and after merging."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bsmap_cli.core.bspline import evaluate_grid, evaluate_surface
from bsmap_cli.core.trims import inside_trims
from bsmap_cli.model import PointCloud, SlamMap, SurfaceMap, segment_ends
from bsmap_cli.picture.figure import new_figure, save

MOST_POINTS = 60_000


def draw_run(path: Path, ending: str, slam_map: SlamMap, cloud: PointCloud, maps: Sequence[SurfaceMap]) -> None:
    """Write a picture to `path` in the format of `ending` (.png, .svg, .pdf): a plan, and each map from above."""
    figure = new_figure(7 * (1 + len(maps)), 7)
    _draw_plan(figure.add_subplot(1, 1 + len(maps), 1), slam_map, cloud)
    for k, one in enumerate(maps):
        _draw_surfaces(figure.add_subplot(1, 1 + len(maps), 2 + k, projection="3d"), one)
    save(figure, path, ending)


def _draw_plan(axes: Any, slam_map: SlamMap, cloud: PointCloud) -> None:
    step = max(1, len(cloud.points) // MOST_POINTS)
    axes.scatter(*cloud.points[::step, :2].T, s=0.2, c="0.75", linewidths=0, rasterized=True, label="cloud")
    ends = segment_ends(slam_map.lines)
    for k, (a, b) in enumerate(ends):
        axes.plot([a[0], b[0]], [a[1], b[1]], "b-", lw=1, label="lines" if k == 0 else None)
    axes.plot(*slam_map.trajectory.poses[:, :2].T, "r-", lw=1.2, label="trajectory")
    axes.set(aspect="equal", xlabel="x [m]", ylabel="y [m]", title="plan")
    axes.legend(loc="upper right", fontsize=8)


def _draw_surfaces(axes: Any, one: SurfaceMap) -> None:
    from matplotlib import colormaps

    colors = colormaps["tab20"].colors  # type: ignore[attr-defined]
    u, v = np.linspace(0, 1, 60), np.linspace(0, 1, 15)
    parameters = np.stack(np.meshgrid(u, v, indexing="ij"), axis=-1)
    for k, surface in enumerate(one.surfaces):
        color = colors[k % len(colors)]
        points = evaluate_grid(surface, u, v)
        points[~inside_trims(surface, parameters.reshape(-1, 2)).reshape(points.shape[:2])] = np.nan
        axes.plot_wireframe(*np.moveaxis(points, 2, 0), color=color, linewidth=0.4, rcount=60, ccount=15)
        for loop in surface.trims:
            closed = np.concatenate([loop.parameters, loop.parameters[:1]])
            axes.plot(*evaluate_surface(surface, *closed.T).T, color=color, linewidth=1.0)
    count = sum(s.control_points.shape[0] * s.control_points.shape[1] for s in one.surfaces)
    axes.set(title=f"{len(one.surfaces)} surfaces, {count} control points", aspect="equal")
    axes.view_init(elev=55, azim=-60)
