"""The folder of a run: configuration, per-timestep metrics, figure and trained policy.

`config.json` is written when a run starts, and again at the end, with the SHA-256 digests of the data files. It always holds
the digest of its own content. What does not match is refused. Nothing that is read is executed; but the module of an
algorithm such as `my_rules:mine` is imported.
"""

import contextlib
import csv
import itertools
import json
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
from fleetjax.config import Config
from fleetjax.io import checkpoint, files, formats, interventions, metrics_csv, plain, text
from fleetjax.io.files import expect
from fleetjax.learning.imitation import PolicyState
from fleetjax.metrics import Metrics
from fleetjax.priority import get_algorithm
from fleetjax.version import VERSION

CONFIG, FIGURE, POLICY, EVALUATION = "config.json", "figure.png", "policy.msgpack", "evaluation.json"
METRICS = metrics_csv.FILE
RECORD = "console.bin"  # what people did, where they supervised the run
DATA = (METRICS, POLICY, interventions.FILE, RECORD)
_OWN_DIGEST = "sha256_config"


class Run(NamedTuple):
    """What a run folder holds.

    Attributes:
        folder: where it is.
        config: the configuration.
        seed: the seed of its key.
        logged: whether interventions are logged.
        digests: SHA-256 by file name.
        versions: what it ran under, in order, each with the `timestep` at which it began; empty before the run starts.
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
    path = Path("runs") / text.as_path(name)
    others = (path.with_name(f"{path.name}-{i}") for i in itertools.count(2))
    return next(p for p in itertools.chain([path], others) if not p.exists())


def check_config(config: Config) -> None:
    """Check that a run folder can hold the metrics of such a run.

    Raises:
        ValueError: if they are not counts.
    """
    if config.allocation == "soft":
        raise ValueError("allocation = 'soft' is for derivatives in Python, and has no run folders; use allocation = 'hard'")


def is_run(path: Path) -> bool:
    """Return whether a folder holds a run, even a damaged one."""
    return (path / CONFIG).exists()


def check_folder(path: Path, *, overwrite: bool) -> None:
    """Check that a run can be written to a folder without loss of anything but an older run.

    Raises:
        FileExistsError: if something is there that is neither an empty folder nor, with `overwrite`, a run.
    """
    if files.is_unused(path):
        return
    if not is_run(path):
        raise FileExistsError(f"{path} already exists and is not a run folder; choose another --output")
    if not overwrite:
        raise FileExistsError(f"{path} already exists; choose another --output, or pass --overwrite")
    for name in formats.PLACES.values():
        if (path / name).exists():
            raise FileExistsError(f"{path} holds {name}, exported from its run; move or delete it, or choose another --output")


def prepare(run: Run) -> bool:
    """Write the configuration of a new run, unless the folder holds a run, which stays until `create`.

    Returns:
        bool: whether the folder held no run.
    """
    new = not is_run(run.folder)
    if new:
        write_config(run, sealed=False)
    return new


def create(run: Run) -> None:
    """Write the configuration of a new run; an older run in the folder is deleted."""
    checkpoint.clear(run.folder)
    write_config(run, sealed=False)  # first: if killed in between, this run can be resumed, at t = 0
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
    """Return a run as it resumes at a timestep: with today's versions from there on, if they differ from those before."""
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


def identity(config: Config, seed: int) -> dict[str, Any]:
    """Return plain values that tell a run from others."""
    return {"config": plain.to_plain(config), "seed": seed}


def name_of(run: Any) -> str:
    """Return what tells a run from others, be it a `Run` or an `Outcome`, as text."""
    return repr(identity(run.config, run.seed))


def first_difference(asked: Run, found: Run) -> str:
    """Return how the first setting that differs differs: "num_steps = 300, but the run has 120"; "" if none does."""
    runs = (asked, found)
    wanted, has = (plain.to_plain(x.config) | {"seed": x.seed, "log_interventions": x.logged} for x in runs)
    return next((f"{name} = {value}, but the run has {has[name]}" for name, value in wanted.items() if value != has[name]), "")


def write_policy(folder: Path, policy: PolicyState) -> None:
    """Write `policy.msgpack`: the ensemble's parameters [E, ...] and the normalizer, by flax's serialization."""
    files.write(folder / POLICY, serialization.to_bytes(_stored(policy)))


def _stored(policy: PolicyState) -> dict[str, Any]:
    return {"params": policy.params, "normalizer": policy.normalizer}


@contextlib.contextmanager
def _blame(path: Path) -> Iterator[None]:
    """Name the file in the ValueError for content that cannot be used."""
    try:
        yield
    except FileNotFoundError:
        reason = "this is not a run folder" if path.name == CONFIG else "the run did not finish"
        raise ValueError(f"{path} is missing, so {reason}") from None
    except RecursionError:
        raise ValueError(f"{path} is damaged: it is nested too deeply") from None
    except (ValueError, TypeError, KeyError, AttributeError, OverflowError, csv.Error) as error:
        raise ValueError(f"{path} cannot be used: {error}") from None


