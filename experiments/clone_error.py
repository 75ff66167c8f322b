"""Print how far clones of so many demonstrations are from the expert in episodes that they have not seen.

    python experiments/clone_error.py [ROBOT] [--demonstrations 5000 20000 80000] [--fresh 20000] [--seed 0]

Errors are mean squares over actions in [-1, 1], on the expert's own states; the uncertainty is the one that algorithms see.
A clone is the mean of the ensemble after as many gradient steps as a run has in all, unless --gradient-steps says otherwise.
"""

import argparse

import jax
import jax.numpy as jnp

import fleetjax
from fleetjax.config import Config
from fleetjax.fleet import make_parts
from fleetjax.learning import imitation, pretraining

ROBOTS = ("humanoid", "anymal", "allegro_hand")  # whose observations end with the last action


def main() -> None:
    """Print a row for each number of demonstrations, then what to compare with."""
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
    parts = make_parts(default, env)

    @jax.jit
    def clone(config: Config, key: jax.Array):
        return pretraining.pretrain(config, env, parts.learner, parts.supervisor, key)

    @jax.jit
    def judge(policy: imitation.PolicyState, pairs: imitation.Pair, size: jax.Array) -> tuple[jax.Array, jax.Array]:
        action, uncertainty = parts.learner.predict(policy, pairs.obs)
        error = jnp.mean((action - pairs.action) ** 2, axis=-1)
        valid = jnp.arange(error.size) < size
        return jnp.mean(error, where=valid), jnp.mean(uncertainty, where=valid)

    key_fresh, key = jax.random.split(jax.random.key(args.seed))
    _, fresh = clone(default.replace(num_demonstrations=args.fresh, pretraining_steps=0), key_fresh)
    print("| demonstrations | error on them | error in fresh episodes | uncertainty there |\n|---:|---:|---:|---:|")
    for number in args.demonstrations:
        policy, data = clone(default.replace(num_demonstrations=number), key)
        seen, _ = judge(policy, data.pairs.rows, data.pairs.size)
        error, uncertainty = judge(policy, fresh.pairs.rows, fresh.pairs.size)
        print(f"| {number:,} | {seen:.4f} | {error:.4f} | {uncertainty:.4f} |", flush=True)
    obs, action = (x[: args.fresh] for x in fresh.pairs.rows)
    print(f"\nvariance of the expert's actions: {jnp.mean(jnp.var(action, axis=0)):.4f}")
    print(f"error of repeating the last action: {jnp.mean((obs[:, -action.shape[1] :] - action) ** 2):.4f}")


if __name__ == "__main__":
    main()
