"""Interventions as data sets that other libraries read: LeRobot's, robomimic's and Minari's. An intervention is an episode."""

import importlib.util
import json
import re
import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from fleetjax.config import Config
from fleetjax.envs import EnvSpec
from fleetjax.io import files, folder
from fleetjax.registry import unknown
from fleetjax.version import VERSION

NEEDS = {"lerobot": ("pyarrow",), "robomimic": ("h5py",), "minari": ("minari", "gymnasium", "h5py")}
FORMATS = tuple(NEEDS)

# What the formats call the columns of `_columns`.
_EXTRAS = {
    "robot_action": "robot_action",
    "intervention": "intervention",
    "human_id": "human",
    "robot_id": "robot",
    "robot_episode": "episode",
    "timestep": "timestep",
    "priority": "priority",
}
_LEROBOT = {
    "observation.state": "obs",
    "action": "human_action",
    "next.observation.state": "next_obs",
    "next.reward": "reward",
    "next.done": "done",
    "next.truncated": "timeout",
    "next.success": "success",
    **_EXTRAS,
}
_ROBOMIMIC = {
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
_MINARI_INFOS = {"next_observation": "next_obs", "success": "success", "timeout": "timeout", **_EXTRAS}
_FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_FIRST = _FILE.format(chunk_index=0, file_index=0)
# The files of the formats that are folders. One of them holds the mark: what `_source` returned.
_FILES = {
    "lerobot": {f"data/{_FIRST}", f"meta/episodes/{_FIRST}", "meta/tasks.parquet"}
    | {f"meta/{name}.json" for name in ("info", "stats", "fleetjax")},
    "minari": {"data/main_data.hdf5", "data/metadata.json"},
}
_GYM = 2  # robomimic's number for environments that it makes through Gym
_QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}


def check(kind: str) -> None:
    """Check that the libraries of a format are there.

    Raises:
        ValueError: if the format is unknown, or a library is not installed.
    """
    if kind not in FORMATS:
        raise ValueError(unknown("format", kind, FORMATS))
    for name in NEEDS[kind]:
        if importlib.util.find_spec(name) is None:
            raise ValueError(f'--format {kind} needs {name}: pip install "fleetjax[{kind}]"')


