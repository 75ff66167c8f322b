"""The command line: `fleetjax run`, `sweep`, `calibrate`, `list`, `plot`, `compare`, `evaluate`, `export`, `render`, and so on.

What cannot be used is refused with one line on stderr and exit code 2, before anything is computed.
"""

import io
import os
import sys
from collections.abc import Sequence

from fleetjax.io import files, flags
from fleetjax.io.errors import Disagreement, Diverged, Incomplete, Refusal

INTERRUPTED = 130  # what shells report for a process that SIGINT ended


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        argv: arguments; None takes the process's, which Ctrl-C then ends at once.

    Returns:
        int: exit code: 0, 1 for a run that diverged, a replay that differs or a sweep with runs that failed, 2 for input that
            cannot be used, 130 after Ctrl-C.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # a name may hold characters that its encoding lacks
    try:
        arguments = flags.parse(sys.argv[1:] if argv is None else argv)
        from fleetjax.io import commands  # imported on demand: JAX takes a second to load, and help needs none of it

        commands.COMMANDS[arguments.command](arguments)
    except (Refusal, OSError) as error:
        return _end(files.one_line(error), 2)
    except (Diverged, Disagreement, Incomplete) as error:
        return _end(str(error), 1)
    except KeyboardInterrupt as interrupt:
        code = _end(" ".join(["interrupted", *interrupt.args]), INTERRUPTED)
        if argv is None:  # a computation that still runs would hold the process until it ends
            sys.stdout.flush()
            os._exit(code)
        return code
    return 0


def _end(message: str, code: int) -> int:
    print(f"fleetjax: {message}", file=sys.stderr, flush=True)
    return code
