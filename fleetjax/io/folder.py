"""The folder of a run: configuration, per-timestep metrics, figure and trained policy.

`config.json` is written when a run begins, and again last of all with the SHA-256 of the data files, and always with
that of its own content. What does not match is refused. Nothing is executed when it is read.
"""

import contextlib
import csv
import io
import itertools
import json
import math
import os
import re
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import serialization

from fleetjax import envs
from fleetjax.checks import state_shapes
from fleetjax.config import Config, all_fields, get_value, validate
from fleetjax.io import checkpoint, files, interventions
from fleetjax.learning.imitation import PolicyState
from fleetjax.metrics import Metrics
from fleetjax.priority import get_algorithm
from fleetjax.version import VERSION

CONFIG, METRICS, FIGURE, POLICY, EVALUATION = "config.json", "metrics.csv", "figure.png", "policy.msgpack", "evaluation.json"
RECORD = "console.bin"  # what people did, where they supervised the run
DATA = (METRICS, POLICY, interventions.FILE, RECORD)
REALS = ("reward", "uncertainty", "policy_loss")  # the metrics that are no counts
_COLUMNS = ("timestep", *Metrics._fields)
_OWN_DIGEST = "sha256_config"
_LARGEST = 2**31 - 1  # traced integers are i32


class Run(NamedTuple):
    """What a run folder holds.

    Attributes:
        folder: where it is.
        config: the configuration.
        seed: the seed of its key.
        logged: whether interventions are logged.
        digests: SHA-256 by file name.
        versions: what it ran under, in order, each with the `timestep` from which on; nothing before it begins.
    """

    folder: Path
    config: Config
    seed: int
    logged: bool = False
    digests: Mapping[str, str] = {}
    versions: tuple[Mapping[str, Any], ...] = ()


def default_folder(config: Config, seed: int) -> Path:
    """Return a folder below `runs/` that does not exist yet."""
    name = f"{config.environment}-{config.algorithm}-seed{seed}-{time.strftime('%Y%m%d-%H%M%S')}"
    path = Path("runs") / re.sub(r"[^\w.-]", "_", name)
    others = (path.with_name(f"{path.name}-{i}") for i in itertools.count(2))
    return next(p for p in itertools.chain([path], others) if not p.exists())


def check_free(path: Path, *, overwrite: bool, is_folder: bool = False) -> Path:
    """Check that an output can be written without loss, before it is computed.

    Args:
        path: where it shall go.
        overwrite: whether it may replace what is there.
        is_folder: whether it is a folder; else it is a file.

    Returns:
        Path: where to write it: in place of a link, its target.

    Raises:
        FileExistsError: if something is there, and it is no empty folder, unless `overwrite`.
        OSError: if it cannot be written there.
    """
    if os.path.lexists(path) and not overwrite and not (is_folder and path.is_dir() and not any(path.iterdir())):
        raise FileExistsError(f"{path} exists already; pass --overwrite to replace it")
    if path.exists() and path.is_dir() != is_folder:
        raise FileExistsError(f"{path} is a {'file' if path.is_file() else 'folder'}; choose another --output")
    target = Path(os.path.realpath(path))
    files.check_place(target)
    return target


def is_run(path: Path) -> bool:
    """Return whether a folder holds a run, be it damaged."""
    return (path / CONFIG).exists()


def check_folder(path: Path, *, overwrite: bool) -> None:
    """Check that a run can be written to a folder without loss of anything but an older run.

    Raises:
        FileExistsError: if something is there that is neither an empty folder nor, with `overwrite`, a run.
    """
    if not os.path.lexists(path) or (path.is_dir() and {found.name for found in path.iterdir()} <= {files.LOCK}):
        return
    if not is_run(path):
        raise FileExistsError(f"{path} exists already and is not a run folder; choose another --output")
    if not overwrite:
        raise FileExistsError(f"{path} exists already; choose another --output, or pass --overwrite")


