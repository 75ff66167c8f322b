"""The record of what people did: one row per timestep, from which the run can be repeated."""

from pathlib import Path

import numpy as np

from fleetjax.config import Config
from fleetjax.console.engine import SIMULATED, Inputs, View
from fleetjax.envs import EnvSpec
from fleetjax.io import files, folder


def row_type(config: Config, spec: EnvSpec) -> np.dtype:
    """Return the type of a row: `timestep`, and for each seat who sat there, the robot, and what was done (see `Inputs`)."""
    seats = (config.num_humans,)
    fields = [("seat", "u1"), ("robot", "<i4"), ("given", "u1"), ("confirmed", "u1")]
    action = ("action", "<f4", (config.num_humans, spec.action_size))
    return np.dtype([("timestep", "<i4"), *((name, kind, seats) for name, kind in fields), action])


def open_record(path: Path) -> files.Log:
    """Start the record of a run."""
    return files.Log(path / folder.RECORD)


def append(log: files.Log, view: View, inputs: Inputs, kind: np.dtype) -> None:
    """Append a timestep."""
    row = np.zeros((), kind)
    row["timestep"], row["robot"] = view.timestep, view.robot
    for name, values in inputs._asdict().items():
        row[name] = values
    log.append(row.tobytes())


def parse(data: bytes, config: Config, spec: EnvSpec) -> np.ndarray:
    """Return the rows in the content of a record.

    Raises:
        ValueError: if it is none of such a run.
    """
    kind = row_type(config, spec)
    if not data or len(data) % kind.itemsize or len(data) // kind.itemsize > config.num_steps:
        raise ValueError(f"{len(data)} bytes are not 1 to {config.num_steps} rows of {kind.itemsize}")
    rows = np.frombuffer(data, kind)
    in_order = np.array_equal(rows["timestep"], np.arange(len(rows)))
    in_range = rows["seat"].max() <= SIMULATED and max(rows["given"].max(), rows["confirmed"].max()) <= 1
    if not (in_order and in_range and np.all(np.isfinite(rows["action"]))):
        raise ValueError("its rows are not a console's")
    return rows


def inputs_of(row: np.void) -> Inputs:
    """Return what was done at the timestep of a row."""
    return Inputs(row["seat"].copy(), row["given"] == 1, row["action"].copy(), row["confirmed"] == 1)
