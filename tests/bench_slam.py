"""SLAM on simulated logs against the truth, and on real logs against relations and references.

python tests/bench_slam.py [NAME ...]     names of logs (default: all)

Simulated: RMS of the trajectory after alignment; distance of the cloud to the true scene, and its ratio to that of the
cloud made with true poses. Real: ../shared/tools/score_slam.py on the trajectory of `bsmap import` and `bsmap slam`;
"odometry" is the raw one. Seconds are of the processor, of whole commands for real logs.
"""

import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from foreign_logs import FOREIGN, LOGS
from scenes import simulated, true_slam_map

from bsmap_cli.cloud import make_cloud
from bsmap_cli.core import se2
from bsmap_cli.core.noise import range_sigma
from bsmap_cli.evaluate import align, distance_to_mesh, summary, transform_points
from bsmap_cli.params import CloudParams, SlamParams
from bsmap_cli.slam import run_slam

BSMAP = Path(sys.executable).with_name("bsmap")
SCORE = LOGS.parents[1] / "tools" / "score_slam.py"
SCENES = ("room", "corridor", "loop")
REAL = {
    "intel": ["--relations", "intel.relations.gz"],
    "mit-csail": ["--relations", "mit-csail.relations.gz"],
    "aces": ["--reference", "reference_gmapping.txt.gz"],
    "fr101": ["--reference", "reference_gmapping.txt.gz"],
    "fhw": ["--reference", "reference_gmapping.txt.gz"],
}


def main(names):
    chosen = [name for name in (*SCENES, *REAL, *FOREIGN) if not names or name.split()[0] in names]
    for title, group, bench in (
        ("simulated", SCENES, bench_simulated),
        ("real", REAL, bench_real),
        ("foreign", FOREIGN, bench_foreign),
    ):
        if here := [name for name in chosen if name in group]:
            bench(title, here)


def bench_simulated(title, names):
    print(f"{title:10} {'seed':>4} {'scans':>6} {'RMS mm':>7} {'max mm':>7} {'deg':>6} {'cloud mean':>10} {'RMS mm':>7}"
          f" {'ratio':>6} {'RMS':>6} {'lines':>6} {'nis/dof':>7} {'slam s':>7} {'cloud s':>7}")  # fmt: skip
    for name in names:
        for seed in (0, 1, 2):
            simulation = simulated(name, seed=seed)
            start = time.process_time()
            slam = run_slam(simulation.log, SlamParams())
            middle = time.process_time()
            cloud = make_cloud(slam, CloudParams())
            end = time.process_time()
            aligned = align(slam.trajectory, simulation.truth)
            true_map = true_slam_map(simulation)
            found = cloud_error(simulation, aligned.pose, cloud)
            true_pose = align(true_map.trajectory, simulation.truth).pose
            ideal = cloud_error(simulation, true_pose, make_cloud(true_map, CloudParams()))
            consistency = slam.statistics.nis.sum() / max(slam.statistics.dof.sum(), 1)
            print(f"{name:10} {seed:4} {len(slam.trajectory.time_ns):6} {1e3 * aligned.rms:7.2f}"
                  f" {1e3 * aligned.maximum:7.2f} {np.degrees(aligned.heading_rms):6.3f} {1e3 * found.mean:10.2f}"
                  f" {1e3 * found.rms:7.2f} {found.mean / ideal.mean:6.3f} {found.rms / ideal.rms:6.3f}"
                  f" {len(slam.lines.hits):6} {consistency:7.3f} {middle - start:7.2f} {end - middle:7.2f}",
                  flush=True)  # fmt: skip


def cloud_error(simulation, pose, cloud):
    points = transform_points(pose, cloud.points)
    return summary(distance_to_mesh(points, simulation.vertices, simulation.triangles))


def bench_real(title, names):
    print(f"\n{title:10} {'by':9} {'scans':>6} {'trans m':>8} {'+-':>7} {'max':>7} {'rot deg':>8} {'RMS m':>7}"
          f" {'max':>7} {'lines':>6} {'import s':>8} {'slam s':>7}")  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        for name in names:
            if not (LOGS / name).exists():
                continue
            source = LOGS / name / f"{name}.clf.gz"
            log, slam = (Path(folder) / f"{name}{ending}" for ending in (".mcap", ".slam.mcap"))
            importing = seconds_of([BSMAP, "-q", "import", source, "-o", log])
            slamming = seconds_of([BSMAP, "-q", "slam", log, "-o", slam])
            figures = json.loads(output_of([BSMAP, "info", "--json", slam]))["figures"]
            print(score_row(name, "slam", figures["scans"], score(name, Path(folder) / f"{name}.tum"))
                  + f" {figures['lines']:6} {importing:8.2f} {slamming:7.2f}", flush=True)  # fmt: skip
            print(score_row(name, "odometry", "", score(name, "odometry")), flush=True)


def score(name, estimate):
    folder = LOGS / name
    option, reference = REAL[name]
    command = [sys.executable, SCORE, estimate, "--log", folder / f"{name}.clf.gz", option, folder / reference]
    return json.loads(output_of(command))


def score_row(name, by, scans, scored):
    relations, reference = scored.get("relations", {}), scored.get("reference", {})
    numbers = [relations.get(key) for key in ("trans_mean_m", "trans_std_m", "trans_max_m", "rot_mean_deg")]
    numbers += [reference.get(key) for key in ("ate_rmse_m", "ate_max_m")]
    widths = (8, 7, 7, 8, 7, 7)
    cells = [f"{'-' if x is None else format(x, '.3f'):>{w}}" for x, w in zip(numbers, widths, strict=True)]
    return f"{name:10} {by:9} {scans:>6} " + " ".join(cells)


def output_of(command):
    return subprocess.run(list(map(str, command)), capture_output=True, text=True, check=True).stdout


def seconds_of(command):
    """Processor seconds of a command."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    output_of(command)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def bench_foreign(title, names):
    """No truth here: that it runs, what it keeps, and how far it bends the odometry."""
    print(f"\n{title:10} {'scans':>6} {'path m':>7} {'sigma':>6} {'lines':>6} {'matched':>8} {'nis/dof':>8}"
          f" {'off odometry m':>14} {'deg':>6} {'slam s':>7}")  # fmt: skip
    for name in names:
        read, path = FOREIGN[name]
        if not path.exists():
            continue
        log = read(path)
        start = time.process_time()
        slam = run_slam(log, SlamParams())
        seconds = time.process_time() - start
        poses, odometry = slam.trajectory.poses, se2.between(log.odometry[0], log.odometry)
        off = se2.between(odometry[-1], poses[-1])
        way = np.hypot(*np.diff(odometry[:, :2], axis=0).T).sum()
        statistics = slam.statistics
        print(f"{name:10} {len(poses):6} {way:7.1f} {range_sigma(log.horizontal.ranges):6.4f} {len(slam.lines.hits):6}"
              f" {statistics.matched.mean():8.2f} {statistics.nis.sum() / max(statistics.dof.sum(), 1):8.3f}"
              f" {np.hypot(*off[:2]):14.2f} {np.degrees(abs(off[2])):6.1f} {seconds:7.2f}", flush=True)  # fmt: skip


if __name__ == "__main__":
    main(sys.argv[1:])