def prepare(run: Run) -> bool:
    """Write the configuration of a new run, unless the folder holds a run: that one stays until `create`.

    Returns:
        bool: whether the folder held no run.
    """
    new = not is_run(run.folder)
    if new:
        write_config(run, sealed=False)
    return new


def create(run: Run) -> None:
    """Write the configuration of a new run; an older run in the folder goes."""
    checkpoint.clear(run.folder)
    write_config(run, sealed=False)  # before data go: if killed in between, this run can be resumed, from the start
    for name in (FIGURE, EVALUATION, *DATA):
        (run.folder / name).unlink(missing_ok=True)


def discard(path: Path) -> None:
    """Remove a run folder in which no timestep was written."""
    for name in (CONFIG, files.LOCK, *DATA):
        (path / name).unlink(missing_ok=True)
    with contextlib.suppress(OSError):  # it holds files of others
        path.rmdir()


def versions() -> dict[str, str]:
    """Return the versions that a result depends on."""
    import mujoco

    return {"fleetjax": VERSION, "jax": jax.__version__, "mujoco": mujoco.__version__}


def resumed(run: Run, timestep: int) -> Run:
    """Return a run as it resumes at a timestep: with today's versions from there on, if they are not those before."""
    before = [entry for entry in run.versions if entry["timestep"] < timestep]
    now = {"timestep": timestep, **versions()}
    return run._replace(versions=(*before, *([now] if changes(before[-1], now) else [])))


