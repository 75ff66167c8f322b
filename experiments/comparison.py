"""What scripts share that compare algorithms: run what is missing, then tables and one figure of all."""

import argparse
import subprocess
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

import fleetjax
from fleetjax.io import figure, files, folder
from fleetjax.io.sources import collect

ALGORITHMS = ("constraint", "constraint_trained", "random", "ensemble_dagger", "thrifty_dagger", "cur", "expert")
Case = tuple[str, str, int]  # environment, algorithm, seed


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
        return folder.read_finished(folder.read_run(path)) is not None
    except (OSError, ValueError):
        return False


def run_missing(cases: Iterable[Case], output: Path, parameters: Sequence[str]) -> list[Path]:
    """Run the cases that are not finished yet, one after the other; return the folders of all.

    Args:
        cases: what to run.
        output: folder of the run folders.
        parameters: further flags of `fleetjax run`.

    Raises:
        subprocess.CalledProcessError: if a run fails.
    """
    paths = {case: output / "-".join(map(str, case)) for case in cases}
    for (environment, algorithm, seed), path in paths.items():
        if not finished(path):
            command = [sys.executable, "-m", "fleetjax", "run", environment, "--algorithm", algorithm]
            subprocess.run([*command, "--seed", str(seed), "--output", path, "--overwrite", *parameters], check=True)
    return list(paths.values())


def show(runs: Sequence[Path], picture: Path) -> None:
    """Print the tables, and draw the figure; the expert, whose curves would flatten the others, is in it if it is alone."""
    print(fleetjax.compare(runs).markdown())
    shown = [run for run in collect(runs) if run.config.algorithm != "expert"] or runs
    files.write(picture, figure.render(fleetjax.plot(shown)))
    print(picture)


def make_parser(about: str | None, *, output: Path, seeds: list[int]) -> argparse.ArgumentParser:
    """Return a parser of what such scripts can be told, with these defaults."""
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--algorithms", nargs="+", choices=fleetjax.list_algorithms(), default=list(ALGORITHMS))
    parser.add_argument("--seeds", type=int, nargs="+", default=seeds)
    parser.add_argument("--output", type=Path, default=output, help="folder of the runs; other parameters need another one")
    parser.add_argument("parameters", nargs="*", help="after --: parameters of every run, as `fleetjax run` takes them")
    return parser
