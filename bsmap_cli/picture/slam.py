"""Picture of a SlamMap: a plan with the way before and after, segments and loops; below it how it went over time."""

from pathlib import Path
from typing import Any

import numpy as np

from bsmap_cli.model import Array, IntArray, LoopClosures, SlamMap, StepStatistics, segment_ends
from bsmap_cli.picture.figure import new_figure, save

WIDTH, LEAST_PLAN, MOST_PLAN, STRIP = 11.0, 4.0, 16.0, 1.9
"""Inches: of the figure, of its plan's height, of each chart below it."""
RUNNING = 40
"""Scans that saw something, over which a chart's running figures are taken."""
TICK = 0.012
"""Length, as a share of the plan's size, of the tick in a segment's middle on the side from which it was seen."""


def draw_slam(path: Path, ending: str, slam: SlamMap, title: str = "") -> None:
    """Write a picture to `path` in the format of `ending` (.png, .svg, .pdf)."""
    low, high = _limits(slam)
    plan_height = float(np.clip(WIDTH * (high[1] - low[1]) / (high[0] - low[0]), LEAST_PLAN, MOST_PLAN))
    figure = new_figure(WIDTH, plan_height + 3 * STRIP)
    axes = figure.subplots(4, 1, height_ratios=[plan_height, STRIP, STRIP, STRIP])
    for below in axes[2:]:
        below.sharex(axes[1])
    _draw_plan(axes[0], slam, float(np.max(high - low)))
    axes[0].set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), title=title)
    seconds = _seconds(slam)
    _draw_segments(axes[1], slam.statistics, seconds)
    _draw_consistency(axes[2], slam.statistics, seconds)
    _draw_spread(axes[3], slam.trajectory.covariances, seconds)
    axes[3].set_xlabel("time [s]")
    figure.align_ylabels(axes)
    save(figure, path, ending)


def _limits(slam: SlamMap) -> tuple[Array, Array]:
    """Lowest and highest x, y of the plan, with a margin."""
    parts = [slam.trajectory.poses[:, :2], segment_ends(slam.lines).reshape(-1, 2)]
    if slam.tracked_poses is not None:
        parts.append(slam.tracked_poses[:, :2])
    points = np.concatenate([*parts, np.zeros((1, 2))])
    low, high = points.min(axis=0), points.max(axis=0)
    margin = 0.03 * float(np.max(high - low)) + 0.5
    return low - margin, high + margin


def _seconds(slam: SlamMap) -> Array:
    """(n,) seconds since the earliest scan; stamps that step back are held, as charts want it."""
    time_ns = np.maximum.accumulate(slam.trajectory.time_ns)
    return (time_ns - time_ns[:1]) * 1e-9


def _draw_plan(axes: Any, slam: SlamMap, size: float) -> None:
    poses = slam.trajectory.poses
    if len(slam.lines.hits):  # a legend of an empty collection is more than matplotlib can do
        _draw_lines(axes, slam, size)
    if slam.tracked_poses is not None:
        axes.plot(*slam.tracked_poses[:, :2].T, "-", c="0.6", lw=0.8, zorder=2, label="way as tracked")
    axes.plot(*poses[:, :2].T, "-", c="tab:red", lw=1.0, zorder=3, label="way")
    _draw_loops(axes, slam.closures, poses)
    for k, marker, what in ((0, "^", "start"), (-1, "s", "end")):
        if len(poses):
            axes.plot(*poses[k, :2], marker, c="k", ms=6, mfc="gold", zorder=6, label=what)
    axes.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.06), ncols=7, fontsize=8, frameon=False)


