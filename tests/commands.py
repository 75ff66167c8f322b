"""How tests look at what commands print and write."""

from pathlib import Path

import numpy as np

from fleetjax import cli
from fleetjax.io import folder
from fleetjax.metrics import Metrics


def contents(path: Path) -> dict[str, bytes]:
    return {file.name: file.read_bytes() for file in path.iterdir()}


def refused(capsys, *arguments: object) -> str:
    """Return the one line on stderr with which arguments are refused."""
    assert cli.main([str(argument) for argument in arguments]) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.endswith("\n")
    assert len(printed.err.splitlines()) == 1
    return printed.err


def make_metrics(seed: int = 0, steps: int = 40) -> Metrics:
    """Return Metrics[T] of random numbers, as numpy arrays."""
    rng = np.random.default_rng(seed)
    counts = {name: rng.integers(0, 5, steps).astype(np.int32) for name in Metrics._fields}
    return Metrics(**counts | {name: rng.normal(size=steps).astype(np.float32) for name in folder.REALS})
