"""A session repeated from its record: the same inputs must give the same bits."""

import contextlib
import tempfile
from pathlib import Path

import jax
import numpy as np

from fleetjax import envs
from fleetjax.config import Config
from fleetjax.console import record
from fleetjax.console.engine import Engine
from fleetjax.console.session import as_chunk
from fleetjax.io import chunks, files, folder, metrics_csv, text
from fleetjax.io.errors import Disagreement
from fleetjax.io.progress import progress, say
from fleetjax.metrics import Metrics
from fleetjax.priority import get_algorithm


def read_record(run: folder.Run) -> np.ndarray:
    """Read the record of a run, and check that nothing that its replay is compared with is damaged.

    Raises:
        ValueError: if there is no record, or a file is missing or damaged.
    """
    path = run.folder / folder.RECORD
    if not path.exists():
        raise ValueError(f"{run.folder} has no {folder.RECORD}; only runs of `fleetjax console` have one")
    data = path.read_bytes()
    if folder.RECORD not in run.digests:
        raise ValueError(f"{path} cannot be used: the session was killed before its digests were stored")
    if run.digests[folder.RECORD] != files.digest(data):
        raise ValueError(f"{path} cannot be used: its SHA-256 digest does not match config.json, so it is damaged")
    metrics = folder.read_metrics(run)
    if folder.POLICY in compared(run.config):
        folder.read_policy(run)
    try:
        rows = record.parse(data, run.config, envs.make(run.config.environment, run.config.backend).spec)
    except ValueError as error:
        raise ValueError(f"{path} cannot be used: {error}") from None
    if len(rows) != len(metrics.successes):
        raise ValueError(f"{path} has {len(rows)} timesteps, but {folder.METRICS} has {len(metrics.successes)}")
    return rows


def replay(run: folder.Run, rows: np.ndarray) -> Metrics:
    """Run what was recorded again; return its Metrics[t].

    Raises:
        Disagreement: if anything differs by a bit.
    """
    config = run.config
    say(f"{text.headline(config, run.seed)}, {text.plural(len(rows), 'timestep')} recorded: compiling and preparing ...")
    engine = Engine(config, jax.random.key(run.seed), envs.make(config.environment, config.backend))
    parts = []
    with tempfile.TemporaryDirectory() as temporary, contextlib.closing(metrics_csv.open_log(Path(temporary))) as table:
        with progress(config.replace(num_steps=len(rows))) as show:
            for row in rows:
                inputs = record.inputs_of(row)
                view = engine.plan(inputs.seat)
                if not np.array_equal(view.robot, row["robot"]):
                    raise Disagreement(f"{run.folder}: at t = {view.timestep} the replay helps other robots than the record")
                parts.append(as_chunk(engine.advance(inputs)))
                metrics_csv.append(table, parts[-1], view.timestep)
                show(parts[-1])
        names = compared(config)
        if folder.POLICY in names:
            folder.write_policy(Path(temporary), engine.state.policy)
        for name in names:
            if (Path(temporary) / name).read_bytes() != (run.folder / name).read_bytes():
                raise Disagreement(f"{run.folder}: the replay gives another {name} (another machine, or other versions?)")
    return chunks.join(parts)


def compared(config: Config) -> list[str]:
    """Return the files that a replay is compared with."""
    return [folder.METRICS, *([folder.POLICY] if get_algorithm(config.algorithm).pretrains else [])]