def _draw_lines(axes: Any, slam: SlamMap, size: float) -> None:
    """Segments, the wider the more scans saw them, with a tick towards where the robot was."""
    from matplotlib.collections import LineCollection

    ends, lines = segment_ends(slam.lines), slam.lines
    alpha = lines.parameters[:, 0]
    length = np.minimum(TICK * size, 0.3 * np.ptp(lines.extents, axis=1)) * lines.sides
    tick = length[:, None] * np.stack([np.cos(alpha), np.sin(alpha)], axis=-1)
    middle = ends.mean(axis=1)
    widths = 0.5 + 0.75 * np.log10(np.maximum(lines.hits, 1))
    label = f"{len(ends)} segments (wide: often seen)"
    axes.add_collection(LineCollection(list(ends), linewidths=widths, colors="tab:blue", zorder=4, label=label))
    ticks = list(np.stack([middle, middle + tick], axis=1))
    axes.add_collection(LineCollection(ticks, linewidths=0.5, colors="tab:blue", alpha=0.7, zorder=4))


def _draw_loops(axes: Any, closures: LoopClosures, poses: Array) -> None:
    from matplotlib.collections import LineCollection

    chords = np.stack([poses[closures.first, :2], poses[closures.second, :2]], axis=1)
    for held, color, style, marker, what in (
        (True, "tab:green", "-", "o", "loops closed"),
        (False, "magenta", ":", "x", "loops refused"),
    ):
        some = chords[closures.held == held]
        if len(some):
            axes.add_collection(LineCollection(list(some), colors=color, linewidths=1.2, linestyles=style, zorder=5))
            axes.plot(*some[:, 1].T, marker, c=color, ms=3 if held else 5, zorder=5, label=f"{len(some)} {what}")


def _draw_segments(axes: Any, statistics: StepStatistics, seconds: Array) -> None:
    """Seen and matched, running; on an axis of its own what is stored, which grows far beyond them."""
    looked = np.flatnonzero(statistics.new > 0)
    count = _running(np.ones(len(looked)))
    for values, color, what in (
        (statistics.new, "tab:orange", "seen in a scan"),
        (statistics.matched, "tab:green", "matched"),
    ):
        axes.plot(seconds[looked], _running(values[looked]) / count, c=color, lw=1, label=what)
    axes.set(ylabel="segments", ylim=(0, None))
    stored = axes.twinx()
    stored.plot(seconds, statistics.stored, c="tab:blue", lw=1)
    stored.set_ylabel("stored", color="tab:blue")
    stored.set_ylim(0, None)
    axes.legend(loc="lower left", bbox_to_anchor=(0, 1), borderaxespad=0, ncols=2, fontsize=8, frameon=False)


def _draw_consistency(axes: Any, statistics: StepStatistics, seconds: Array) -> None:
    """Normalised innovation squared over its degrees of freedom, running; 1 where the noise is as assumed."""
    some = np.flatnonzero(statistics.dof > 0)
    if len(some):
        ratio = _running(statistics.nis[some]) / _running(statistics.dof[some])
        axes.plot(seconds[some], ratio, c="tab:purple", lw=1)
    axes.axhline(1.0, c="k", lw=0.6)
    axes.set(ylim=(0, None), ylabel="innovation,\nnis / dof")


def _draw_spread(axes: Any, covariances: Array, seconds: Array) -> None:
    """Standard deviations of the pose: the longer half axis of its place, and its heading on an axis of its own."""
    place = np.sqrt(np.maximum(np.linalg.eigvalsh(covariances[:, :2, :2])[:, 1], 0.0)) if len(seconds) else seconds
    heading = np.degrees(np.sqrt(np.maximum(covariances[:, 2, 2], 0.0)))
    axes.plot(seconds, 100 * place, c="tab:red", lw=1)
    axes.set(ylim=(0, None))
    axes.set_ylabel("std. dev. of\nplace [cm]", color="tab:red")
    other = axes.twinx()
    other.plot(seconds, heading, c="tab:gray", lw=1)
    other.set_ylabel("of heading [deg]", color="tab:gray")
    other.set_ylim(0, None)


def _running(values: Array | IntArray) -> Array:
    """(k,) sum of the values (k,) about each one, RUNNING of them, fewer at the ends."""
    total = np.concatenate([[0.0], np.cumsum(values)])
    at = np.arange(len(values))
    return total[np.minimum(at + RUNNING // 2 + 1, len(values))] - total[np.maximum(at - RUNNING // 2, 0)]
