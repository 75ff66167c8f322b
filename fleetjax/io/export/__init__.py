"""Interventions as data sets that other libraries read: LeRobot's, robomimic's and Minari's. An intervention is an episode.

Each format has a module with `write`; `FILES`, what a folder of it holds; and `read_source`, the mark by which an older export
is known.
"""

import shutil
import tempfile
from pathlib import Path

import numpy as np

from fleetjax.config import Config
from fleetjax.envs import EnvSpec
from fleetjax.io.export import lerobot, minari, robomimic
from fleetjax.io.formats import check

_WRITERS = {"lerobot": lerobot, "robomimic": robomimic, "minari": minari}


def export(interventions: list[np.ndarray], config: Config, spec: EnvSpec, output: Path, kind: str) -> None:
    """Write interventions as a complete data set or none; an older export of the same format at `output` is replaced.

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
        _WRITERS[kind].write(interventions, config, spec, written)
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
        if path.is_symlink() or not (path.is_dir() or name in _WRITERS[kind].FILES):
            raise ValueError(f"{output} also holds {name}, which would be lost; move it, or choose another --output")


def _is_export(path: Path, kind: str) -> bool:
    """Return whether a file or folder bears the mark that exports of a format leave."""
    try:
        source = _WRITERS[kind].read_source(path)
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
