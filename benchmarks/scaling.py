"""Time a timestep as the fleet, its humans, its memory and the number of seeds grow.

    python benchmarks/scaling.py [robots|humans|capacity|seeds ...] [--largest-mjx 100] [--largest-navigation 1000000]

Each table's last column is a ratio within it. Nothing is pre-trained: a timestep costs the same.
"""

import argparse
from typing import Any

import jax
from common import REGISTERED, add_names, median_seconds, quick_config, step_milliseconds, table

import fleetjax


def robots(largest_mjx: int, largest_navigation: int) -> None:
    """N = 10 to 10 000 on each robot (native and mjx), to 1 000 000 on navigation; M = N / 10."""
    cases = [(name, "native", n) for name in REGISTERED for n in (10, 100, 1000, 10_000)]
    cases += [(name, "mjx", n) for name in REGISTERED for n in (10, 100, 1000, 10_000) if n <= largest_mjx]
    cases += [("navigation", "native", 10**k) for k in range(1, 7) if 10**k <= largest_navigation]
    rows = []
    for environment, backend, n in cases:
        room: dict[str, Any] = {"critic_capacity": max(250_000, n), "num_steps": 10}
        config = quick_config(environment, num_robots=n, num_humans=max(1, n // 10), backend=backend, **room)
        time = step_milliseconds(config, num_steps=10)
        name = environment if environment == "navigation" else f"{environment} ({backend})"
        rows.append({"environment": name, "N": n, "ms a timestep": f"{time:.2f}", "us a robot-step": f"{1e3 * time / n:.2f}"})
        print(table(rows[-1:]) if len(rows) == 1 else table(rows).splitlines()[-1], flush=True)


def humans() -> None:
    """M = 1 to N / 2 on navigation with N = 1000."""
    times = {
        m: step_milliseconds(quick_config("navigation", num_robots=1000, num_humans=m, num_steps=50)) for m in (1, 10, 100, 500)
    }
    print(
        table(
            [
                {"N": 1000, "M": m, "ms a timestep": f"{t:.2f}", "ratio to M = 1": f"{t / times[1]:.2f}"}
                for m, t in times.items()
            ]
        )
    )


def capacity() -> None:
    """Human and critic buffers of 1 and 10 times their default size, Humanoid, N = 100."""
    default = quick_config("humanoid", num_steps=10_000)
    rows, first = [], 0.0
    for factor in (1, 10):
        sizes = {"human_capacity": factor * default.human_capacity, "critic_capacity": factor * default.critic_capacity}
        time = step_milliseconds(default.replace(**sizes))
        first = first or time
        rows.append({"capacity": f"x{factor}", "ms a timestep": f"{time:.2f}", "ratio": f"{time / first:.2f}"})
    print(table(rows))


def seeds() -> None:
    """1 to 8 seeds side by side by `vmap`, against one after the other."""
    rows = []
    for environment, num_steps in (("navigation", 100), ("humanoid", 20)):
        config = quick_config(environment, num_steps=10_000 if environment == "humanoid" else 2000, critic_capacity=20_000)
        states = [jax.jit(fleetjax.prepare)(config, jax.random.key(i)) for i in range(8)]
        part = config.replace(num_steps=num_steps)
        one = jax.jit(lambda key, state, part=part: fleetjax.run(part, key, state).metrics)
        alone = median_seconds(one, jax.random.key(0), states[0], repeats=3)
        for n in (1, 2, 4, 8):
            keys = jax.random.split(jax.random.key(0), n)
            stacked = jax.tree.map(lambda *x: jax.numpy.stack(x), *states[:n])
            together = median_seconds(jax.jit(jax.vmap(one)), keys, stacked, repeats=3)
            ratio = f"{together / (n * alone):.2f}"
            rows.append({"environment": environment, "seeds": n, "s together": f"{together:.2f}", "ratio to one by one": ratio})
    print(table(rows))


def main() -> None:
    """Run the parts that are asked for."""
    parts = {"robots": robots, "humans": humans, "capacity": capacity, "seeds": seeds}
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_names(parser, "parts", parts)
    parser.add_argument("--largest-mjx", type=int, default=100, help="largest fleet on mjx (10 000 wants a GPU)")
    parser.add_argument("--largest-navigation", type=int, default=1_000_000)
    args = parser.parse_args()
    for name in args.parts:
        print(f"\n{name}: {parts[name].__doc__}")
        parts[name](*((args.largest_mjx, args.largest_navigation) if name == "robots" else ()))


if __name__ == "__main__":
    main()
