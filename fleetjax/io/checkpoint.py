"""Checkpoints of a running fleet: orbax stores the arrays, and a manifest with their SHA-256 is written last and checked first.

A checkpoint is a folder named by its timestep. Without a manifest it is unfinished and never read. If the digests do not match,
it is damaged, and an older one is used. orbax itself restores flipped bits without an error.
"""

import contextlib
import json
import logging
import shutil
import sys
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from fleetjax.fleet import FleetState
from fleetjax.io import files
from fleetjax.learning.buffer import Buffer, is_buffer

FOLDER, ARRAYS, MANIFEST = "checkpoints", "arrays", "manifest.json"
KEPT = 2
Used = TypeVar("Used")


class Checkpoint(NamedTuple):
    """A checkpoint that was read.

    Attributes:
        path: where it is.
        state: the fleet.
        notes: what was noted with it.
    """

    path: Path
    state: FleetState
    notes: Mapping[str, Any]


class Writer:
    """Writes checkpoints behind a running fleet, one at a time, and keeps the last two.

    Args:
        folder: folder of the run.
        identity: plain values that distinguish this run from others.
    """

    def __init__(self, folder: Path, identity: Mapping[str, Any]):
        self.folder, self.identity = folder / FOLDER, identity
        self._worker = ThreadPoolExecutor(1)
        self._pending: Future[None] | None = None

    def write(self, state: FleetState, notes: Mapping[str, Any]) -> None:
        """Copy the state, and write it in the background once the previous one is written.

        Raises:
            OSError: if the previous one could not be written.
        """
        self.wait()
        arrays = _named(state, lambda x: np.array(jax.device_get(_plain(x))))
        self._pending = self._worker.submit(self._store, int(state.timestep), arrays, dict(notes))

    def wait(self) -> None:
        """Wait until nothing is being written.

        Raises:
            OSError: if it could not be written; older ones are unchanged.
        """
        pending, self._pending = self._pending, None
        if pending:
            pending.result()

    def _store(self, timestep: int, arrays: dict[str, np.ndarray], notes: dict[str, Any]) -> None:
        path = self.folder / f"{timestep:010}"
        try:
            shutil.rmtree(path, ignore_errors=True)
            path.mkdir(parents=True)
            _checkpointer(lambda orbax: orbax.save((path / ARRAYS).absolute(), arrays))
            _finish(path, {"timestep": timestep, **self.identity, "notes": notes})
        except Exception as error:  # orbax passes on what its storage raises, of any kind
            shutil.rmtree(path, ignore_errors=True)
            raise OSError(f"the checkpoint at t = {timestep} could not be written ({files.one_line(error)})") from error
        _prune(self.folder)


def _finish(path: Path, manifest: Mapping[str, Any]) -> None:
    files.write_json(path / MANIFEST, {**manifest, "sha256": _digests(path)})


def _prune(folder: Path) -> None:
    """Keep the last finished checkpoints."""
    found = _found(folder)
    kept = [path for path in found if (path / MANIFEST).exists()][-KEPT:]
    for other in found:
        if other not in kept:
            shutil.rmtree(other)


def write_shares(
    folder: Path,
    identity: Mapping[str, Any],
    state: FleetState,
    notes: Mapping[str, Any],
    *,
    leads: bool,
    meet: Callable[[str], None],
) -> None:
    """Write a checkpoint of a fleet on a mesh: each process its share, then the one that `leads` the manifest.

    Args:
        folder: folder of the run, on a file system that all processes share.
        identity: the run's.
        state: the fleet.
        notes: what to note with it.
        leads: whether this process leads.
        meet: waits for all processes.
    """
    path = folder / FOLDER / f"{int(state.timestep):010}"
    if leads:
        shutil.rmtree(path, ignore_errors=True)
        path.mkdir(parents=True)
    meet("a checkpoint begins")
    arrays = _named(state, _plain)
    _checkpointer(lambda orbax: orbax.save((path / ARRAYS).absolute(), arrays))
    meet("its shares are written")
    if leads:
        parts = {"parts": max((x.added.size for x in _rings(state)), default=1)}
        _finish(path, {"timestep": int(state.timestep), **identity, **parts, "notes": dict(notes)})
        _prune(folder / FOLDER)
    meet("it is finished")


