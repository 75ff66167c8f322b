"""LeRobot's format v3.0: a folder with a table of the timesteps, one of the episodes, and their statistics."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from fleetjax.config import Config
from fleetjax.envs import EnvSpec
from fleetjax.io import files
from fleetjax.io.export.columns import EXTRAS, columns_of, source_of

_COLUMNS = {
    "observation.state": "obs",
    "action": "human_action",
    "next.observation.state": "next_obs",
    "next.reward": "reward",
    "next.done": "done",
    "next.truncated": "timeout",
    "next.success": "success",
    **EXTRAS,
}
_FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_FIRST = _FILE.format(chunk_index=0, file_index=0)
FILES = {f"data/{_FIRST}", f"meta/episodes/{_FIRST}", "meta/tasks.parquet"} | {
    f"meta/{name}.json" for name in ("info", "stats", "fleetjax")
}
_QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}


def read_source(path: Path) -> Any:
    """Return what made a data set, see `source_of`."""
    return json.loads((path / "meta/fleetjax.json").read_bytes())


def write(interventions: list[np.ndarray], config: Config, spec: EnvSpec, path: Path) -> None:
    """Write interventions as a folder."""
    import pandas as pd

    rate = max(1, round(1 / spec.control_step))
    frames = _frames(interventions, rate)
    _write_parquet(path / "data" / _FIRST, {name: _arrow(x) for name, x in frames.items()})
    _write_parquet(path / "meta/episodes" / _FIRST, _episodes(frames, [len(records) for records in interventions], spec.name))
    tasks = pd.Index([spec.name], dtype=object, name="task")
    pd.DataFrame({"task_index": [0]}, index=tasks).to_parquet(path / "meta/tasks.parquet", engine="pyarrow")
    info = {
        "codebase_version": "v3.0",
        "robot_type": spec.name,
        "total_episodes": len(interventions),
        "total_frames": len(frames["index"]),
        "total_tasks": 1,
        "chunks_size": 1000,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": rate,
        "splits": {"train": f"0:{len(interventions)}"},
        "data_path": f"data/{_FILE}",
        "video_path": None,
        "features": {name: _feature(x) for name, x in frames.items()},
    }
    for name, content in {"info": info, "stats": _statistics(frames), "fleetjax": source_of(config, spec)}.items():
        files.write_json(path / "meta" / f"{name}.json", content)


def _frames(interventions: list[np.ndarray], rate: int) -> dict[str, np.ndarray]:
    """Return LeRobot's features, [F] or [F, D] each, of all F timesteps; time goes by at `rate` in every episode."""
    columns = columns_of(np.concatenate(interventions))
    chosen = {name: columns[field] for name, field in _COLUMNS.items()}
    lengths = [len(records) for records in interventions]
    step = np.concatenate([np.arange(length) for length in lengths])
    places = {
        "timestamp": (step / rate).astype(np.float32),
        "frame_index": step,
        "episode_index": np.repeat(np.arange(len(lengths)), lengths),
        "index": np.arange(step.size),
        "task_index": np.zeros_like(step),
    }
    return {name: x[:, 0] if x.shape[1:] == (1,) else x for name, x in {**chosen, **places}.items()}


def _feature(values: np.ndarray) -> dict[str, Any]:
    """Return LeRobot's description of a feature."""
    return {"dtype": str(values.dtype), "shape": list(values.shape[1:]) or [1], "names": None}


def _statistics(frames: Mapping[str, np.ndarray]) -> dict[str, dict[str, list[float]]]:
    """Return LeRobot's statistics of the rows of each feature, a list over its D numbers, and `count`, a list of one."""
    matrix = np.column_stack([x.astype(np.float64) for x in frames.values()])
    quantiles = dict(zip(_QUANTILES, np.quantile(matrix, list(_QUANTILES.values()), axis=0), strict=True))
    measures = {"min": matrix.min(0), "max": matrix.max(0), "mean": matrix.mean(0), "std": matrix.std(0), **quantiles}
    cuts = np.cumsum([x[0].size for x in frames.values()])[:-1]
    parts = {measure: np.split(x, cuts) for measure, x in measures.items()}
    parts["count"] = [np.array([len(matrix)])] * len(frames)
    return {name: {measure: x[i].tolist() for measure, x in parts.items()} for i, name in enumerate(frames)}


def _episodes(frames: Mapping[str, np.ndarray], lengths: list[int], task: str) -> dict[str, Any]:
    """Return the columns of LeRobot's table of episodes, that have the given lengths."""
    ends = np.cumsum(lengths)
    begins = ends - lengths
    parts = [{name: x[a:b] for name, x in frames.items()} for a, b in zip(begins, ends, strict=True)]
    statistics = [_statistics(part) for part in parts]
    kinds = [(feature, measure) for feature, measures in statistics[0].items() for measure in measures]
    first_file = np.zeros_like(ends)
    return {
        "episode_index": np.arange(len(lengths)),
        "tasks": [[task]] * len(lengths),
        "length": np.array(lengths),
        "data/chunk_index": first_file,
        "data/file_index": first_file,
        "dataset_from_index": begins,
        "dataset_to_index": ends,
        **{f"stats/{feature}/{measure}": [x[feature][measure] for x in statistics] for feature, measure in kinds},
        "meta/episodes/chunk_index": first_file,
        "meta/episodes/file_index": first_file,
    }


def _arrow(values: np.ndarray) -> Any:
    """Return an arrow array of numbers or, from [F, D], of lists of D."""
    import pyarrow as pa  # pyright: ignore[reportMissingImports]  an extra

    flat = pa.array(values.ravel())
    return flat if values.ndim == 1 else pa.FixedSizeListArray.from_arrays(flat, values.shape[1])


def _write_parquet(path: Path, columns: Mapping[str, Any]) -> None:
    import pyarrow as pa  # pyright: ignore[reportMissingImports]  an extra
    from pyarrow import parquet  # pyright: ignore[reportMissingImports]

    path.parent.mkdir(parents=True)
    parquet.write_table(pa.table(dict(columns)), path)
