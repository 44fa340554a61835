"""The whole pipeline by its commands on simulated logs: seconds and memory of each stage, sizes, errors to the truth.

python tests/bench_pipeline.py [SCENE ...]     room (default), corridor, loop

Seconds are of the processor (user and system), of whole commands; memory is the largest resident set.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

BSMAP = Path(sys.executable).with_name("bsmap")
STAGES = (
    ("slam", ".mcap", ".slam.mcap"),
    ("cloud", ".slam.mcap", ".cloud.ply"),
    ("fit", ".cloud.ply", ".surfaces.json"),
    ("merge", ".surfaces.json", ".map.json"),
)


def main(scenes):
    best = min(measure([BSMAP, "--help"])[0] for _ in range(5))
    print(f"bsmap --help: {best:.3f} s")
    with tempfile.TemporaryDirectory() as folder:
        for scene in scenes:
            bench(Path(folder) / scene, scene)


def bench(stem, scene):
    print(f"\n{scene:9} {'seconds':>8} {'wall':>7} {'again':>6} {'MB peak':>8} {'bytes':>10}")
    log = stem.with_suffix(".mcap")
    report("simulate", [BSMAP, "-q", "simulate", scene, "-o", log], log)
    for stage, source, output in STAGES:
        report(stage, [BSMAP, "-q", stage, f"{stem}{source}"], Path(f"{stem}{output}"))
    for ending in ("ply", "obj", "stl", "glb", "nurbs.json"):
        output = Path(f"{stem}.{ending}")
        report(f"to {ending}", [BSMAP, "-q", "export", f"{stem}.map.json", "--to", output], output)
    command = [BSMAP, "-q", "evaluate", stem, "--truth", stem, "--json", "--picture", f"{stem}.png"]
    rows = json.loads(subprocess.run(list(map(str, command)), capture_output=True, text=True, check=True).stdout)
    print()
    for name, value in rows.items():
        print(f"{name:26} {value:10.5g}")


def report(name, command, output):
    """One row: the first run, and the wall seconds of a second one that finds its output up to date."""
    seconds, wall, memory = measure(command)
    _, again, _ = measure(command)
    print(f"{name:9} {seconds:8.2f} {wall:7.2f} {again:6.2f} {memory:8.0f} {output.stat().st_size:10}", flush=True)


def measure(command):
    """Processor seconds, wall seconds and largest resident set (MB) of a command that must succeed."""
    start = time.perf_counter()
    child = subprocess.Popen(list(map(str, command)), stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(child.pid, 0)
    child.returncode = os.waitstatus_to_exitcode(status)
    if child.returncode:
        raise subprocess.CalledProcessError(child.returncode, command)
    return usage.ru_utime + usage.ru_stime, time.perf_counter() - start, usage.ru_maxrss / 1024


if __name__ == "__main__":
    main(sys.argv[1:] or ["room"])