def newest(
    folder: Path, identity: Mapping[str, Any], check: Callable[[int, Mapping[str, Any]], Any]
) -> tuple[Path | None, list[str]]:
    """Return the newest checkpoint whose files are intact, or None, and for each newer one the reason why it cannot be used.

    Args:
        folder: folder of the run.
        identity: the run's.
        check: raises ValueError for a timestep and notes that do not fit the run's other files.
    """

    def look(path: Path) -> Path:
        manifest = _manifest(path, identity)
        check(manifest.get("timestep", -1), manifest["notes"])
        return path

    return _first(folder, look)


def read_shares(
    path: Path, identity: Mapping[str, Any], shapes: Callable[[int], FleetState], mesh: Mesh
) -> tuple[FleetState, Mapping[str, Any]]:
    """Read a checkpoint onto a mesh, of any size: each process what its devices hold.

    Args:
        path: the checkpoint.
        identity: the run's.
        shapes: the structure of its state, by the number of parts of its rings.
        mesh: whose devices hold it.

    Returns:
        The state, whose rings have as many parts as when it was written, and the notes.
    """
    manifest = _manifest(path, identity)
    wanted = shapes(manifest.get("parts", 1))

    def struct(leaf: Any) -> jax.ShapeDtypeStruct:
        shape, dtype = _layout(leaf)
        divided = bool(shape) and shape[0] % mesh.size == 0
        spec = PartitionSpec(mesh.axis_names[0]) if divided else PartitionSpec()
        return jax.ShapeDtypeStruct(shape, dtype, sharding=NamedSharding(mesh, spec))

    return _load(path, wanted, struct, manifest), manifest["notes"]


def _rings(state: FleetState) -> list[Buffer]:
    return list(filter(is_buffer, jax.tree.leaves(state.estimators, is_leaf=is_buffer)))


def clear(folder: Path) -> None:
    """Delete the checkpoints of a run; foreign files among them stay."""
    for path in _found(folder / FOLDER):
        shutil.rmtree(path)
    with contextlib.suppress(OSError):  # there is no such folder, or it holds files of others
        (folder / FOLDER).rmdir()


def is_any_finished(folder: Path) -> bool:
    """Return whether a run has a checkpoint that was finished, even one that is damaged now."""
    return any((path / MANIFEST).exists() for path in _found(folder / FOLDER))


def parts(folder: Path) -> int:
    """Return over how many devices the fleet of the newest finished checkpoint was divided; 1 if that is not known."""
    for path in reversed(_found(folder / FOLDER)):
        with contextlib.suppress(Exception):  # it may be damaged in any way
            return int(json.loads((path / MANIFEST).read_text()).get("parts", 1))
    return 1


def _found(folder: Path) -> list[Path]:
    """Return the checkpoints in a folder, finished or not, oldest first; foreign files are ignored."""
    return sorted(path for path in folder.glob("[0-9]" * 10) if path.is_dir() and not path.is_symlink())


def restore(
    folder: Path, identity: Mapping[str, Any], shapes: FleetState, check: Callable[[Checkpoint], Any]
) -> tuple[Checkpoint | None, list[str]]:
    """Read the newest intact checkpoint of a run.

    Args:
        folder: folder of the run.
        identity: the run's.
        shapes: the structure of its state, by `jax.eval_shape`.
        check: raises ValueError for a checkpoint that does not fit the run's other files.

    Returns:
        The checkpoint, or None if there is none, and for each newer one the reason why it cannot be used.
    """

    def read(path: Path) -> Checkpoint:
        checkpoint = _read(path, identity, shapes)
        check(checkpoint)
        return checkpoint

    return _first(folder, read)


def _first(folder: Path, use: Callable[[Path], Used]) -> tuple[Used | None, list[str]]:
    """Return what `use` makes of the newest checkpoint that it takes, or None, and for each newer one why it does not."""
    refused = []
    for path in reversed(_found(folder / FOLDER)):
        try:
            return use(path), refused
        except Exception as error:  # whatever damage makes orbax raise, an older one may be intact
            refused.append(f"{path}: {files.one_line(error)}")
    return None, refused


def _read(path: Path, identity: Mapping[str, Any], shapes: FleetState) -> Checkpoint:
    """Read a checkpoint.

    Raises:
        ValueError: if it is unfinished, damaged or belongs to another run.
    """
    manifest = _manifest(path, identity)
    return Checkpoint(path, _load(path, shapes, lambda x: np.zeros(*_layout(x)), manifest), manifest["notes"])


