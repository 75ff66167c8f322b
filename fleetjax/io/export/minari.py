"""Minari's format: a folder; where an intervention ends, so does the data, and that is a truncation."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np

from fleetjax.config import Config
from fleetjax.envs import EnvSpec
from fleetjax.io.export.columns import EXTRAS, columns_of, source_of

FILES = {"data/main_data.hdf5", "data/metadata.json"}
_INFOS = {"next_observation": "next_obs", "success": "success", "timeout": "timeout", **EXTRAS}


def read_source(path: Path) -> Any:
    """Return what made a data set, see `source_of`."""
    return json.loads((path / "data/metadata.json").read_bytes())["fleetjax"]


def write(interventions: list[np.ndarray], config: Config, spec: EnvSpec, path: Path) -> None:
    """Write interventions as a folder."""
    import minari  # pyright: ignore[reportMissingImports]  an extra
    from gymnasium import spaces  # pyright: ignore[reportMissingImports]
    from minari.data_collector import EpisodeBuffer  # pyright: ignore[reportMissingImports]
    from minari.dataset.minari_storage import MinariStorage  # pyright: ignore[reportMissingImports]

    def episode(records: np.ndarray) -> EpisodeBuffer:
        columns = columns_of(records)
        last = np.arange(len(records)) == len(records) - 1
        return EpisodeBuffer(
            observations=[*columns["obs"], columns["next_obs"][-1]],
            actions=list(np.argmax(columns["human_action"], axis=1) if spec.discrete else columns["human_action"]),
            rewards=list(columns["reward"]),
            terminations=list(columns["violation"]),
            truncations=list((columns["timeout"] | last) & ~columns["violation"]),
            infos={name: columns[field] for name, field in _INFOS.items()},
        )

    path.mkdir()
    storage = MinariStorage.new(
        path / "data",
        observation_space=spaces.Box(-np.inf, np.inf, (spec.observation_size,)),
        action_space=spaces.Discrete(spec.action_size) if spec.discrete else spaces.Box(-1.0, 1.0, (spec.action_size,)),
    )
    fleet = f"{config.num_humans} humans who supervise {config.num_robots} robots"
    storage.update_metadata(
        {
            "dataset_id": _dataset_id(path.name),
            "minari_version": minari.__version__,
            "algorithm_name": config.algorithm,
            "description": f"Interventions of {fleet}, environment {spec.name}",
            "fleetjax": source_of(config, spec),
        }
    )
    storage.update_episodes(map(episode, interventions))


def _dataset_id(name: str) -> str:
    """Return the name by which Minari knows a data set; it must end in a version."""
    plain = re.sub(r"[^\w-]", "_", name)
    return plain if re.search(r"\w-v\d+$", plain) else f"{plain}-v0"
