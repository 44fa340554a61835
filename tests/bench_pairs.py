"""Whether faces that lie close together stay apart: thin walls, steps and open door leaves, default options.

    python tests/bench_pairs.py [seeds [scene ...]]

Of each pair before (fit) and after merging. found: the lesser share of both sides where a surface lies nearer than half
of the distance between them; layers: the greater mean number of surfaces on a side; shared: surfaces on both sides;
apart: millimetres between both, and their error.
"""

import sys

import numpy as np
from parallel_pairs import PAIRS, shown
from scenes import simulated, true_slam_map

from bsmap_cli.cloud import make_cloud
from bsmap_cli.evaluate import align
from bsmap_cli.fit import fit_surfaces
from bsmap_cli.merge import merge_surfaces
from bsmap_cli.params import CloudParams, FitParams, MergeParams, SlamParams
from bsmap_cli.slam import run_slam


def bench(scene, seed, true_poses):
    """Print a row for each pair; numbers of pairs told apart by fit and map."""
    simulation = simulated(scene, seed=seed)
    slam_map = true_slam_map(simulation) if true_poses else run_slam(simulation.log, SlamParams())
    fitted = fit_surfaces(make_cloud(slam_map, CloudParams()), FitParams(method="faces"))
    merged = merge_surfaces([fitted], MergeParams())
    pose = align(slam_map.trajectory, simulation.truth).pose
    told = np.zeros(2, dtype=int)
    for pair in PAIRS[scene]:
        both = [shown(pair, m, pose) for m in (fitted, merged)]
        told += [found.told for found in both]
        figures = (
            f"{f.found:7.1%} {f.layers:5.1f} {f.shared:4d} {1e3 * f.apart:7.1f} {1e3 * (f.apart - pair.apart):+5.1f}"
            for f in both
        )
        print(f"  {pair.name:18} {'   '.join(figures)}", flush=True)
    return told


def main(seeds=3, *scenes):
    print(f"{'':20} {'fit: found layers shared mm apart':33}   {'map: found layers shared mm apart':33}")
    for scene in scenes or PAIRS:
        for true_poses in (True, False):
            told = np.zeros(2, dtype=int)
            for seed in range(int(seeds)):
                print(f"{scene} {seed} {'true poses' if true_poses else 'slam'}")
                told += bench(scene, seed, true_poses)
            print(f"{scene}: of {int(seeds) * len(PAIRS[scene])} pairs told apart: fit {told[0]}, map {told[1]}")


if __name__ == "__main__":
    main(*sys.argv[1:])