def _load(path: Path, shapes: FleetState, target: Callable[[Any], Any], manifest: Mapping[str, Any]) -> FleetState:
    """Return the stored state, each array like `target` of its leaf.

    Raises:
        ValueError: if it does not fit the shapes or the manifest.
    """
    found = _checkpointer(lambda orbax: orbax.restore((path / ARRAYS).absolute(), _named(shapes, target)))
    names, leaves = zip(*jax.tree_util.tree_leaves_with_path(shapes), strict=True)
    arrays = [_restored(found, jax.tree_util.keystr(name), leaf) for name, leaf in zip(names, leaves, strict=True)]
    state: FleetState = jax.tree.unflatten(jax.tree.structure(shapes), arrays)
    if int(state.timestep) != manifest.get("timestep"):
        raise ValueError("its timestep does not match the manifest")
    return state


def _manifest(path: Path, identity: Mapping[str, Any]) -> dict[str, Any]:
    """Return the manifest of an intact checkpoint.

    Raises:
        ValueError: if it is unfinished, damaged or belongs to another run.
    """
    if not (path / MANIFEST).exists():
        raise ValueError("it was never finished")
    try:
        manifest = json.loads((path / MANIFEST).read_bytes())
    except (ValueError, RecursionError):
        raise ValueError(f"{MANIFEST} is damaged") from None
    if not isinstance(manifest, dict) or not isinstance(manifest.get("notes"), dict):
        raise ValueError(f"{MANIFEST} was not written by fleetjax")
    if any(manifest.get(name) != value for name, value in identity.items()):
        raise ValueError("it belongs to another run")
    if manifest.get("sha256") != _digests(path):
        raise ValueError("its SHA-256 digests do not match the manifest, so it is damaged")
    return manifest


def _checkpointer(use: Callable[[Any], Any]) -> Any:
    """Return what `use` makes of an orbax checkpointer, when it is done writing."""
    import orbax.checkpoint as ocp  # imported on demand: it takes seconds

    with _without_traces(), ocp.StandardCheckpointer() as orbax:
        result = use(orbax)
        orbax.wait_until_finished()
    return result


@contextlib.contextmanager
def _without_traces() -> Iterator[None]:
    """Keep traces off stderr that orbax, tensorstore and asyncio print from other threads, besides raising the error."""
    loggers, usual = [logging.getLogger(name) for name in ("absl", "asyncio")], sys.unraisablehook
    levels = [logger.level for logger in loggers]

    def hook(unraisable: Any) -> None:
        if str(unraisable.exc_value) != "Event loop is closed":  # of a write that failed; it may come late
            usual(unraisable)

    for logger in loggers:
        logger.setLevel(logging.CRITICAL)
    sys.unraisablehook = hook
    yield
    for logger, level in zip(loggers, levels, strict=True):
        logger.setLevel(level)  # not after a failure, whose traces are still to come
    sys.unraisablehook = usual


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _plain(leaf: jax.Array) -> jax.Array:
    """Return a leaf as an array of numbers: those of a random key."""
    return jax.random.key_data(leaf) if _is_key(leaf) else leaf


def _layout(leaf: Any) -> tuple[tuple[int, ...], Any]:
    """Return shape and type of a leaf as it is stored."""
    plain = jax.eval_shape(_plain, leaf)
    return plain.shape, plain.dtype


def _named(state: FleetState, value: Callable[[Any], Any]) -> dict[str, Any]:
    """Return the value of each leaf by its name; without empty arrays, which orbax does not take."""
    leaves = jax.tree_util.tree_leaves_with_path(state)
    return {jax.tree_util.keystr(name): value(leaf) for name, leaf in leaves if leaf.size}


def _restored(found: Mapping[str, Any], name: str, leaf: Any) -> jax.Array:
    """Return the array for a leaf.

    Raises:
        ValueError: if it does not fit.
    """
    shape, dtype = _layout(leaf)
    array = found[name] if leaf.size else np.zeros(shape, dtype)
    if (array.shape, array.dtype) != (shape, dtype):
        raise ValueError(f"{name} is {array.dtype}{list(array.shape)}, expected {dtype}{list(shape)}")
    restored = jnp.array(array) if isinstance(array, np.ndarray) else array  # a copy, whose memory a run may take over
    restored = jax.random.wrap_key_data(restored) if _is_key(leaf) else restored
    if restored.dtype != leaf.dtype:
        raise ValueError(f"{name} is {restored.dtype}, expected {leaf.dtype}")
    return restored


def _digests(path: Path) -> dict[str, str]:
    """Return the SHA-256 of every file below a checkpoint's folder but the manifest, by relative name."""
    found = sorted(file for file in path.rglob("*") if file.is_file() and file != path / MANIFEST)
    return {file.relative_to(path).as_posix(): files.digest(file.read_bytes()) for file in found}
