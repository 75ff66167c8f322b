"""robomimic's format: an HDF5 file, flags in it are 0 or 1."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from fleetjax.config import Config
from fleetjax.envs import EnvSpec
from fleetjax.io.export.columns import columns_of, source_of

FILES: set[str] = set()  # it is one file, not a folder
_COLUMNS = {
    "obs/state": "obs",
    "next_obs/state": "next_obs",
    "actions": "human_action",
    "rewards": "reward",
    "dones": "violation",
    "timeouts": "timeout",
    "successes": "success",
    "robot_actions": "robot_action",
    "interventions": "intervention",
    "human_id": "human",
    "robot_id": "robot",
    "episode": "episode",
    "timestep": "timestep",
    "priority": "priority",
}
_GYM = 2  # robomimic's number for environments that it makes through Gym


def read_source(path: Path) -> Any:
    """Return what made a data set, see `source_of`."""
    import h5py  # pyright: ignore[reportMissingImports]  an extra

    with h5py.File(path) as file:
        return json.loads(str(file["data"].attrs["fleetjax"]))


def write(interventions: list[np.ndarray], config: Config, spec: EnvSpec, path: Path) -> None:
    """Write interventions as a file."""
    import h5py  # pyright: ignore[reportMissingImports]  an extra

    # What robomimic documents as `env_type` it reads as `type`.
    environment = {"env_name": spec.name, "type": _GYM, "env_type": _GYM, "env_kwargs": {}}
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        data.attrs["total"] = sum(len(records) for records in interventions)
        data.attrs["env_args"] = json.dumps(environment)
        data.attrs["fleetjax"] = json.dumps(source_of(config, spec))
        for i, records in enumerate(interventions):
            demo = data.create_group(f"demo_{i}")
            demo.attrs["num_samples"] = len(records)
            demo["states"] = np.zeros((len(records), 0), np.float32)  # only robosuite has them
            columns = columns_of(records)
            for name, field in _COLUMNS.items():
                values = columns[field]
                demo[name] = values.astype(np.int64) if values.dtype == bool else values
