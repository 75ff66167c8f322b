"""A worker of a sweep: a process with cores of its own, which takes runs from its parent and completes one after the other.

Nothing here loads JAX before the worker has its cores, since JAX starts a thread for each of them.
"""

import multiprocessing
import os
import sys
import threading
import traceback
from multiprocessing.connection import Connection
from pathlib import Path

from fleetjax.io import files


def work(parent: Connection, cores: list[int], checkpoint_every: int, logs: Path) -> None:
    """Receive runs, as `folder.Run`, until the parent closes its end; send after each "", or why it failed.

    What a run says goes to a log of its own.

    Args:
        parent: where runs come from.
        cores: that this process may use.
        checkpoint_every: timesteps between checkpoints; 0 = none.
        logs: folder of the logs.
    """
    os.sched_setaffinity(0, cores)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    while True:
        try:
            run = parent.recv()
        except EOFError:
            return
        log_to(logs / f"{run.folder.name}.log")
        from fleetjax.io import resumable

        try:
            resumable.complete(run, checkpoint_every=checkpoint_every)
            parent.send("")
        except Exception as error:
            traceback.print_exc()
            parent.send(files.one_line(error))
        except KeyboardInterrupt as interrupt:  # the parent asked for it, and needs no answer
            sys.exit(f"interrupted {' '.join(interrupt.args)}")


def _end_with_parent() -> None:
    """End this process when its parent ends, however it ends: the system then closes the pipe between them."""
    parent = multiprocessing.parent_process()
    assert parent
    parent.join()
    os._exit(1)


def log_to(path: Path) -> None:
    """Let what is printed from here on go to the end of a file, also what libraries print past Python."""
    with path.open("a") as log:
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
            os.dup2(log.fileno(), stream.fileno())
