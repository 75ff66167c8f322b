"""Time a cold start to the first timestep at the paper's scale, and the peak memory of a run, in fresh processes.

python benchmarks/startup.py [--run-steps 200]
"""

import argparse
import json
import subprocess
import sys

from common import table

CHILD = """
import time; begin = time.perf_counter()
import json, resource, sys
import jax, fleetjax
imported = time.perf_counter()
config = fleetjax.make_config(sys.argv[1], "cur")
key = jax.random.key(0)
prepare = jax.jit(fleetjax.prepare).lower(config, key).compile()
one = jax.jit(fleetjax.run, donate_argnums=2)
state_shape = jax.eval_shape(fleetjax.prepare, config, key)
first = one.lower(config.replace(num_steps=1), key, state_shape).compile()
compiled = time.perf_counter()
state = jax.block_until_ready(prepare(config, key))
prepared = time.perf_counter()
state = jax.block_until_ready(first(config.replace(num_steps=1), key, state)).state
ready = time.perf_counter()
jax.block_until_ready(one(config.replace(num_steps=int(sys.argv[2])), key, state))
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
print(json.dumps({"environment": sys.argv[1], "import s": imported - begin, "compile s": compiled - imported,
    "pre-train s": prepared - compiled, "first timestep s": ready - begin, "peak GiB": peak}))
"""


def main() -> None:
    """Print one row an environment."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run-steps", type=int, default=200, help="timesteps to run before reading the peak memory")
    args = parser.parse_args()
    rows = []
    for environment in ("navigation", "humanoid"):
        command = [sys.executable, "-c", CHILD, environment, str(args.run_steps)]
        output = subprocess.run(command, check=True, capture_output=True, text=True).stdout
        row = json.loads(output.strip().splitlines()[-1])
        rows.append({key: value if isinstance(value, str) else f"{value:.2f}" for key, value in row.items()})
    print(table(rows))


if __name__ == "__main__":
    main()
