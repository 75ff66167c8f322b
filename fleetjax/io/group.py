"""Runs that differ in nothing but their seed, side by side in one program, each in a folder of its own.

Such runs round differently from single ones. They write no checkpoints: a group that was stopped starts again at t = 0.
"""

import contextlib
import time
from collections.abc import Sequence

import jax
import jax.numpy as jnp

from fleetjax.io import chunks, files, folder, resumable, text
from fleetjax.io.errors import Diverged
from fleetjax.io.journal import Journal
from fleetjax.io.progress import progress, say
from fleetjax.priority import get_algorithm


def complete(runs: Sequence[folder.Run], *, checkpoint_every: int) -> list[str]:
    """Complete the runs of a group, whatever their folders hold of them; those that are finished stay as they are.

    Args:
        runs: one run, which is completed as `resumable.complete` does, or several with the same configuration.
        checkpoint_every: timesteps between the checkpoints of a single run; 0 = none.

    Returns:
        For each run "", or why it failed while the others went on.

    Raises:
        ValueError: if a folder holds another run, or a damaged one.
        BlockingIOError: if another process works on one of them.
        OSError: if something cannot be written.
        KeyboardInterrupt: if it was asked to stop.
        Exception: as `resumable.complete` does, for a single run.
    """
    if len(runs) == 1:
        resumable.complete(runs[0], checkpoint_every=checkpoint_every)
        return [""]
    with contextlib.ExitStack() as locks:
        for run in runs:
            run.folder.mkdir(parents=True, exist_ok=True)
            locks.enter_context(files.lock(run.folder))
        unfinished = [not _is_finished(run) for run in runs]
        return _run(runs, unfinished) if any(unfinished) else [""] * len(runs)


def _is_finished(run: folder.Run) -> bool:
    """Return whether the folder of a run holds all of it.

    Raises:
        ValueError: if it holds another run, or a damaged one.
    """
    if not folder.is_run(run.folder):
        folder.check_folder(run.folder, overwrite=False)
        return False
    return folder.read_finished(resumable.read_same(run)) is not None


def _run(runs: Sequence[folder.Run], unfinished: Sequence[bool]) -> list[str]:
    """Run all of a group from t = 0, and write what is unfinished: a smaller group would be another program."""
    begun, config, logged = time.monotonic(), runs[0].config, runs[0].logged
    others = ", ".join(str(run.seed) for run in runs[1:])
    say(f"{text.headline(config, runs[0].seed)}, beside seeds {others}, on the {jax.default_backend().upper()} ...")
    for run in runs:
        folder.prepare(run)
    keys = jnp.stack([jax.random.key(run.seed) for run in runs])
    length, total = chunks.chunk_length(config.num_steps), config.num_steps
    state = chunks.start(config, keys, length, logged=logged)
    say(f"ready after {text.duration(time.monotonic() - begun)}; the counts below are those of seed {runs[0].seed}")
    reasons, journals = [""] * len(runs), {i: Journal(run, 0) for i, run in enumerate(runs) if unfinished[i]}
    with contextlib.ExitStack() as stack:
        show = stack.enter_context(progress(config))
        asked_to_stop = stack.enter_context(resumable.stoppable())
        for i, journal in journals.items():
            journal.create(runs[i])
            stack.callback(journal.close)
        for chunk, after in chunks.run_chunks(config, keys, state, chunks.chunks_of(total, length), logged=logged):
            state = after
            show(jax.tree.map(lambda x: x[0], chunk.metrics))
            for i, journal in list(journals.items()):
                journal.append(jax.tree.map(lambda x, i=i: x[i], chunk))
                reasons[i] = _divergence(journal, runs[i])
                if reasons[i]:
                    resumable.seal(runs[i], chunks.join(journals.pop(i).metrics))
            done = max((journal.timestep for journal in journals.values()), default=total)
            if done == total:
                break
            if asked_to_stop():
                raise KeyboardInterrupt(f"at t = {done} of {total}; runs side by side start again at t = 0")
    for i, journal in journals.items():
        if get_algorithm(config.algorithm).pretrains:
            folder.write_policy(runs[i].folder, jax.tree.map(lambda x, i=i: x[i], state.policy))
        resumable.seal(runs[i], chunks.join(journal.metrics))
    return reasons


def _divergence(journal: Journal, run: folder.Run) -> str:
    """Return what diverged in the last chunk of a run, or ""."""
    try:
        resumable.check_finite(journal.metrics[-1], journal.timestep, run)
    except Diverged as error:
        return str(error)
    return ""
