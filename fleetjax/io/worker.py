"""A worker of a sweep: a process which takes groups of runs from its parent and completes one after the other.

Nothing here loads JAX before the worker has taken its place.
"""

import multiprocessing
import os
import sys
import threading
import traceback
from multiprocessing.connection import Connection
from pathlib import Path

from fleetjax.io import files
from fleetjax.io.place import Place


def work(parent: Connection, place: Place, checkpoint_every: int, logs: Path) -> None:
    """Receive groups, as `study.Group`, until the parent closes its end; send for each run of a group "", or why it failed.

    What a group says goes to a log of its own, named after its first run.

    Args:
        parent: where groups come from.
        place: that this process may use.
        checkpoint_every: timesteps between checkpoints; 0 = none.
        logs: folder of the logs.
    """
    place.take()
    threading.Thread(target=_end_with_parent, daemon=True).start()
    while True:
        try:
            runs = parent.recv()
        except EOFError:
            return
        log_to(logs / f"{runs[0].folder.name}.log")
        from fleetjax.io import group

        try:
            parent.send(group.complete(runs, checkpoint_every=checkpoint_every))
        except Exception as error:
            traceback.print_exc()
            parent.send([files.one_line(error)] * len(runs))
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
