"""Time a cold start to the first timestep, as the command line starts, and read a run's peak memory, in fresh processes.

    python benchmarks/startup.py [--environments navigation humanoid] [--run-steps 300] [-- PARAMETERS]

What follows `--` are parameters as `fleetjax run` takes them, in place of the defaults.

Compilation is the sum over two threads: the run's program compiles while the fleet pre-trains.
"""

import argparse
import json
import subprocess
import sys

from common import table

from fleetjax.io import scripts

CHILD = """
import time; begin = time.perf_counter()
import json, resource, sys
import jax, fleetjax
from fleetjax.io import chunks
imported = time.perf_counter()
compiling = []
jax.monitoring.register_event_duration_secs_listener(
    lambda event, seconds, **_: compiling.append(seconds) if event.endswith("backend_compile_duration") else None)
config = fleetjax.make_config(sys.argv[1], "cur", **json.loads(sys.argv[3]))
key = jax.random.key(0)
length = chunks.chunk_length(config.num_steps)
state = jax.block_until_ready(chunks.start(config, key, length))
ready = time.perf_counter()
lengths = [length] * -(-int(sys.argv[2]) // length)
for _ in chunks.run_chunks(config, key, state, lengths):
    pass
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
print(json.dumps({"environment": sys.argv[1], "import s": imported - begin, "compilation s": sum(compiling),
    "first timestep after s": ready - begin, "peak GiB": peak}))
"""


def main() -> None:
    """Print one row an environment."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run-steps", type=int, default=300, help="timesteps to run before reading the peak memory")
    parser.add_argument("--environments", nargs="+", default=["navigation", "humanoid"])
    args, parameters = scripts.parse(parser)
    rows = []
    for environment in args.environments:
        command = [sys.executable, "-c", CHILD, environment, str(args.run_steps), json.dumps(parameters)]
        output = subprocess.run(command, check=True, capture_output=True, text=True).stdout
        row = json.loads(output.strip().splitlines()[-1])
        rows.append({key: value if isinstance(value, str) else f"{value:.2f}" for key, value in row.items()})
    print(table(rows))


if __name__ == "__main__":
    main()
