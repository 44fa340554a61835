"""Partial compatibility against full joint compatibility branch and bound, on the same logs, as segments grow.

python tests/bench_association.py

At every step of the filter (which goes on with PCA's match) both decide on the same candidates: PCA in its groups, JCBB
over all segments of the scan. JCBB is exponential; it is cut at LIMIT seconds a step, and cut steps are counted apart.
"more": steps in which JCBB matches more segments; "fewer": in which it matches fewer, for it drops a hypothesis as soon
as a part of it fails its own gate; "other": as many, but others.

The second table is a hard case: rows of steps in a wall, 0.3 m apart, a pose that errs by as much, and every third step
moved by 0.1 m since the map was made, so that no hypothesis holds all and the bound cuts late.
"""

import signal
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from foreign_logs import FOREIGN, LOGS
from scenes import simulated
from test_slam_association import World

from bsmap_cli.io.carmen import import_carmen
from bsmap_cli.io.log import read_log, write_log
from bsmap_cli.model import ScanLog
from bsmap_cli.params import SlamParams
from bsmap_cli.slam import paper, run_slam
from bsmap_cli.slam.association import Candidates, best_joint_match, partial_compatibility

LIMIT = 0.2  # s
SCANS = 400  # of each log
BANDS = ((0, 2), (3, 4), (5, 6), (7, 8), (9, 10), (11, 13), (14, 99))


class Cut(Exception):
    """JCBB took too long."""


def limited(compute: Callable[[], list[int]], seconds: float = LIMIT) -> list[int]:
    """The result of `compute`; Cut after so many seconds."""

    def stop(*_):
        raise Cut

    signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        return compute()
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)


def compare(log: ScanLog, params: SlamParams) -> np.ndarray:
    """(k, 6) of each step: segments with candidates, candidates, seconds of PCA and of JCBB, sizes of both matches.

    The last is -1 where JCBB was cut, and has 0.5 added where it matched as many, but others.
    """
    rows = []

    def both(candidates: Candidates, order: list[int], group_size: int, gate: float) -> list[int]:
        start = time.perf_counter()
        chosen = partial_compatibility(candidates, order, group_size, gate)
        middle = time.perf_counter()
        of_segment = candidates.of_segment()
        # The segment with the fewest candidates first keeps the tree thin.
        seen = sorted(of_segment, key=lambda s: len(of_segment[s]))
        try:
            full = limited(lambda: best_joint_match(candidates, seen, gate))
            size = len(full) + 0.5 * (len(full) == len(chosen) and set(full) != set(chosen))
        except Cut:
            size = -1
        end = time.perf_counter()
        rows.append((len(seen), len(candidates.segment), middle - start, end - middle, len(chosen), size))
        return chosen

    original = paper.partial_compatibility
    paper.partial_compatibility = both
    try:
        run_slam(log, params)
    finally:
        paper.partial_compatibility = original
    return np.array(rows)


def table(name: str, rows: np.ndarray) -> None:
    for low, high in BANDS:
        here = rows[(rows[:, 0] >= low) & (rows[:, 0] <= high)]
        if len(here) == 0:
            continue
        whole = here[here[:, 5] >= 0]
        pca, full = whole[:, 4], whole[:, 5]
        same = np.count_nonzero(pca == full)
        other = np.count_nonzero(full % 1 > 0)
        more, fewer = np.count_nonzero(np.floor(full) > pca), np.count_nonzero(full < pca)
        print(
            f"{name:12} {f'{low}-{high}' if high < 99 else f'{low}+':>9} {len(here):6} {here[:, 1].mean():6.1f}"
            f" {same:6} {other:6} {more:6} {fewer:6} {len(here) - len(whole):6}"
            f" {1e3 * here[:, 2].mean():8.3f} {1e3 * here[:, 2].max():8.2f}"
            f" {1e3 * here[:, 3].mean():9.3f} {1e3 * here[:, 3].max():8.1f}",
            flush=True,
        )


def rows_of_steps() -> None:
    """Time of both as segments grow that have several candidates each."""
    print(f"\n{'steps':>6} {'cand.':>6} {'PCA':>4} {'JCBB':>5} {'right':>6} {'PCA ms':>8} {'JCBB ms':>9}")
    params = SlamParams(method="paper")
    for count in range(4, 29, 4):
        steps = [((2.0 + 0.3 * k, 0.6 * k - 4), (2.0 + 0.3 * k, 0.6 * k - 3.5)) for k in range(count)]
        world = World([*steps, ((-3, -5), (9, -5))], (0.3, 0.05, 0.01))
        segments = world.seen(np.array([0.12, 0.02, 0.003]), noise=0.5)
        segments.parameters[2::3, 1] += 0.1
        candidates = world.candidates(segments)
        start = time.perf_counter()
        chosen = partial_compatibility(candidates, range(count + 1), params.group_size, params.gate)
        middle = time.perf_counter()
        jcbb = partial(best_joint_match, candidates, range(count + 1), params.gate)
        try:
            full = str(len(limited(jcbb, 20)))
        except Cut:
            full = "cut"
        end = time.perf_counter()
        right = sum(world.order[candidates.segment[c]] == candidates.line[c] for c in chosen)
        print(
            f"{count:6} {len(candidates.segment):6} {len(chosen):4} {full:>5} {right:6} {1e3 * (middle - start):8.2f}"
            f" {1e3 * (end - middle):9.1f}",
            flush=True,
        )
        if full == "cut":
            return


def logs():
    """Names and logs, those of ../shared where they are there."""
    for scene in ("room", "corridor", "loop"):
        yield scene, simulated(scene).log
    for name in ("intel", "mit-csail", "aces", "fr101", "fhw"):
        path = LOGS / name / f"{name}.clf.gz"
        if path.exists():
            yield name, carmen(path)
    for name in ("wean 1", "dpslam"):
        read, path = FOREIGN[name]
        if path.exists():
            yield name, read(path)


def carmen(path: Path) -> ScanLog:
    with tempfile.TemporaryDirectory() as folder:
        log = import_carmen(path)
        write_log(Path(folder) / "log.mcap", log.rows, log.mounts)
        return read_log(Path(folder) / "log.mcap")


def first(log: ScanLog, count: int) -> ScanLog:
    scans = log.horizontal
    scans = replace(scans, time_ns=scans.time_ns[:count], ranges=scans.ranges[:count])
    return ScanLog(scans, None if log.odometry is None else log.odometry[:count], None)


def main(names):
    print(f"{'log':12} {'segments':>9} {'steps':>6} {'cand.':>6} {'same':>6} {'other':>6} {'more':>6}"
          f" {'fewer':>6} {'cut':>6} {'PCA ms':>8} {'max':>8} {'JCBB ms':>9} {'max':>8}")  # fmt: skip
    every = []
    for name, log in logs():
        if not names or name.split()[0] in names:
            every.append(compare(first(log, SCANS), SlamParams(method="paper")))
            table(name, every[-1])
    table("all", np.concatenate(every))
    rows_of_steps()


if __name__ == "__main__":
    main(sys.argv[1:])
