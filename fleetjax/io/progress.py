"""Progress on the screen: of a run, with its rate and live counts, and of many runs."""

import contextlib
import os
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

from tqdm import tqdm

from fleetjax.config import Config
from fleetjax.io import text
from fleetjax.metrics import Metrics

LINES = 10  # that a log gets, where there is no terminal


def say(message: str) -> None:
    """Print a line on stderr, at once."""
    print(message, file=sys.stderr, flush=True)


@contextlib.contextmanager
def progress(config: Config, before: Metrics | None = None, *, with_rohe: bool = True) -> Iterator[Callable[[Metrics], None]]:
    """Yield a function that takes the Metrics[C] of each chunk of timesteps and shows how the run stands.

    A terminal gets a bar and a line that are redrawn, anything else a line every tenth of the run.

    Args:
        config: configuration of the run.
        before: Metrics[t] of the timesteps that were run already.
        with_rohe: whether the return on human effort is among the counts.
    """
    done = len(before.successes) if before else 0
    total = dict.fromkeys(Metrics._fields, 0.0) | (text.add_up(before) if before else {})

    def counts(chunk: Metrics) -> str:
        total.update({name: total[name] + more for name, more in text.add_up(chunk).items()})
        parts = [f"{text.count(total['successes'])} successes", f"{text.count(total['violations'])} violations"]
        parts += [f"{chunk.human_steps[-1]} humans busy", f"{chunk.idle[-1]} idle"]
        return ", ".join(parts + [f"ROHE {text.rohe_of(total, config):.3f}"] * with_rohe)

    if not _is_screen():
        yield _log(config.num_steps, done, counts)
        return
    form = "{percentage:3.0f}% |{bar}| {rate_noinv_fmt}, {remaining} left"
    options: dict[str, Any] = {"dynamic_ncols": True, "file": sys.stderr}
    with (
        tqdm(total=config.num_steps, initial=done, unit=" steps", bar_format=form, **options) as bar,
        tqdm(bar_format="  {desc}", position=1, **options) as line,
    ):

        def redraw(chunk: Metrics) -> None:
            line.set_description_str(counts(chunk))
            bar.update(len(chunk.successes))

        yield redraw


@contextlib.contextmanager
def progress_of_many(num_runs: int, num_steps: int, done: int) -> Iterator[Callable[..., None]]:
    """Yield `(ended, timesteps, news="", failed=False)`, which shows how many runs have ended, and tells news of one.

    A terminal gets a bar that is redrawn, and news of failures above it; anything else gets all news, a line each.

    Args:
        num_runs: how many there are.
        num_steps: timesteps of all of them.
        done: how many of those were run already.
    """
    begun = time.monotonic()

    def write(ended: int, timesteps: int, news: str = "", failed: bool = False) -> None:
        del failed
        rate = (timesteps - done) / max(time.monotonic() - begun, 1e-9)
        left = f", {text.duration((num_steps - timesteps) / rate)} left" if rate > 0 else ""
        if news:
            say(f"{ended} of {num_runs} runs{left}: {news}")

    if not _is_screen():
        yield write
        return
    form = "{percentage:3.0f}% |{bar}| {desc}, {remaining} left"
    options: dict[str, Any] = {"dynamic_ncols": True, "file": sys.stderr, "bar_format": form, "smoothing": 0}
    with tqdm(total=num_steps, initial=done, **options) as bar:

        def redraw(ended: int, timesteps: int, news: str = "", failed: bool = False) -> None:
            if failed:
                bar.write(news, file=sys.stderr)
            bar.set_description_str(f"{ended} of {num_runs} runs", refresh=False)
            bar.update(timesteps - bar.n)
            bar.refresh()

        yield redraw


def _is_screen() -> bool:
    """Return whether stderr is a terminal on which lines can be redrawn."""
    try:
        return os.get_terminal_size(sys.stderr.fileno()).lines > 2
    except (OSError, ValueError):  # a file, a pipe, or no file at all
        return False


def _log(num_steps: int, first: int, counts: Callable[[Metrics], str]) -> Callable[[Metrics], None]:
    """Return a function that prints a line each time that another tenth of the timesteps is done."""
    begun, done = time.monotonic(), first

    def write(chunk: Metrics) -> None:
        nonlocal done
        before, done = done, done + len(chunk.successes)
        shown = counts(chunk)
        if done * LINES // num_steps > before * LINES // num_steps:
            rate = (done - first) / max(time.monotonic() - begun, 1e-9)
            left = text.duration((num_steps - done) / rate)
            say(f"{100 * done // num_steps:3}% {rate:.1f} steps/s, {left} left, {shown}")

    return write
