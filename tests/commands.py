"""How tests look at what commands print and write."""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from fleetjax import checks, cli, envs
from fleetjax.config import Config
from fleetjax.fleet import FleetState
from fleetjax.io import folder, metrics_csv
from fleetjax.metrics import Metrics

STEPS = 120  # chunks of two
TINY = [
    *("--num-robots", "4", "--num-humans", "2", "--num-steps", str(STEPS), "--hard-reset-time", "2", "--initial-period", "9"),
    *("--hidden-sizes", "8", "--ensemble-size", "2", "--batch-size", "8", "--critic-capacity", "300"),
    *("--num-demonstrations", "20", "--pretraining-steps", "5"),
    *("--num-critic-transitions", "20", "--critic-pretraining-steps", "5"),
]


def contents(path: Path) -> dict[str, bytes]:
    """Return the files of a folder by name; not those of its folders."""
    return {file.name: file.read_bytes() for file in path.iterdir() if file.is_file()}


def edit_config(path: Path, edit: Callable[[dict[str, Any]], Any]) -> None:
    """Edit the content of a run folder's config.json, and seal it again, as a forger would."""
    content = json.loads((path / folder.CONFIG).read_text())
    edit(content)
    (path / folder.CONFIG).write_text(json.dumps(folder.with_digest(content)))


def refused(capsys, *arguments: object) -> str:
    """Return the one line on stderr with which arguments are refused."""
    assert cli.main([str(argument) for argument in arguments]) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.endswith("\n")
    assert len(printed.err.splitlines()) == 1
    return printed.err


def own_lines(errors: str) -> list[str]:
    """Return what a process printed to stderr, line by line, but for what XLA logs on its own."""
    return [line for line in errors.splitlines() if not re.match(r"[IWE]\d{4} ", line)]


def make_metrics(seed: int = 0, steps: int = 40) -> Metrics:
    """Return Metrics[T] of random numbers, as numpy arrays."""
    rng = np.random.default_rng(seed)
    counts = {name: rng.integers(0, 5, steps).astype(np.int32) for name in Metrics._fields}
    return Metrics(**counts | {name: rng.normal(size=steps).astype(np.float32) for name in metrics_csv.REALS})


def write_run(path: Path, config: Config, seed: int, metrics: Metrics) -> Path:
    """Write the folder of a run that ended with these Metrics[T], and return it."""
    path.mkdir(parents=True)
    log = metrics_csv.open_log(path)
    metrics_csv.append(log, metrics, 0)
    log.close()
    folder.write_config(folder.Run(path, config, seed), sealed=True)
    return path


def shapes_of(config: Config) -> FleetState:
    """Return shapes and types of the state of a registered environment's fleet."""
    return checks.state_shapes(config, envs.make(config.environment, config.backend))
