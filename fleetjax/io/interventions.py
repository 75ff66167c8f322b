"""The log of interventions: a record for each timestep in which a human teleoperates a robot, appended to during the run."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from fleetjax.envs import EnvSpec
from fleetjax.fleet import Interventions
from fleetjax.io import files

FILE = "interventions.bin"


def record(spec: EnvSpec) -> np.dtype:
    """Return the type of a record.

    Fields: timestep; human; robot; `episode`, the timestep at which the robot's episode began; `step`, its control steps in
    it; priority f32; obs f32[O]; robot_action f32[A], what the policy would have done; human_action f32[A], what was done;
    next_obs f32[O], before any reset or new goal; reward f32; violation, success and timeout bool, of that step.
    """
    obs, action = ("<f4", (spec.observation_size,)), ("<f4", (spec.action_size,))
    numbers = [(name, "<i4") for name in ("timestep", "human", "robot", "episode", "step")]
    vectors = [("obs", *obs), ("robot_action", *action), ("human_action", *action), ("next_obs", *obs)]
    flags = [(name, "?") for name in ("violation", "success", "timeout")]
    return np.dtype([*numbers, ("priority", "<f4"), *vectors, ("reward", "<f4"), *flags])


def open_log(folder: Path, mark: Mapping[str, Any] | None = None) -> files.Log:
    """Start the log of a run, or cut it back to a mark."""
    return files.Log(folder / FILE, mark)


def append(log: files.Log, chunk: Interventions, first: int, spec: EnvSpec) -> None:
    """Append the interventions [C, M] of the timesteps from `first` on; humans who teleoperate nobody leave no record."""
    time, human = np.nonzero(np.asarray(chunk.robot) >= 0)
    rows = np.zeros(time.size, record(spec))
    for name, values in chunk._asdict().items():
        rows[name] = np.asarray(values)[time, human]
    rows["timestep"], rows["human"] = first + time, human
    rows["episode"] = rows["timestep"] - rows["step"]  # a robot is only teleoperated while it moves
    log.append(rows.tobytes())


def parse(data: bytes, spec: EnvSpec) -> np.ndarray:
    """Return the records in the content of a log.

    Raises:
        ValueError: if it is not a log of an environment like this.
    """
    kind = record(spec)
    if len(data) % kind.itemsize:
        raise ValueError(f"{len(data)} bytes is not a multiple of {kind.itemsize}, the size of a record")
    return np.frombuffer(data, kind)


def split(records: np.ndarray) -> list[np.ndarray]:
    """Return the interventions, each the records of one human who teleoperates one robot without a break in one episode.

    They are in the order in which they began.
    """
    ordered = records[np.lexsort((records["timestep"], records["robot"], records["human"]))]
    same = (ordered[name][1:] == ordered[name][:-1] for name in ("human", "robot", "episode"))
    continues = np.logical_and.reduce([*same, np.diff(ordered["timestep"]) == 1])
    parts = np.split(ordered, np.flatnonzero(~continues) + 1) if ordered.size else []
    return sorted(parts, key=lambda part: (part["timestep"][0], part["human"][0]))
