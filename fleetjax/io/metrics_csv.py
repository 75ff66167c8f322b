"""The table of a run's metrics: a row per timestep, with `timestep` as its first column."""

import csv
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from fleetjax.io import files
from fleetjax.io.files import expect
from fleetjax.metrics import Metrics

FILE = "metrics.csv"
REALS = ("reward", "uncertainty", "policy_loss")  # the metrics that are no counts
_COLUMNS = ("timestep", *Metrics._fields)


def open_log(folder: Path, mark: Mapping[str, Any] | None = None) -> files.Log:
    """Start the table of a run, or cut it back to a mark."""
    log = files.Log(folder / FILE, mark)
    if not mark:
        log.append((",".join(_COLUMNS) + "\n").encode())
    return log


def append(log: files.Log, metrics: Metrics, first: int) -> None:
    """Append the rows of the timesteps from `first` on."""
    rows = io.StringIO(newline="")
    columns = [np.asarray(x) for x in metrics]
    csv.writer(rows, lineterminator="\n").writerows((t, *row) for t, row in enumerate(zip(*columns, strict=True), first))
    log.append(rows.getvalue().encode())


def count(folder: Path) -> int:
    """Return the timesteps in the table of a run, even while it is written; 0 if there is none."""
    path = folder / FILE
    return max(0, path.read_bytes().count(b"\n") - 1) if path.exists() else 0


def parse(data: bytes, num_steps: int) -> Metrics:
    """Return the Metrics[T] in the content of a table, as numpy arrays.

    Raises:
        ValueError: if it is not a run's of at most `num_steps` timesteps.
    """
    expect(bool(data), "it is empty")
    head, *rows = csv.reader(io.StringIO(data.decode()))
    expect(head == list(_COLUMNS), "its columns are not those of this version of fleetjax")
    expect(0 < len(rows) <= num_steps, f"{len(rows)} rows for {num_steps} timesteps")
    expect(all(row[:1] == [str(t)] for t, row in enumerate(rows)), "timesteps are missing")
    columns = zip(Metrics._fields, list(zip(*rows, strict=True))[1:], strict=True)
    return Metrics._make(np.array(x, np.float32 if name in REALS else np.int32) for name, x in columns)
