"""Time the parts of a timestep, each compiled by itself, on whichever device JAX has: what costs most?

    python benchmarks/profile_step.py [ENVIRONMENT ...] [--steps 50] [--repeats 5] [--trace FOLDER] [-- PARAMETERS]

What follows `--` are parameters as `fleetjax run` takes them: `-- --num-robots 1000 --backend mjx`. The parts need not add up
to the whole: compiled together, they share work. `--trace` also writes a profile of whole timesteps, for TensorBoard.
"""

import argparse
import statistics
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from common import seconds, table

import fleetjax
from fleetjax import fleet
from fleetjax.io import scripts
from fleetjax.keys import Keys, key_at, split_keys
from fleetjax.learning.estimator import Step
from fleetjax.learning.imitation import Pair

Part = Callable[[fleet.FleetState, jax.Array], tuple[fleet.FleetState, Any]]


def parts_of(config: fleetjax.Config) -> dict[str, Part]:
    """Return the parts of a timestep by name, each `(state, key) -> (state, what else it gives)`."""
    env = fleetjax.envs.make(config.environment, config.backend)
    parts = fleet.make_parts(config, env)

    def keys_of(key: jax.Array) -> Keys:
        return split_keys(key, config.num_robots)

    def record(state: fleet.FleetState, key: jax.Array) -> fleet.FleetState:
        moving, action = ~state.env.violation, jnp.zeros((config.num_robots, env.spec.action_size))
        steps = Step(state.env.obs, action, state.env.obs, state.env.violation, state.env.success, action, moving)
        planned = jax.eval_shape(lambda s: fleet.plan(parts, s, keys_of(key))[1], state)  # of which it reads nothing here
        taught = jnp.arange(config.num_robots) < config.num_humans
        return fleet.remember(parts, state, planned, steps, Pair(state.env.obs, action), taught, moving, keys_of(key))

    return {
        "whole": lambda state, key: fleet.logged_step(parts, state, key),
        "signals": lambda state, key: (state, fleet.observe(parts, state, keys_of(key))),
        "signals, choice": lambda state, key: (state, fleet.plan(parts, state, keys_of(key))[1]),
        "supervisor": lambda state, key: (state, fleet.supervise(parts, state.env, keys_of(key))),
        "physics": lambda state, key: (
            state,
            fleet.step_robots(
                parts,
                state.env,
                parts.learner.predict(state.policy, state.env.obs)[0],
                ~state.env.violation,
                keys_of(key),
            ),
        ),
        "resets": lambda state, key: (state, fleet.reset_robots(parts, keys_of(key).reset)),
        "data": lambda state, key: (record(state, key), ()),
        "gradient steps": lambda state, key: fleet.learn(parts, state, keys_of(key)),
    }


def repeated(part: Part, num_steps: int) -> Callable[[jax.Array, fleet.FleetState], Any]:
    """Return a program that does a part as often as given; buffers stay in place, and nothing is left out as useless."""

    def body(carry: tuple[fleet.FleetState, jax.Array], key: jax.Array) -> tuple[Any, None]:
        state, total = jax.lax.optimization_barrier(carry)
        state, extra = jax.lax.optimization_barrier(part(state, key))
        seen = [jnp.float32(jnp.any(leaf.ravel()[:1] != 0)) for leaf in jax.tree.leaves(extra)]
        return (state, total + sum(seen, jnp.float32(0))), None

    def program(key: jax.Array, state: fleet.FleetState) -> tuple[fleet.FleetState, jax.Array]:
        keys = jax.vmap(key_at, (None, 0))(key, jnp.arange(num_steps))
        return jax.lax.scan(body, (state, jnp.float32(0)), keys)[0]

    return jax.jit(program)


def measure(environment: str, parameters: dict[str, Any], *, num_steps: int, repeats: int, trace: str | None) -> dict[str, str]:
    """Return a row of the table."""
    config = fleetjax.make_config(environment, "cur", **{"initial_period": 0} | parameters)
    key = jax.random.key(0)
    state = jax.jit(fleetjax.prepare)(config, key)
    programs = {name: repeated(part, num_steps) for name, part in parts_of(config).items()}
    state = jax.block_until_ready(programs["whole"](key, state))[0]
    for program in programs.values():
        jax.block_until_ready(program(key, state))
    times: dict[str, list[float]] = {name: [] for name in programs}
    for _ in range(repeats):
        for name, program in programs.items():
            times[name].append(seconds(program, key, state)[0] / num_steps)
    if trace:
        with jax.profiler.trace(trace):
            jax.block_until_ready(programs["whole"](key, state))
    about = {"environment": environment, "device": jax.devices()[0].device_kind, "N": str(config.num_robots)}
    return about | {f"{name} ms": f"{1e3 * statistics.median(found):.2f}" for name, found in times.items()}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    scripts.add_names(parser, "environments", fleetjax.list_envs())
    parser.add_argument("--steps", type=int, default=50, help="how often a part is done in one program")
    parser.add_argument("--repeats", type=int, default=5, help="timed programs")
    parser.add_argument("--trace", help="folder for a profile of whole timesteps")
    args, parameters = scripts.parse(parser)
    options = {"num_steps": args.steps, "repeats": args.repeats, "trace": args.trace}
    print(table([measure(name, parameters, **options) for name in args.environments]))


if __name__ == "__main__":
    main()
