"""Whole studies as small tables: a CSV file with a row per run, from which tables and figures can be made again."""

import contextlib
import csv
import functools
import io
import json
import platform
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fleetjax.config import Config
from fleetjax.io import files, folder, text
from fleetjax.io.files import expect
from fleetjax.io.metrics_csv import REALS
from fleetjax.io.outcomes import Outcome, thinned
from fleetjax.io.plain import from_plain, to_plain
from fleetjax.metrics import Metrics

SUFFIX = ".csv"
CURVES = ("successes", "violations", "idle", "human_steps")  # that a row holds over time; of other metrics it has the total
# Fields that have columns of their own; `config` holds the others, so that no row changes with the defaults.
_OWN = ("environment", "algorithm", "num_robots", "num_humans", "num_steps", "extra_demonstrations")
_VERSIONS = ("fleetjax", "jax", "mujoco")
_NOTES = ("processor", "seed", "timesteps")
_COLUMNS = (*_OWN, "config", *_VERSIONS, *_NOTES, *Metrics._fields, "curves")


def write(runs: Sequence[Outcome]) -> bytes:
    """Return the content of a file of rows: configuration, versions, processor, seed, totals, and thinned curves.

    Runs whose processor is not known count as runs of this machine.
    """
    return _written(map(_row, runs), _COLUMNS)


def _row(run: Outcome) -> dict[str, Any]:
    fields, totals = to_plain(run.config), text.add_up(run.metrics)
    own = {name: fields.pop(name) for name in _OWN}
    kept = thinned(len(run.timesteps))
    curves = {name: np.cumsum(getattr(run.metrics, name), dtype=np.int64)[kept].tolist() for name in CURVES}
    return {
        **own,
        "config": _compact(fields),
        **(run.versions or folder.versions()),
        "processor": run.processor or processor(),
        "seed": run.seed,
        "timesteps": run.timesteps[-1],
        **{name: total if name in REALS else f"{total:.0f}" for name, total in totals.items()},
        "curves": _compact(curves),
    }


def _compact(content: Mapping[str, Any]) -> str:
    return json.dumps(content, separators=(",", ":"))


def processor() -> str:
    """Return the name of this machine's processor."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def read(path: Path) -> list[Outcome]:
    """Read a file of rows.

    Raises:
        ValueError: if it is missing or damaged; the message has the path, the row and the reason.
    """
    runs: list[Outcome] = []
    make = functools.cache(lambda fields: from_plain(json.loads(fields)))  # once for all seeds
    table = _table(path)
    try:
        for row in table:
            expect(None not in row and None not in row.values(), "its number of cells is not that of the columns")
            runs.append(_outcome(row, make, f"{path}, row {len(runs) + 1}"))
    except (ValueError, TypeError, KeyError, OverflowError, RecursionError, csv.Error) as error:
        raise ValueError(f"{path} cannot be used: row {len(runs) + 1}: {error}") from None
    expect(bool(runs), f"{path} has no rows")
    return runs


def drop(path: Path, algorithms: Collection[str]) -> None:
    """Remove the rows of algorithms from a file, or the file if it has no others. The algorithms need not be registered.

    Raises:
        ValueError: if the file is missing or damaged.
    """
    table = _table(path)
    try:
        kept = [row for row in table if row["algorithm"] not in algorithms]
    except csv.Error as error:
        raise ValueError(f"{path} cannot be used: {error}") from None
    if kept:
        files.write(path, _written(kept, table.fieldnames or ()))
    else:
        path.unlink()


def _written(table: Iterable[Mapping[str, Any]], columns: Sequence[str]) -> bytes:
    content = io.StringIO(newline="")
    writer = csv.DictWriter(content, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(table)
    return content.getvalue().encode()


def _table(path: Path) -> "csv.DictReader[str]":
    try:
        content = path.read_text()
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} cannot be read: {error}") from None
    table = csv.DictReader(io.StringIO(content, newline=""), strict=True)
    missing = set(_COLUMNS) - set(Metrics._fields) - set(table.fieldnames or ())
    expect(not missing, f"{path} is not a file of rows: it has no columns {', '.join(sorted(missing))}")
    return table


def _outcome(row: Mapping[str, str], make: Callable[[str], Config], name: str) -> Outcome:
    own = {field: row[field] if field in _OWN[:2] else int(row[field]) for field in _OWN}
    config = make(_compact(own | json.loads(row["config"])))
    steps, curves = int(row["timesteps"]), json.loads(row["curves"])
    expect(0 < steps <= config.num_steps, f"timesteps = {steps} must be from 1 to num_steps = {config.num_steps}")
    timesteps = np.arange(1, steps + 1)[thinned(steps)]
    counts = {}
    for field in Metrics._fields:
        total = float(row.get(field, "nan"))
        if field in CURVES:
            counts[field] = np.diff(np.array(curves[field], np.int64), prepend=0)
            sound = len(counts[field]) == len(timesteps) and np.all(counts[field] >= 0) and np.sum(counts[field]) == total
            expect(bool(sound), f"the curve of {field} does not rise to its total in {len(timesteps)} points")
        else:  # of which only the total is known
            counts[field] = np.append(np.zeros(len(timesteps) - 1), total)
    versions = {key: row[key] for key in _VERSIONS}
    return Outcome(config, int(row["seed"]), Metrics(**counts), timesteps, name, versions, row["processor"])
