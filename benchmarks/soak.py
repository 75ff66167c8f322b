"""Kill a run again and again, resume it, and compare its result with that of an uninterrupted run.

    python benchmarks/soak.py --kills 20
    python benchmarks/soak.py --minutes 60 --environment humanoid -- --num-steps 2000

Each round is a run that is killed (SIGKILL) at random moments until it is finished. What follows `--` goes to `fleetjax run`.
"""

import argparse
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

RESULTS = ("metrics.csv", "policy.msgpack", "interventions.bin")
FROM = re.compile(r"resuming from .*/(\d+)")


def start(arguments: list[str], programs: Path) -> subprocess.Popen[str]:
    """Start the command line in a process; compiled programs are kept, so that starts are quick."""
    cache = {"JAX_COMPILATION_CACHE_DIR": str(programs), "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
    command = [sys.executable, "-m", "fleetjax", "run", *arguments]
    return subprocess.Popen(command, env=os.environ | cache, text=True, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)


def timesteps(folder: Path) -> int:
    """Return the timesteps in a run's metrics so far."""
    path = folder / "metrics.csv"
    return max(0, path.read_bytes().count(b"\n") - 1) if path.exists() else 0


def kill(process: subprocess.Popen[str], folder: Path, rng: np.random.Generator, *, until: float) -> bool:
    """Kill a process soon after its run has so many timesteps, one in eight before it has any; return whether it ran."""
    early = time.monotonic() + rng.uniform(0, 20) if rng.random() < 1 / 8 else np.inf
    while timesteps(folder) <= until and time.monotonic() < early and process.poll() is None:
        time.sleep(1e-3)
    time.sleep(rng.uniform(0, 0.3))
    killed = process.poll() is None
    process.kill()
    return killed


def results(folder: Path) -> list[bytes]:
    """Return what a run gave."""
    return [(folder / name).read_bytes() for name in RESULTS]


def main() -> None:
    """Parse the command line, kill and compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--environment", default="navigation")
    parser.add_argument("--kills", type=int, help="end after the round with this kill")
    parser.add_argument("--minutes", type=float, help="end after the round in which this time is up")
    parser.add_argument("--checkpoint-every", default="50")
    parser.add_argument("--seed", type=int, default=0, help="of the moments of the kills, and of the first round's run")
    parser.add_argument("parameters", nargs="*", help="parameters of the run")
    args = parser.parse_args()
    if args.kills is None and args.minutes is None:
        parser.error("--kills or --minutes is needed")
    rng, begun = np.random.default_rng(args.seed), time.monotonic()
    kills = resumed = lost = rounds = differing = 0
    with tempfile.TemporaryDirectory() as temporary:
        work = Path(temporary)
        while (args.kills is not None and kills < args.kills) or (
            args.minutes is not None and time.monotonic() - begun < 60 * args.minutes
        ):
            same = [args.environment, "--seed", str(args.seed + rounds), "--log-interventions", *args.parameters]
            whole, killed = work / f"whole-{rounds}", work / f"killed-{rounds}"
            process = start([*same, "--output", str(whole)], work / "programs")
            _, said = process.communicate()
            assert process.returncode == 0, said
            arguments = [*same, "--output", str(killed), "--checkpoint-every", args.checkpoint_every]
            while True:
                before = timesteps(killed)
                process = start(arguments, work / "programs")
                kills += kill(process, killed, rng, until=before + rng.uniform(0, timesteps(whole) / 4))
                _, said = process.communicate()
                resuming = FROM.search(said)
                if resuming:
                    resumed += 1
                    lost += before - int(resuming[1])
                elif "starting from t = 0" in said:
                    lost += before
                if process.returncode == 0:
                    assert resuming or "starting from t = 0" in said or arguments[0] != "--resume", said
                    break
                assert process.returncode == -9, said
                if (killed / "config.json").exists():
                    arguments = ["--resume", str(killed), "--checkpoint-every", args.checkpoint_every]
                print(f"kill {kills} at t = {timesteps(killed)}", file=sys.stderr, flush=True)
            differing += results(killed) != results(whole)
            rounds += 1
    print(f"{rounds} rounds, {kills} kills survived, {resumed} starts from t > 0, {lost} timesteps lost in all")
    print(f"results differing: {differing}")
    sys.exit(differing > 0)


if __name__ == "__main__":
    main()
