"""What every format holds: the columns of interventions, and what made the data set."""

from typing import Any

import numpy as np

from fleetjax.config import Config
from fleetjax.envs import EnvSpec
from fleetjax.io import plain
from fleetjax.version import VERSION

# What formats that have no names of their own call these columns.
EXTRAS = {
    "robot_action": "robot_action",
    "intervention": "intervention",
    "human_id": "human",
    "robot_id": "robot",
    "robot_episode": "episode",
    "timestep": "timestep",
    "priority": "priority",
}


def columns_of(records: np.ndarray) -> dict[str, np.ndarray]:
    """Return the columns [T, ...] of records: their fields, `intervention`, always true, and `done`, the end of an episode."""
    fields = {name: records[name] for name in records.dtype.names or ()}
    action = np.clip(records["human_action"], -1.0, 1.0)  # as environments do
    flags = {"intervention": np.ones(len(records), bool), "done": records["violation"] | records["timeout"]}
    return {**fields, **flags, "human_action": action}


def source_of(config: Config, spec: EnvSpec) -> dict[str, Any]:
    """Return what made the data set; the seconds between two timesteps are exact here."""
    return {"version": VERSION, "control_step": spec.control_step, "config": plain.to_plain(config)}
