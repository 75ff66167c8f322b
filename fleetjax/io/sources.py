"""Where finished runs come from: run folders, folders of these, files of rows, and results in memory."""

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from fleetjax.config import Config
from fleetjax.experiment import Result
from fleetjax.io import folder, rows
from fleetjax.io.outcomes import Outcome
from fleetjax.metrics import Metrics

Source = str | Path | Outcome | tuple[Config, int | Sequence[int], Metrics | Result]


def collect(runs: str | Path | Iterable[Source]) -> list[Outcome]:
    """Return what runs came to.

    Args:
        runs: each is a run folder, a folder that holds run folders, a CSV file that `fleetjax compare --rows` wrote, or a
            configuration with a seed and its Metrics[T] or Result, or with S seeds and Metrics[S, T].

    Raises:
        ValueError: if there are none, or one is damaged; the message has its path and the reason.
    """
    sources = [runs] if isinstance(runs, str | Path) else runs
    found = [outcome for source in sources for outcome in _outcomes(source)]
    if not found:
        raise ValueError("there are no runs; name one or more run folders")
    return found


def _outcomes(source: Source) -> list[Outcome]:
    if isinstance(source, Outcome):
        return [source]
    if isinstance(source, str | Path):
        return _stored(Path(source))
    if isinstance(source, Result):
        raise ValueError("a Result alone does not say what was run; pass (config, seed, result)")
    return _computed(*source)


def _stored(path: Path) -> list[Outcome]:
    if path.suffix == rows.SUFFIX:
        return rows.read(path)
    if folder.is_run(path) or not path.is_dir():
        return [_of_folder(path)]
    found = [_of_folder(inner) for inner in sorted(path.iterdir()) if folder.is_run(inner)]
    if not found:
        raise ValueError(f"{path} is not a run folder and holds none")
    return found


def _of_folder(path: Path) -> Outcome:
    run = folder.read_run(path)
    metrics = folder.read_metrics(run)
    versions = {name: " ".join(dict.fromkeys(entry[name] for entry in run.versions)) for name in folder.versions()}
    return Outcome(run.config, run.seed, metrics, np.arange(1, len(metrics.successes) + 1), str(path), versions)


def _computed(config: Config, seed: int | Sequence[int], result: Metrics | Result) -> list[Outcome]:
    metrics = result.metrics if isinstance(result, Result) else result
    shape = np.shape(metrics.successes)
    if shape[:-1] != np.shape(seed):
        raise ValueError(f"seed = {seed!r} does not fit metrics of shape {shape}; pass a seed for each run")
    seeds, by_run = np.atleast_1d(seed), [np.atleast_2d(np.asarray(x)) for x in metrics]
    timesteps = np.arange(1, shape[-1] + 1)
    return [
        Outcome(config, int(s), Metrics(*of_run), timesteps, f"{config.environment}, {config.algorithm}, seed {s}")
        for s, *of_run in zip(seeds, *by_run, strict=True)
    ]
