"""Time a timestep as the fleet, its humans, its memory and the number of seeds grow.

    python benchmarks/scaling.py [robots|humans|capacity|seeds ...] [--environments humanoid ...] [--num-robots 1000]
        [--num-seeds 8] [--largest-native 10000] [--largest-mjx 100] [--largest-navigation 1000000]

The last column of each table compares its rows. Fleets are almost untrained: a timestep costs the same.
"""

import argparse
from typing import Any, NamedTuple

import jax
from common import REGISTERED, median_seconds, print_last, quick_config, step_milliseconds, table

import fleetjax
from fleetjax.io import scripts


class Sizes(NamedTuple):
    """What is measured.

    Attributes:
        environments: robots, the first of which also stands for all where one is enough.
        num_robots: N where only M grows.
        num_seeds: most seeds side by side.
        largest_native: N at which MuJoCo's robots end on native.
        largest_mjx: N at which they end on mjx.
        largest_navigation: N at which navigation ends.
    """

    environments: list[str]
    num_robots: int
    num_seeds: int
    largest_native: int
    largest_mjx: int
    largest_navigation: int


def robots(sizes: Sizes) -> None:
    """N = 10 to 10 000 on each robot (native and mjx), to 1 000 000 on navigation; M = N / 10."""
    largest = {"native": sizes.largest_native, "mjx": sizes.largest_mjx}
    names = [name for name in sizes.environments if name != "navigation"]
    cases = [(name, b, 10**k) for b, most in largest.items() for name in names for k in range(1, 5) if 10**k <= most]
    if "navigation" in sizes.environments:
        cases += [("navigation", "native", 10**k) for k in range(1, 7) if 10**k <= sizes.largest_navigation]
    rows = []
    for environment, backend, n in cases:
        room: dict[str, Any] = {"critic_capacity": max(250_000, n), "num_steps": 10}
        config = quick_config(environment, num_robots=n, num_humans=max(1, n // 10), backend=backend, **room)
        time = step_milliseconds(config, num_steps=10)
        name = environment if environment == "navigation" else f"{environment} ({backend})"
        rows.append({"environment": name, "N": n, "ms a timestep": f"{time:.2f}", "us a robot-step": f"{1e3 * time / n:.2f}"})
        print_last(rows)


def humans(sizes: Sizes) -> None:
    """M = 1 to N / 2 on navigation."""
    n = sizes.num_robots
    numbers = sorted({max(1, m) for m in (1, n // 100, n // 10, n // 2)})
    times = {m: step_milliseconds(quick_config("navigation", num_robots=n, num_humans=m, num_steps=50)) for m in numbers}
    print(
        table(
            [{"N": n, "M": m, "ms a timestep": f"{t:.2f}", "ratio to M = 1": f"{t / times[1]:.2f}"} for m, t in times.items()]
        )
    )


def capacity(sizes: Sizes) -> None:
    """Human and critic buffers of 1 and 10 times their default size, on the first of the environments, N = 100."""
    default = quick_config(sizes.environments[0], num_steps=10_000)
    rows, first = [], 0.0
    for factor in (1, 10):
        room = {"human_capacity": factor * default.human_capacity, "critic_capacity": factor * default.critic_capacity}
        time = step_milliseconds(default.replace(**room))
        first = first or time
        rows.append({"capacity": f"x{factor}", "ms a timestep": f"{time:.2f}", "ratio": f"{time / first:.2f}"})
    print(table(rows))


def seeds(sizes: Sizes) -> None:
    """Seeds side by side by `vmap`, against one after the other, on navigation and the first of the environments."""
    rows = []
    for environment in dict.fromkeys(("navigation", sizes.environments[0])):
        num_steps, total = (100, 2000) if environment == "navigation" else (20, 10_000)
        config = quick_config(environment, num_steps=total, critic_capacity=20_000)
        states = [jax.jit(fleetjax.prepare)(config, jax.random.key(i)) for i in range(sizes.num_seeds)]
        part = config.replace(num_steps=num_steps)
        one = jax.jit(lambda key, state, part=part: fleetjax.run(part, key, state).metrics)
        alone = median_seconds(one, jax.random.key(0), states[0], repeats=3)
        for n in (2**k for k in range(sizes.num_seeds.bit_length())):
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
    scripts.add_names(parser, "parts", parts)
    known = [*REGISTERED, "navigation"]
    parser.add_argument("--environments", nargs="+", choices=known, default=known, help="the first also stands for all")
    parser.add_argument("--num-robots", type=int, default=1000, help="N of the part `humans`")
    parser.add_argument("--num-seeds", type=int, default=8, help="most seeds of the part `seeds`")
    parser.add_argument("--largest-native", type=int, default=10_000, help="largest fleet on native")
    parser.add_argument("--largest-mjx", type=int, default=100, help="largest fleet on mjx (10 000 wants a GPU)")
    parser.add_argument("--largest-navigation", type=int, default=1_000_000)
    args = vars(parser.parse_args())
    for name in args.pop("parts"):
        print(f"\n{name}: {parts[name].__doc__}")
        parts[name](Sizes(**args))


if __name__ == "__main__":
    main()
