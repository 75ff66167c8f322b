"""Count the runs per hour of a sweep with one process on all cores, and with one process on each core.

    python benchmarks/sweep.py [--environment navigation] [--seeds 8] [-- PARAMETERS]

What follows `--` goes to `fleetjax sweep`. The time of a sweep includes start and compilation.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from common import table


def seconds(arguments: list[str], workers: int) -> float:
    """Return the wall-clock seconds of a sweep."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "fleetjax", "sweep", *arguments, "--workers", str(workers)]
        begin = time.perf_counter()
        subprocess.run([*command, "--output", str(Path(folder) / "sweep")], check=True, stdout=subprocess.DEVNULL)
        return time.perf_counter() - begin


def main() -> None:
    """Print a row for each number of processes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--environment", default="navigation")
    parser.add_argument("--seeds", type=int, default=8, help="runs of each sweep")
    parser.add_argument("parameters", nargs="*", help="parameters of the runs")
    args = parser.parse_args()
    cores = len(os.sched_getaffinity(0))
    times = {n: seconds([args.environment, "--seeds", str(args.seeds), *args.parameters], n) for n in (1, cores)}
    rows = [
        {
            "processes": workers,
            "cores each": cores // workers,
            "seconds": f"{elapsed:.1f}",
            "runs per hour": f"{3600 * args.seeds / elapsed:.1f}",
            "ratio": f"{times[1] / elapsed:.2f}",
        }
        for workers, elapsed in times.items()
    ]
    print(table(rows))


if __name__ == "__main__":
    main()