def export(interventions: list[np.ndarray], config: Config, spec: EnvSpec, output: Path, kind: str) -> None:
    """Write interventions as a data set, whole or not at all; an older export of the same format at `output` is replaced.

    Args:
        interventions: records [T] of each, as `interventions.split` returns them.
        config: the configuration of the run, which the data set repeats.
        spec: the environment's facts.
        output: a file for robomimic, else a folder.
        kind: one of `FORMATS`.

    Raises:
        ValueError: if there are none, a library is not installed, or something else is at `output`.
    """
    check(kind)
    if not interventions:
        raise ValueError("the log holds no interventions; nothing was exported")
    _check_output(output, kind)
    partial = output.with_name(f".{output.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir()
    try:
        written = partial / output.name
        _WRITERS[kind](interventions, config, spec, written)
        _put(written, output)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _check_output(output: Path, kind: str) -> None:
    """Check that nothing is lost by an export: it may replace an empty folder, or an older export and nothing more.

    Raises:
        ValueError: if something else is there.
    """
    if output.is_symlink():
        raise ValueError(f"{output} is a link, which an export does not replace; choose another --output")
    if not output.exists() or (output.is_dir() and not any(output.iterdir())):
        return
    if not _is_export(output, kind):
        raise ValueError(f"{output} was not exported by fleetjax as {kind}, so it is not replaced; choose another --output")
    for path in sorted(output.rglob("*")):
        name = path.relative_to(output).as_posix()
        if path.is_symlink() or not (path.is_dir() or name in _FILES[kind]):
            raise ValueError(f"{output} also holds {name}, which would be lost; move it, or choose another --output")


def _is_export(path: Path, kind: str) -> bool:
    """Return whether a file or folder bears the mark that exports of a format leave."""
    try:
        if kind == "robomimic":
            import h5py  # pyright: ignore[reportMissingImports]  an extra

            with h5py.File(path) as file:
                source = json.loads(str(file["data"].attrs["fleetjax"]))
        elif kind == "minari":
            source = json.loads((path / "data/metadata.json").read_bytes())["fleetjax"]
        else:
            source = json.loads((path / "meta/fleetjax.json").read_bytes())
        return "version" in source and "config" in source
    except (OSError, KeyError, TypeError, ValueError, RecursionError):
        return False


def _put(written: Path, output: Path) -> None:
    """Rename a data set to `output`; what was there goes when the new one is in place, and comes back if that fails."""
    if not output.exists():
        written.replace(output)
        return
    aside = Path(tempfile.mkdtemp(prefix=f".{output.name}.", dir=output.parent))
    old = aside / output.name
    try:
        output.replace(old)
        written.replace(output)
    except BaseException:
        if old.exists():
            old.replace(output)
        aside.rmdir()
        raise
    shutil.rmtree(aside, ignore_errors=True)


def _columns(records: np.ndarray) -> dict[str, np.ndarray]:
    """Return the columns [T, ...] of records: their fields, `intervention`, always true, and `done`, the end of an episode."""
    fields = {name: records[name] for name in records.dtype.names or ()}
    action = np.clip(records["human_action"], -1.0, 1.0)  # as environments do
    flags = {"intervention": np.ones(len(records), bool), "done": records["violation"] | records["timeout"]}
    return {**fields, **flags, "human_action": action}


def _source(config: Config, spec: EnvSpec) -> dict[str, Any]:
    """Return what made the data set; the seconds between two timesteps are exact here."""
    return {"version": VERSION, "control_step": spec.control_step, "config": folder.to_plain(config)}


def _write_lerobot(interventions: list[np.ndarray], config: Config, spec: EnvSpec, path: Path) -> None:
    """Write a folder in LeRobot's format v3.0: a table of the timesteps, one of the episodes, and their statistics."""
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
    for name, content in {"info": info, "stats": _statistics(frames), "fleetjax": _source(config, spec)}.items():
        files.write_json(path / "meta" / f"{name}.json", content)


def _frames(interventions: list[np.ndarray], rate: int) -> dict[str, np.ndarray]:
    """Return LeRobot's features, [F] or [F, D] each, of all F timesteps; time goes by at `rate` in every episode."""
    columns = _columns(np.concatenate(interventions))
    chosen = {name: columns[field] for name, field in _LEROBOT.items()}
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


def _write_robomimic(interventions: list[np.ndarray], config: Config, spec: EnvSpec, path: Path) -> None:
    """Write a file in robomimic's format; flags are 0 or 1."""
    import h5py  # pyright: ignore[reportMissingImports]  an extra

    # What robomimic documents as `env_type` it reads as `type`.
    environment = {"env_name": spec.name, "type": _GYM, "env_type": _GYM, "env_kwargs": {}}
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        data.attrs["total"] = sum(len(records) for records in interventions)
        data.attrs["env_args"] = json.dumps(environment)
        data.attrs["fleetjax"] = json.dumps(_source(config, spec))
        for i, records in enumerate(interventions):
            demo = data.create_group(f"demo_{i}")
            demo.attrs["num_samples"] = len(records)
            demo["states"] = np.zeros((len(records), 0), np.float32)  # only robosuite has them
            columns = _columns(records)
            for name, field in _ROBOMIMIC.items():
                values = columns[field]
                demo[name] = values.astype(np.int64) if values.dtype == bool else values


def _write_minari(interventions: list[np.ndarray], config: Config, spec: EnvSpec, path: Path) -> None:
    """Write a folder in Minari's format; where an intervention ends, so does the data, and that is a truncation."""
    import minari  # pyright: ignore[reportMissingImports]  an extra
    from gymnasium import spaces  # pyright: ignore[reportMissingImports]
    from minari.data_collector import EpisodeBuffer  # pyright: ignore[reportMissingImports]
    from minari.dataset.minari_storage import MinariStorage  # pyright: ignore[reportMissingImports]

    def episode(records: np.ndarray) -> EpisodeBuffer:
        columns = _columns(records)
        last = np.arange(len(records)) == len(records) - 1
        return EpisodeBuffer(
            observations=[*columns["obs"], columns["next_obs"][-1]],
            actions=list(np.argmax(columns["human_action"], axis=1) if spec.discrete else columns["human_action"]),
            rewards=list(columns["reward"]),
            terminations=list(columns["violation"]),
            truncations=list((columns["timeout"] | last) & ~columns["violation"]),
            infos={name: columns[field] for name, field in _MINARI_INFOS.items()},
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
            "fleetjax": _source(config, spec),
        }
    )
    storage.update_episodes(map(episode, interventions))


def _dataset_id(name: str) -> str:
    """Return the name by which Minari knows a data set; it must end in a version."""
    plain = re.sub(r"[^\w-]", "_", name)
    return plain if re.search(r"\w-v\d+$", plain) else f"{plain}-v0"


_WRITERS = {"lerobot": _write_lerobot, "robomimic": _write_robomimic, "minari": _write_minari}
