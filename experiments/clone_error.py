"""Print how far clones are from the expert in episodes that they have not seen, and what they achieve.

    python experiments/clone_error.py [ROBOT] [--demonstrations 5000 20000 80000] [--fresh 20000] [--seed 0]

Errors are mean squares over actions in [-1, 1], on the expert's own states; the uncertainty is the one that algorithms see.
A small error does not mean a good clone, so its successes in one episode of 100 robots stand beside it (on the hand: goals). A
clone is the mean of the ensemble after as many gradient steps as a run has in all, unless --gradient-steps says otherwise. On
the hand, clones also learn from what its expert sees in place of the observation.
"""

import argparse
from collections.abc import Callable

import jax
import jax.numpy as jnp

import fleetjax
from fleetjax.config import Config
from fleetjax.envs import Env, allegro_hand
from fleetjax.fleet import Parts, make_parts
from fleetjax.learning import imitation, pretraining
from fleetjax.supervisors import Supervisor
from fleetjax.supervisors.expert import run_episodes
from fleetjax.types import EnvState

NUM_EPISODES = 100
ROBOTS = ("humanoid", "anymal", "allegro_hand")
VIEWS: dict[str, dict[str, Callable[[jax.Array], jax.Array]]] = {"allegro_hand": {"expert's view": allegro_hand.view}}


def seen_through(env: Env, view: Callable[[jax.Array], jax.Array]) -> Env:
    """Return the same task with other observations; the state as it was is the new state's `physics`."""

    def see(state: EnvState) -> EnvState:
        return state._replace(physics=state, obs=view(state.obs))

    next_goal = env.next_goal
    size = jax.eval_shape(view, jnp.zeros(env.spec.observation_size)).shape[0]
    return env._replace(
        reset=lambda key, robot: see(env.reset(key, robot)),
        step=lambda state, action, active, key: see(env.step(state.physics, action, active, key)),
        spec=env.spec._replace(observation_size=size),
        next_goal=next_goal and (lambda state, key: see(next_goal(state.physics, key))),
    )


def compare(name: str, default: Config, parts: Parts, args: argparse.Namespace) -> None:
    """Print a row for each number of demonstrations, then what to compare with."""

    @jax.jit
    def clone(config: Config, key: jax.Array):
        return pretraining.pretrain(config, parts.env, parts.learner, parts.supervisor, key)

    @jax.jit
    def judge(policy: imitation.PolicyState, pairs: imitation.Pair, size: jax.Array) -> tuple[jax.Array, jax.Array]:
        action, uncertainty = parts.learner.predict(policy, pairs.obs)
        error = jnp.mean((action - pairs.action) ** 2, axis=-1)
        valid = jnp.arange(error.size) < size
        return jnp.mean(error, where=valid), jnp.mean(uncertainty, where=valid)

    @jax.jit
    def count_successes(policy: imitation.PolicyState, key: jax.Array) -> jax.Array:
        act, measure = lambda obs: parts.learner.predict(policy, obs)[0], lambda state: state.success.astype(jnp.float32)
        return jnp.sum(run_episodes(parts.env, act, measure, num_episodes=NUM_EPISODES, key=key)[2])

    key_fresh, key_run, key = jax.random.split(jax.random.key(args.seed), 3)
    _, fresh = clone(default.replace(num_demonstrations=args.fresh, pretraining_steps=0), key_fresh)
    for number in args.demonstrations:
        policy, data = clone(default.replace(num_demonstrations=number), key)
        seen, _ = judge(policy, data.pairs.rows, data.pairs.size)
        error, uncertainty = judge(policy, fresh.pairs.rows, fresh.pairs.size)
        row = f"| {name} | {number:,} | {seen:.4f} | {error:.4f} | {uncertainty:.4f} |"
        print(f"{row} {int(count_successes(policy, key_run)):,} |", flush=True)
    action = fresh.pairs.rows.action[: args.fresh]
    print(f"| {name} | variance of the expert's actions | | {jnp.mean(jnp.var(action, axis=0)):.4f} | | |", flush=True)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("robot", nargs="?", choices=ROBOTS, default="allegro_hand")
    parser.add_argument("--demonstrations", type=int, nargs="+", default=[5000, 20_000, 80_000])
    parser.add_argument("--fresh", type=int, default=20_000, help="pairs of episodes that the clones have not seen")
    parser.add_argument("--gradient-steps", type=int, help="of a clone [default: as many as a run has in all]")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    capacity = max(args.fresh, *args.demonstrations)
    default = fleetjax.make_config(args.robot, "constraint_trained", extra_demonstrations=0).replace(human_capacity=capacity)
    if args.gradient_steps is not None:
        default = default.replace(pretraining_steps=args.gradient_steps)
    env = fleetjax.envs.make(args.robot, default.backend)
    supervisor = make_parts(default, env).supervisor
    print("| learner sees | demonstrations | error on them | in fresh episodes | uncertainty there | successes |")
    print("|:---|---:|---:|---:|---:|---:|")
    compare("observation", default, make_parts(default, env), args)
    for name, view in VIEWS.get(args.robot, {}).items():
        parts = make_parts(default, seen_through(env, view))
        teacher = Supervisor(lambda state, key: supervisor.act(state.physics, key))
        compare(name, default, parts._replace(supervisor=teacher), args)


if __name__ == "__main__":
    main()
