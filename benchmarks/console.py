"""Measures how many timesteps a second a console takes while pages are open on it.

    python benchmarks/console.py
    python benchmarks/console.py --pages 2 20 200 --ticks 300

Two pages are people's, who drive all the time; the others watch the fleet. Timesteps follow each other as fast as they go. The
pages are WebSocket clients of a process of their own, which reads all that it is sent.
"""

import argparse
import asyncio
import contextlib
import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from common import quick_config, table
from websockets.asyncio.client import connect

from fleetjax.console import server
from fleetjax.console.session import Session
from fleetjax.io import folder
from fleetjax.metrics import Metrics

PEOPLE = 2


async def operate(port: int) -> None:
    """Be a person who drives up, and resets whatever is stuck."""
    async with connect(f"ws://127.0.0.1:{port}/ws/operator", origin=f"http://127.0.0.1:{port}", compression=None) as page:  # pyright: ignore[reportArgumentType]
        await page.send(json.dumps({"type": "claim", "key": "", "seat": -1}))
        async for text in page:
            state = json.loads(text)
            known = {name: state[name] for name in ("robot", "since", "tick") if name in state}
            if state.get("mode") == "drive":
                await page.send(json.dumps({"type": "act", **known, "held": ["up"]}))
            elif state.get("mode") == "reset":
                known.pop("tick")
                await page.send(json.dumps({"type": "reset", **known}))
            else:
                await page.send(json.dumps({"type": "seen"}))


async def watch(port: int) -> None:
    """Be a page that watches the fleet."""
    async with connect(f"ws://127.0.0.1:{port}/ws/fleet", origin=f"http://127.0.0.1:{port}", compression=None) as page:  # pyright: ignore[reportArgumentType]
        print("open", flush=True)
        async for _ in page:
            pass


async def open_pages(port: int, number: int) -> None:
    """Open pages until the console closes them."""
    people = min(PEOPLE, number)
    watching = asyncio.gather(*(watch(port) for _ in range(number - people)))
    await asyncio.gather(watching, *(operate(port) for _ in range(people)))


@contextlib.contextmanager
def pages(port: int, number: int) -> Iterator[None]:
    """Open pages in another process."""
    process = subprocess.Popen([sys.executable, __file__, "--open", str(port), str(number)], stdout=subprocess.PIPE)
    try:
        assert process.stdout is not None
        for _ in range(number - min(PEOPLE, number)):
            process.stdout.readline()
        yield
    finally:
        process.terminate()
        process.wait()


async def measure(session: Session, listener, options: server.Options, numbers: list[int], ticks: int) -> list[dict[str, str]]:
    """Return a row for each number of pages."""
    console = server.Console(session, options)
    moments: list[float] = []

    def show(metrics: Metrics) -> None:
        del metrics
        moments.append(time.perf_counter())

    running = asyncio.create_task(console.run(listener, ready=lambda: None, show=show))
    rows = []
    for number in numbers:
        with contextlib.ExitStack() as opened:
            await asyncio.to_thread(opened.enter_context, pages(listener.getsockname()[1], number))
            while len(console.clients) < number:
                await asyncio.sleep(0.1)
            begun = len(moments) + ticks // 10
            while len(moments) < begun + ticks:
                await asyncio.sleep(0.05)
            spans = [b - a for a, b in zip(moments[begun:-1], moments[begun + 1 :], strict=True)]
        while console.clients:
            await asyncio.sleep(0.1)
        slowest = sorted(spans)[int(0.99 * len(spans))]
        rows.append(
            {
                "pages open": str(number),
                "ticks a second": f"{1 / statistics.median(spans):.0f}",
                "a tick, ms (median)": f"{1e3 * statistics.median(spans):.1f}",
                "99 % within, ms": f"{1e3 * slowest:.1f}",
            }
        )
    console.stop()
    await running
    return rows


def main() -> None:
    """Parse the command line, run a console and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pages", type=int, nargs="+", default=[2, 20, 200])
    parser.add_argument("--ticks", type=int, default=300)
    parser.add_argument("--robots", type=int, default=20)
    parser.add_argument("--open", type=int, nargs=2, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.open:
        asyncio.run(open_pages(*args.open))
        return
    config = quick_config("navigation", num_robots=args.robots, num_humans=PEOPLE, num_steps=100_000, critic_capacity=50_000)
    with tempfile.TemporaryDirectory() as temporary:
        session = Session(folder.Run(Path(temporary), config, 0))
        options = server.Options("127.0.0.1", 0, None, interval=0.0, timeout=60.0, wait=0, simulated=True)
        with contextlib.closing(session), contextlib.closing(server.listen("127.0.0.1", 0)) as listener:
            rows = asyncio.run(measure(session, listener, options, args.pages, args.ticks))
    print(f"navigation, {args.robots} robots, {PEOPLE} seats, as fast as it goes:\n")
    print(table(rows))


if __name__ == "__main__":
    main()
