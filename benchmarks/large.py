"""Time fleets that are large, and fleets that are divided over devices, each in a fresh process.

    python benchmarks/large.py [sizes|devices ...] [--num-steps 10] [-- PARAMETERS]

- `sizes`: 1,000,000 robots of navigation and 10,000 humanoids. Bytes per robot are those of the compiled run, by how much they
  grow with the fleet, beside the formula of `fleetjax.checks.robot_bytes`; the peak memory is the whole process's.
- `devices`: 1, 2, 4 and 8 virtual devices of the CPU with as many robots each. They share the cores that there are, so
  the time of a timestep may grow with the number of robots; the ratio tells how much more it grows.

Fleets are almost untrained: a timestep costs the same. PARAMETERS are those of `fleetjax run`, for both parts.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
from typing import Any

import jax
from common import print_last, quick_config, seconds, table

import fleetjax
from fleetjax import checks, envs
from fleetjax.io import scripts

SIZES = (("navigation", 1_000_000), ("humanoid", 10_000))
DEVICES = (1, 2, 4, 8)


def bytes_per_robot(config: fleetjax.Config) -> float:
    """Return by how many bytes the memory of the compiled run grows with a robot, from this size of fleet on."""
    used = []
    for n in (config.num_robots, 2 * config.num_robots):
        larger = config.replace(num_robots=n)
        state = checks.state_shapes(larger, envs.make(config.environment, config.backend))
        run = jax.jit(fleetjax.run).lower(larger, jax.random.key(0), state).compile()
        found = run.memory_analysis()
        assert found is not None
        used.append(found.argument_size_in_bytes + found.output_size_in_bytes + found.temp_size_in_bytes)
    return (used[1] - used[0]) / config.num_robots


def measure(environment: str, num_devices: int, **given: Any) -> None:
    """Run a fleet, and print what it took as a line of JSON."""
    config = quick_config(environment, **given)
    mesh = jax.make_mesh((num_devices,), ("robots",)) if num_devices > 1 else None
    key = jax.random.key(0)
    run = jax.jit(lambda key, state: fleetjax.run(config, key, state, mesh=mesh), donate_argnums=1)
    state = run(key, jax.jit(lambda key: fleetjax.prepare(config, key, mesh=mesh))(key)).state  # compiles
    elapsed, _ = seconds(run, key, state)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(json.dumps({"ms": elapsed / config.num_steps * 1e3, "peak": peak}))


def in_fresh_process(environment: str, num_devices: int, given: dict[str, Any]) -> dict[str, float]:
    """Return what `measure` prints in a process of its own."""
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={num_devices}"
    command = [sys.executable, __file__, "measure", json.dumps([environment, num_devices, given])]
    child = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True, env=os.environ | {"XLA_FLAGS": flags})
    return json.loads(child.stdout.splitlines()[-1])


def sizes(num_steps: int, given: dict[str, Any]) -> None:
    """Large fleets on one device."""
    rows = []
    for environment, n in SIZES:
        fleet = {"num_robots": n, "num_humans": 1000, "num_steps": num_steps, "critic_capacity": max(250_000, n)} | given
        n = fleet["num_robots"]
        small = quick_config(environment, **{**fleet, "num_robots": 4000, "num_humans": 10, "critic_capacity": 250_000})
        estimate = checks.robot_bytes(small, checks.state_shapes(small, envs.make(environment, small.backend)))
        found = in_fresh_process(environment, 1, fleet)
        row = {
            "environment": environment,
            "N": f"{n:,}",
            "ms a timestep": f"{found['ms']:,.0f}",
            "us a robot-step": f"{1e3 * found['ms'] / n:.2f}",
            "bytes a robot": f"{bytes_per_robot(small):,.0f}",
            "by the formula": f"{estimate:,}",
            "peak GiB": f"{found['peak']:.2f}",
        }
        rows.append(row)
        print_last(rows)


def devices(num_steps: int, given: dict[str, Any]) -> None:
    """As many robots on each of several virtual devices."""
    rows, first = [], 0.0
    for number in DEVICES:
        fleet = {"num_robots": 1000, "num_humans": 10, "num_steps": num_steps} | given
        fleet["num_robots"] *= number
        found = in_fresh_process("navigation", number, fleet)["ms"]
        alone = in_fresh_process("navigation", 1, fleet)["ms"] if number > 1 else found
        first = first or found
        row = {
            "devices": number,
            "N": f"{fleet['num_robots']:,}",
            "ms a timestep": f"{found:.2f}",
            "ratio to one device": f"{found / first:.2f}",
            "one device with all robots, ms": f"{alone:.2f}",
        }
        rows.append(row)
    print(table(rows))


PARTS = {"sizes": sizes, "devices": devices}


def main() -> None:
    """Print a table for each part."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    scripts.add_names(parser, "parts", PARTS)
    parser.add_argument("--num-steps", type=int, default=10, help="timesteps that are timed")
    args, given = scripts.parse(parser)
    for part in args.parts:
        print(f"\n{part}: {PARTS[part].__doc__}")
        PARTS[part](args.num_steps, given)


if __name__ == "__main__":
    if sys.argv[1:2] == ["measure"]:
        environment, number, given = json.loads(sys.argv[2])
        measure(environment, number, **given)
    else:
        main()
