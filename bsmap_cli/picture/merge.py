"""Picture of a merge: the surfaces before and after, what was joined and refused, and how sure the map is."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bsmap_cli.core.bspline import evaluate_surface
from bsmap_cli.core.trims import inside_trims
from bsmap_cli.core.uncertainty import surface_covariance
from bsmap_cli.model import Array, BSplineSurface, Decision, SurfaceMap
from bsmap_cli.picture.figure import new_figure, save
from bsmap_cli.picture.views import FRONT, PLAN, SIDEWAYS, View, box, colors, heights, outlines, set_up, shape

WIDTH = 14.0
"""Inches, of the figure: two views side by side."""
SAMPLE, MOST_SAMPLES = 0.1, 120
"""Metres between points at which the standard deviation is drawn, and the most of them each way of a surface."""
STEEP = 0.5
"""Vertical part of a normal below which a surface counts as a wall."""
MOST_SETS = 24
"""Data sets named in the legend."""


class Samples(NamedTuple):
    """points (n, 3) of the map; sigma (n,) metres, standard deviation along the normal; wall (n,) whether steep."""

    points: Array
    sigma: Array
    wall: NDArray[np.bool_]


def draw_merge(path: Path, ending: str, before: SurfaceMap, merged: SurfaceMap, title: str = "") -> None:
    """Write a picture to `path` in the format of `ending` (.png, .svg, .pdf).

    before : the maps that were merged, united as merging does.  merged : what came out.
    """
    inputs = before.surfaces
    drawn = [line for surface in (*inputs, *merged.surfaces) for line in outlines(surface)]
    limits = box(drawn)
    views = (PLAN, FRONT, SIDEWAYS)
    tall = [height + 0.95 for height in heights(limits, WIDTH / 2 - 1.0, views, 1.2, 10.0)]
    figure = new_figure(WIDTH, 2 * tall[0] + sum(tall[1:]) + 1.6)
    axes = figure.subplots(4, 2, height_ratios=[*tall, tall[0]])
    names = [data_set.name for data_set in before.data_sets]
    by_set = dict(zip(names, colors(len(names)), strict=True))
    first = [by_set.get(surface.data_sets[0], "0.5") for surface in inputs]
    for row, view in enumerate(views):
        _draw_surfaces(axes[row, 0], view, inputs, first, limits)
        _draw_surfaces(axes[row, 1], view, merged.surfaces, colors(len(merged.surfaces)), limits)
    axes[0, 0].set_title(f"before: {len(inputs)} surfaces, coloured by data set", fontsize=10)
    alone = sum(len(surface.data_sets) == 1 for surface in merged.surfaces)
    what = f"after: {len(merged.surfaces)} surfaces, each in its colour; hatched: {alone} of one data set only"
    axes[0, 1].set_title(what, fontsize=10)
    _draw_legend(axes[0, 0], by_set)
    _draw_decisions(axes[3, 0], inputs, merged.decisions, limits)
    _draw_deviation(figure, axes[3, 1], merged.surfaces, limits)
    if title:
        figure.suptitle(title)
    save(figure, path, ending)


def _draw_surfaces(
    axes: Any, view: View, surfaces: Sequence[BSplineSurface], palette: Sequence[Any], limits: Array
) -> None:
    """Shapes seen along an axis: the far ones first, see-through, each with its outline."""
    from matplotlib.patches import PathPatch

    depth = 3 - sum(view.axes)
    lines = [outlines(surface) for surface in surfaces]
    some_joined = any(len(surface.data_sets) > 1 for surface in surfaces)
    # Seen from above, from the south (low y) and from the east (high x).
    far = [(-1 if depth == 1 else 1) * float(np.concatenate(one)[:, depth].mean()) for one in lines]
    for k in np.argsort(far, kind="stable"):
        hatch = "////" if some_joined and len(surfaces[k].data_sets) == 1 else None
        path = shape(lines[k], view)
        axes.add_patch(PathPatch(path, facecolor=palette[k], edgecolor="none", alpha=0.25))
        axes.add_patch(PathPatch(path, facecolor="none", edgecolor=palette[k], linewidth=1.0, hatch=hatch, alpha=0.9))
    set_up(axes, view, limits)


def _draw_legend(axes: Any, by_set: dict[str, Any]) -> None:
    from matplotlib.patches import Patch

    shown = list(by_set.items())[:MOST_SETS]
    handles = [Patch(color=color, label=name) for name, color in shown]
    if len(by_set) > MOST_SETS:
        handles.append(Patch(color="none", label=f"and {len(by_set) - MOST_SETS} more"))
    if handles:
        axes.legend(handles=handles, loc="upper center", bbox_to_anchor=(0.5, -0.1), ncols=8, fontsize=7, frameon=False)


OUTCOMES = (
    ("merged", "joined", {"color": "tab:green", "linestyle": "-", "marker": "o", "ms": 3}),
    ("refused", "refused", {"color": "magenta", "linestyle": ":", "marker": "x", "ms": 6}),
    ("moved", "moved", {"color": "tab:red", "linestyle": "-", "marker": "D", "ms": 5}),
)
"""Outcomes of decisions in the order in which they are drawn, what they are called, and how they look."""


def _draw_decisions(axes: Any, inputs: Sequence[BSplineSurface], decisions: Sequence[Decision], limits: Array) -> None:
    """A line between the middles of the two surfaces of each decision, over the outlines of the input; what moved with
    its own outline.
    """
    from matplotlib.collections import LineCollection

    lines = {s.name: [line[:, :2] for line in outlines(s)] for s in inputs}
    axes.add_collection(LineCollection([x for one in lines.values() for x in one], colors="0.8", linewidths=0.6))
    middle = {name: np.concatenate(one).mean(axis=0) for name, one in lines.items()}
    counts = []
    for outcome, what, style in OUTCOMES:
        some = [[name for name in (d.first, d.second) if name] for d in decisions if d.outcome == outcome]
        drawn = [names for names in some if names and all(name in middle for name in names)]
        if some or outcome != "moved":
            counts.append(f"{len(some)} {what}" + (f" ({len(drawn)} of them drawn)" if len(drawn) < len(some) else ""))
        if outcome == "moved":
            moved = [line for names in drawn for name in names for line in lines[name]]
            axes.add_collection(LineCollection(moved, colors=style["color"], linewidths=2.0, zorder=2))
        for number, names in enumerate(drawn):
            xy = np.array([middle[name] for name in names])
            axes.plot(*xy.T, linewidth=0.8, zorder=3, label=what if number == 0 else None, **style)
    set_up(axes, PLAN, limits, "decisions on pairs, between their middles: " + ", ".join(counts))
    if axes.get_legend_handles_labels()[0]:
        axes.legend(loc="best", fontsize=8)


def sample_deviation(surfaces: Sequence[BSplineSurface]) -> Samples:
    """Standard deviation along the normal, sqrt(n' C n), on a grid over each surface, inside its trims."""
    parts = [Samples(np.zeros((0, 3)), np.zeros(0), np.zeros(0, dtype=bool)), *(_sample(s) for s in surfaces)]
    return Samples._make(np.concatenate(arrays) for arrays in zip(*parts, strict=True))


def _sample(surface: BSplineSurface) -> Samples:
    P = surface.control_points
    lengths = [np.linalg.norm(np.diff(P, axis=k), axis=2).sum(axis=k).max() for k in (0, 1)]
    u, v = (np.linspace(0, 1, int(np.clip(length / SAMPLE, 3, MOST_SAMPLES))) for length in lengths)
    parameters = np.stack(np.meshgrid(u, v, indexing="ij"), axis=-1).reshape(-1, 2)
    parameters = parameters[inside_trims(surface, parameters)]
    points, Su, Sv = evaluate_surface(surface, parameters[:, 0], parameters[:, 1], 1)
    normal = np.cross(Su, Sv)
    normal /= np.maximum(np.linalg.norm(normal, axis=1), 1e-12)[:, None]
    variance = np.einsum("ni,nij,nj->n", normal, surface_covariance(surface, *parameters.T), normal)
    return Samples(points, np.sqrt(np.maximum(variance, 0.0)), np.abs(normal[:, 2]) < STEEP)


def _draw_deviation(figure: Any, axes: Any, surfaces: Sequence[BSplineSurface], limits: Array) -> None:
    """Over the plan: floors and ceilings as small dots below, walls as large ones; the least sure on top."""
    samples = sample_deviation(surfaces)
    set_up(axes, PLAN, limits, "standard deviation along the normal (large dots: walls; small: floors, ceilings)")
    if not len(samples.sigma):
        return
    from matplotlib.colors import LogNorm
    from matplotlib.ticker import LogLocator

    low, high = np.percentile(1e3 * samples.sigma, [1, 99])
    norm = LogNorm(max(low, 1e-3), max(high, 1.01 * low, 2e-3))
    order = np.lexsort([samples.sigma, samples.wall])
    size = np.where(samples.wall, 12.0, 2.0)[order]
    dots = axes.scatter(
        *samples.points[order, :2].T, c=1e3 * samples.sigma[order], s=size, norm=norm, cmap="viridis_r",
        linewidths=0, rasterized=True,
    )  # fmt: skip
    ticks = LogLocator(subs=(1, 2, 5))
    bar = figure.colorbar(dots, ax=axes, location="bottom", extend="both", shrink=0.6, aspect=50, ticks=ticks)
    bar.ax.minorticks_off()
    bar.ax.xaxis.set_major_formatter("{x:.3g}")
    bar.set_label("[mm]")
