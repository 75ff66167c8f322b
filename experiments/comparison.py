"""What scripts share that compare algorithms: run what is missing, then one table and one figure of all."""

import argparse
import subprocess
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

import fleetjax
from fleetjax.config import Config
from fleetjax.io import figure, files, folder, text
from fleetjax.metrics import Metrics

ALGORITHMS = ("constraint", "constraint_trained", "random", "ensemble_dagger", "thrifty_dagger", "cur", "expert")
COLUMNS = {"successes": "successes", "violations": "violations", "idle": "idle", "human_steps": "human time"}
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


def run_missing(cases: Iterable[Case], output: Path, parameters: Sequence[str]) -> list[tuple[Config, int, Metrics]]:
    """Run the cases that are not finished yet, one after the other; return the configuration, seed and metrics of all.

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
    runs = [folder.read_run(path) for path in paths.values()]
    return [(run.config, run.seed, folder.read_metrics(run)) for run in runs]


def table(data: list[tuple[Config, int, Metrics]]) -> str:
    """Return a Markdown table, a row for each environment and algorithm: means over seeds, and their deviation if several."""
    head = ["environment", "algorithm", *COLUMNS.values(), "late successes", "ROHE"]
    rows = [head, ["---", "---"] + ["---:"] * (len(head) - 2)]
    for environment, algorithm in dict.fromkeys((config.environment, config.algorithm) for config, _, _ in data):
        runs = [(c, m) for c, _, m in data if (c.environment, c.algorithm) == (environment, algorithm)]
        totals = [text.add_up(m) for _, m in runs]
        cells = [_shown([total[name] for total in totals], 0) for name in COLUMNS]
        late = _shown([_late_successes(m) for _, m in runs], 0)
        return_ = _shown([text.rohe_of(total, config) for (config, _), total in zip(runs, totals, strict=True)], 3)
        rows.append([environment, text.label(algorithm), *cells, late, return_])
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def _late_successes(metrics: Metrics) -> float:
    """Return how many successes fell into the last quarter of a run, when most is learnt."""
    length = len(metrics.successes)
    return float(np.sum(metrics.successes[length - length // 4 :]))


def _shown(values: list[float], digits: int) -> str:
    mean = f"{np.mean(values):,.{digits}f}"
    return f"{mean} ± {np.std(values, ddof=1):,.{digits}f}" if len(values) > 1 else mean


def show(data: list[tuple[Config, int, Metrics]], picture: Path) -> None:
    """Print the table, and draw the figure; the expert, whose curves would flatten the others, is in it if it is alone."""
    print(table(data))
    shown = [entry for entry in data if entry[0].algorithm != "expert"] or data
    files.write(picture, figure.render(figure.draw(figure.group(shown))))
    print(f"\n{picture}")


def make_parser(about: str | None, *, output: Path, seeds: list[int]) -> argparse.ArgumentParser:
    """Return a parser of what such scripts can be told, with these defaults."""
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--algorithms", nargs="+", choices=fleetjax.list_algorithms(), default=list(ALGORITHMS))
    parser.add_argument("--seeds", type=int, nargs="+", default=seeds)
    parser.add_argument("--output", type=Path, default=output, help="folder of the runs; other parameters need another one")
    parser.add_argument("parameters", nargs="*", help="after --: parameters of every run, as `fleetjax run` takes them")
    return parser
