"""Run every algorithm on every robot that it fits, at the paper's scale with one seed; print the table, draw the figure.

    python experiments/first_look.py [--environments humanoid anymal ...] [--output runs/first_look]

A run takes minutes on two cores. Finished runs are not run again: stop it at any time, and start it anew.
"""

import argparse
import subprocess
import sys
from pathlib import Path

import fleetjax
from fleetjax.io import figure, files, folder, text

ALGORITHMS = ("constraint", "random", "ensemble_dagger", "thrifty_dagger", "cur", "expert")
COLUMNS = {"successes": "successes", "violations": "violations", "idle": "idle", "human_steps": "human time"}


def fits(environment: str, algorithm: str) -> bool:
    """Return whether an algorithm runs on an environment: some need goals."""
    try:
        fleetjax.make_config(environment, algorithm)
    except ValueError:
        return False
    return True


def finished(path: Path) -> bool:
    """Return whether a run folder holds a run of full length."""
    try:
        run = folder.read_run(path)
        return len(folder.read_metrics(run).successes) == run.config.num_steps
    except (OSError, ValueError):
        return False


def main() -> None:
    """Run what is missing, then show all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--environments", nargs="+", choices=fleetjax.list_envs(), default=fleetjax.list_envs())
    parser.add_argument("--algorithms", nargs="+", choices=fleetjax.list_algorithms(), default=ALGORITHMS)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", type=Path, default=Path("runs/first_look"))
    args = parser.parse_args()

    cases = [(e, a) for e in args.environments for a in args.algorithms if fits(e, a)]
    folders = [args.output / f"{environment}-{algorithm}-{args.seed}" for environment, algorithm in cases]
    for (environment, algorithm), path in zip(cases, folders, strict=True):
        if not finished(path):
            command = [sys.executable, "-m", "fleetjax", "run", environment, "--algorithm", algorithm]
            subprocess.run([*command, "--seed", str(args.seed), "--output", path, "--overwrite"], check=True)

    runs = [folder.read_run(path) for path in folders]
    data = [(run.config, run.seed, folder.read_metrics(run)) for run in runs]
    print("| environment | algorithm | " + " | ".join(COLUMNS.values()) + " | ROHE |")
    print("|---|---|" + (len(COLUMNS) + 1) * "---:|")
    for config, _, metrics in data:
        total = text.add_up(metrics)
        counts = [text.count(total[name]) for name in COLUMNS]
        row = [config.environment, text.label(config.algorithm), *counts, f"{text.rohe_of(total, config):.3f}"]
        print("| " + " | ".join(row) + " |")
    picture = args.output / "first_look.png"
    shown = [entry for entry in data if entry[0].algorithm != "expert"]  # its curves would flatten the others
    files.write(picture, figure.render(figure.draw(figure.group(shown))))
    print(f"\n{picture}")


if __name__ == "__main__":
    main()