def read_run(folder: Path) -> Run:
    """Read and check the configuration of a run folder.

    Raises:
        ValueError: if it is damaged, or not a run folder of this version; the message has the file and the reason.
    """
    if not folder.is_dir():
        raise ValueError(f"{folder} is not a run folder: {'it is a file' if folder.exists() else 'it does not exist'}")
    with _blame(folder / CONFIG):
        content = json.loads((folder / CONFIG).read_bytes())
        expect(isinstance(content, dict) and isinstance(content.get("config"), dict), "it was not written by fleetjax")
        expect(_OWN_DIGEST in content, "it has no SHA-256 digest of its own (another version of fleetjax?)")
        expect(
            content[_OWN_DIGEST] == with_digest(content)[_OWN_DIGEST],
            "it was edited or is damaged: its SHA-256 digest does not match",
        )
        seed, digests = content.get("seed"), content.get("sha256")
        if not isinstance(seed, int) or not 0 <= seed < 2**32:
            raise ValueError(f"seed = {seed!r} must be a whole number")
        if not isinstance(digests, dict) or not digests.keys() <= set(DATA):
            raise ValueError("the SHA-256 digests of the data files are missing, or name other files")
        logged, ran_under = content.get("log_interventions") is True, _versions_from(content.get("versions"))
        return Run(folder, plain.from_plain(content["config"]), seed, logged, digests, ran_under)


def read_finished(run: Run) -> Metrics | None:
    """Read the metrics of a finished run; None if timesteps are missing.

    Raises:
        ValueError: if one of its files is missing or damaged.
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
        raise ValueError(f"{error}; delete the folder, or {from_the_start(run)}") from None
    return metrics


def from_the_start(run: Run) -> str:
    """Return the remedy for a run that can neither be resumed nor used."""
    return f"run it from the start: fleetjax run {run.config.environment} ... --output {run.folder} --overwrite"


def _versions_from(entries: Any) -> tuple[Mapping[str, Any], ...]:
    """Return the versions that a run ran under.

    Raises:
        ValueError: if they are not such a list, in order from t = 0 on.
    """
    kinds = {"timestep": int, **dict.fromkeys(versions(), str)}
    sound = isinstance(entries, list) and all(isinstance(entry, dict) and entry.keys() == kinds.keys() for entry in entries)
    if sound and all(plain.fits(entry[name], kind) for entry in entries for name, kind in kinds.items()):
        timesteps = [entry["timestep"] for entry in entries]
        if timesteps[:1] == [0] and timesteps == sorted(set(timesteps)):
            return tuple(entries)
    raise ValueError("its versions are not a list of entries in order from t = 0")


def _read_data(run: Run, name: str) -> bytes:
    """Return the content of a data file, checked against its digest."""
    data = (run.folder / name).read_bytes()
    if METRICS in run.digests:
        expect(name in run.digests, "its SHA-256 digest is not in config.json, so it may belong to another run")
    expect(name in run.digests, f"the run is not finished; resume it with: fleetjax run --resume {run.folder}")
    expect(run.digests.get(name) == files.digest(data), "its SHA-256 digest does not match config.json, so it is damaged")
    return data


def read_metrics(run: Run) -> Metrics:
    """Read the Metrics[T] of a run, as numpy arrays; fewer than `num_steps` rows if it was interrupted.

    Raises:
        ValueError: if the file is missing, damaged or not a run's.
    """
    with _blame(run.folder / METRICS):
        return metrics_csv.parse(_read_data(run, METRICS), run.config.num_steps)


def read_interventions(run: Run) -> list[np.ndarray]:
    """Read the interventions of a run, see `interventions.split`.

    Raises:
        ValueError: if they were not logged, or the file is missing or damaged.
    """
    if not run.logged:
        raise ValueError(f"{run.folder} has no log of interventions; repeat the run with --log-interventions")
    with _blame(run.folder / interventions.FILE):
        spec = envs.make(run.config.environment, run.config.backend).spec
        return interventions.split(interventions.parse(_read_data(run, interventions.FILE), spec))


def read_policy(run: Run) -> PolicyState:
    """Read the trained policy of a run.

    Raises:
        ValueError: if the file is missing, damaged or does not fit the configuration.
    """
    with _blame(run.folder / POLICY):
        shapes = state_shapes(run.config, envs.make(run.config.environment, run.config.backend)).policy
        template = jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), shapes)
        stored = serialization.from_bytes(_stored(template), _read_data(run, POLICY))
        wanted, found = jax.tree.leaves(_stored(template)), jax.tree.leaves(stored)
        pairs = zip(wanted, found, strict=True)
        same = all(isinstance(b, np.ndarray) and (a.shape, a.dtype) == (b.shape, b.dtype) for a, b in pairs)
        expect(same, "its arrays do not have the shapes that follow from config.json")
        expect(all(np.all(np.isfinite(x)) for x in found), "it holds numbers that are not finite")
        return jax.tree.map(jnp.asarray, template._replace(**stored))