def changes(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Return the names of what has another version now."""
    return [name for name in versions() if before[name] != now[name]]


def write_config(run: Run, *, sealed: bool) -> None:
    """Write `config.json`: every field, the seed, versions, and the SHA-256 of the data files that are there, if `sealed`."""
    data = {name: run.folder / name for name in DATA}
    digests = {name: files.digest(path.read_bytes()) for name, path in data.items() if sealed and path.exists()}
    ran_under = run.versions or [{"timestep": 0, **versions()}]
    content = {"log_interventions": run.logged, "versions": ran_under, "sha256": digests}
    files.write_json(run.folder / CONFIG, with_digest(identity(run.config, run.seed) | content))


def with_digest(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content of `config.json` with the SHA-256 of all else in it."""
    rest = {name: value for name, value in content.items() if name != _OWN_DIGEST}
    return rest | {_OWN_DIGEST: files.digest(json.dumps(rest, sort_keys=True).encode())}


def to_plain(config: Config) -> dict[str, Any]:
    """Return fields and parameters as plain Python values; the shortest decimal that stands for each f32."""

    def plain(value: Any, kind: type) -> Any:
        if kind is tuple:
            return list(value)
        return float(str(np.float32(value))) if kind is float else kind(value)

    return {name: plain(get_value(config, name), field.kind) for name, field in all_fields(config.algorithm).items()}


def identity(config: Config, seed: int) -> dict[str, Any]:
    """Return plain values that tell a run from others."""
    return {"config": to_plain(config), "seed": seed}


def open_metrics(folder: Path, mark: Mapping[str, Any] | None = None) -> files.Log:
    """Begin `metrics.csv`, a row a timestep with first column `timestep`, or cut it back to a mark."""
    log = files.Log(folder / METRICS, mark)
    if not mark:
        log.append((",".join(_COLUMNS) + "\n").encode())
    return log


def append_metrics(log: files.Log, metrics: Metrics, first: int) -> None:
    """Append the rows of the timesteps from `first` on."""
    rows = io.StringIO(newline="")
    columns = [np.asarray(x) for x in metrics]
    csv.writer(rows, lineterminator="\n").writerows((t, *row) for t, row in enumerate(zip(*columns, strict=True), first))
    log.append(rows.getvalue().encode())


def write_policy(folder: Path, learner: PolicyState) -> None:
    """Write `policy.msgpack`: the ensemble's parameters [E, ...] and the normalizer, by flax's serialization."""
    files.write(folder / POLICY, serialization.to_bytes(_policy(learner)))


def _policy(learner: PolicyState) -> dict[str, Any]:
    return {"params": learner.params, "normalizer": learner.normalizer}


@contextlib.contextmanager
def _blame(path: Path) -> Iterator[None]:
    """Name the file in the ValueError for content that cannot be used."""
    try:
        yield
    except FileNotFoundError:
        raise ValueError(f"{path} is missing: not the folder of a finished run") from None
    except RecursionError:
        raise ValueError(f"{path} is damaged: nested too deeply") from None
    except (ValueError, TypeError, KeyError, AttributeError, OverflowError, csv.Error) as error:
        raise ValueError(f"{path} cannot be used: {error}") from None


def read_run(folder: Path) -> Run:
    """Read and check the configuration of a run folder.

    Raises:
        ValueError: if it is damaged, or not a run folder of this version; the message has the file and the reason.
    """
    if not folder.is_dir():
        raise ValueError(f"{folder} is not a run folder: {'it is a file' if folder.exists() else 'there is none'}")
    with _blame(folder / CONFIG):
        content = json.loads((folder / CONFIG).read_bytes())
        _expect(isinstance(content, dict) and isinstance(content.get("config"), dict), "it is not fleetjax's")
        _expect(_OWN_DIGEST in content, "it has no SHA-256 of its own (another version of fleetjax?)")
        _expect(
            content[_OWN_DIGEST] == with_digest(content)[_OWN_DIGEST], "it was edited or is damaged; its SHA-256 is another"
        )
        seed, digests = content.get("seed"), content.get("sha256")
        if not isinstance(seed, int) or not 0 <= seed < 2**32:
            raise ValueError(f"seed = {seed!r} must be a whole number")
        if not isinstance(digests, dict) or not digests.keys() <= set(DATA):
            raise ValueError("the SHA-256 of the data files are missing, or are those of others")
        logged, ran_under = content.get("log_interventions") is True, _versions_from(content.get("versions"))
        return Run(folder, _from_plain(content["config"]), seed, logged, digests, ran_under)


def read_finished(run: Run) -> Metrics | None:
    """Read the metrics of a run that has all its timesteps; None if it has not.

    Raises:
        ValueError: if anything that such a run leaves is missing or damaged.
    """
    if METRICS not in run.digests:
        return None
    try:
        metrics = read_metrics(run)
        if len(metrics.successes) < run.config.num_steps:
            return None
        for name in run.digests:
            with _blame(run.folder / name):
                _read_data(run, name)
        if get_algorithm(run.config.algorithm).pretrains:
            read_policy(run)
        if run.logged:
            read_interventions(run)
    except ValueError as error:
        raise ValueError(f"{error}; repeat the run with --overwrite") from None
    return metrics


def _from_plain(fields: Mapping[str, Any]) -> Config:
    known = all_fields(fields.get("algorithm", ""))
    for problem, names in (("unknown", set(fields) - set(known)), ("missing", set(known) - set(fields))):
        _expect(not names, f"{problem} fields: {', '.join(sorted(names))} (another version of fleetjax?)")
    for name, value in fields.items():
        _expect(_fits(value, known[name].kind), f"{name} = {value!r} must be of type {known[name].kind.__name__}")
    config = Config().replace(**{**fields, "human_capacity": 0})
    if fields["human_capacity"] not in (0, config.human_capacity):  # it was asked for, and does not follow from the others
        config = config.replace(human_capacity=fields["human_capacity"])
    validate(config)
    return config


def _versions_from(entries: Any) -> tuple[Mapping[str, Any], ...]:
    """Return the versions that a run ran under.

    Raises:
        ValueError: if they are not such a list, in order from t = 0 on.
    """
    kinds = {"timestep": int, **dict.fromkeys(versions(), str)}
    sound = isinstance(entries, list) and all(isinstance(entry, dict) and entry.keys() == kinds.keys() for entry in entries)
    if sound and all(_fits(entry[name], kind) for entry in entries for name, kind in kinds.items()):
        timesteps = [entry["timestep"] for entry in entries]
        if timesteps[:1] == [0] and timesteps == sorted(set(timesteps)):
            return tuple(entries)
    raise ValueError("its versions are not a list of those that it ran under, from t = 0 on")


def _expect(holds: bool, otherwise: str) -> None:
    if not holds:
        raise ValueError(otherwise)


def _is_int(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and abs(value) <= _LARGEST


def _fits(value: Any, kind: type) -> bool:
    if kind is tuple:
        return isinstance(value, list) and all(map(_is_int, value))
    if kind is float:
        return _is_int(value) or (isinstance(value, float) and math.isfinite(value))
    return _is_int(value) if kind is int else isinstance(value, kind)


def _read_data(run: Run, name: str) -> bytes:
    """Return the content of a data file that is as it was written."""
    data = (run.folder / name).read_bytes()
    if METRICS in run.digests:
        _expect(name in run.digests, "its SHA-256 is not in config.json, so it may be another run's")
    _expect(name in run.digests, f"the run is not finished; go on with it: fleetjax run --resume {run.folder}")
    _expect(run.digests.get(name) == files.digest(data), "its SHA-256 is not that in config.json, so it is damaged")
    return data


def read_metrics(run: Run) -> Metrics:
    """Read the Metrics[T] of a run, as numpy arrays; fewer than `num_steps` rows if it was interrupted.

    Raises:
        ValueError: if the file is missing, damaged or not a run's.
    """
    with _blame(run.folder / METRICS):
        return parse_metrics(_read_data(run, METRICS), run.config.num_steps)


def parse_metrics(data: bytes, num_steps: int) -> Metrics:
    """Return the Metrics[T] in the content of `metrics.csv`, as numpy arrays.

    Raises:
        ValueError: if it is not a run's of at most `num_steps` timesteps.
    """
    _expect(bool(data), "it is empty")
    head, *rows = csv.reader(io.StringIO(data.decode()))
    _expect(head == list(_COLUMNS), "its columns are not those of this version of fleetjax")
    _expect(0 < len(rows) <= num_steps, f"{len(rows)} rows for {num_steps} timesteps")
    _expect(all(row[:1] == [str(t)] for t, row in enumerate(rows)), "timesteps are missing")
    columns = zip(Metrics._fields, list(zip(*rows, strict=True))[1:], strict=True)
    return Metrics._make(np.array(x, np.float32 if name in REALS else np.int32) for name, x in columns)


def read_interventions(run: Run) -> list[np.ndarray]:
    """Read the interventions of a run, see `interventions.split`.

    Raises:
        ValueError: if they were not logged, or the file is missing or damaged.
    """
    if not run.logged:
        raise ValueError(f"{run.folder} has no log of interventions; run with --log-interventions")
    with _blame(run.folder / interventions.FILE):
        spec = envs.make(run.config.environment, run.config.backend).spec
        return interventions.split(interventions.parse(_read_data(run, interventions.FILE), spec))


def read_policy(run: Run) -> PolicyState:
    """Read the trained policy of a run.

    Raises:
        ValueError: if the file is missing, damaged or does not fit the configuration.
    """
    with _blame(run.folder / POLICY):
        shapes = state_shapes(run.config, envs.make(run.config.environment, run.config.backend)).learner
        template = jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), shapes)
        stored = serialization.from_bytes(_policy(template), _read_data(run, POLICY))
        wanted, found = jax.tree.leaves(_policy(template)), jax.tree.leaves(stored)
        pairs = zip(wanted, found, strict=True)
        same = all(isinstance(b, np.ndarray) and (a.shape, a.dtype) == (b.shape, b.dtype) for a, b in pairs)
        _expect(same, "its arrays do not have the shapes that config.json asks for")
        _expect(all(np.all(np.isfinite(x)) for x in found), "it holds numbers that are not finite")
        return jax.tree.map(jnp.asarray, template._replace(**stored))
