"""Train the expert policy of a physics environment with brax PPO; kill it at any time and start it again.

    python experiments/train_expert.py humanoid                 # train, or resume from the last checkpoint
    python experiments/train_expert.py humanoid --ship           # score the best checkpoints, write the package's weights

Every evaluation appends a row to `curve.csv` and writes a checkpoint (observation statistics, policy and value
network; the optimizer starts afresh after an interruption). `--ship` scores the checkpoints with the
highest returns on many fresh episodes and writes the best one to `fleetjax/supervisors/weights/`, or to --weights.
"""

import argparse
import csv
import dataclasses
import json
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import Env as BraxEnv
from brax.envs.base import State
from brax.training.acme import running_statistics, specs
from brax.training.agents.ppo import networks, train
from flax import linen, serialization
from trainings import SHARED, TRAININGS, Mirror, Stage, Training

from fleetjax import tree
from fleetjax.supervisors import expert

PACKAGE_WEIGHTS = Path(expert.__file__).parent / "weights"


def network_factory(training: Training, mirror: Mirror | None = None) -> Callable[..., networks.PPONetworks]:
    """Return what builds the policy and value network."""

    def make_networks(*args, **kwargs) -> networks.PPONetworks:
        nets = networks.make_ppo_networks(
            *args,
            **kwargs,
            policy_hidden_layer_sizes=training.hidden_sizes,
            value_hidden_layer_sizes=training.hidden_sizes,
            activation=linen.elu,
            **training.network,
        )
        return nets if mirror is None else symmetric(nets, mirror)

    return make_networks


def symmetric(nets: networks.PPONetworks, mirror: Mirror) -> networks.PPONetworks:
    """Return networks that average over a robot and its mirror image; actions come from a `CLIPPED_NORMAL` policy."""
    policy_of, value_of = nets.policy_network.apply, nets.value_network.apply

    def policy(processor, params, obs):
        mean, std = policy_of(processor, params, obs)
        mean_mirrored, std_mirrored = policy_of(processor, params, mirror.obs(obs))
        return (mean + mirror.action(mean_mirrored)) / 2, (std + jnp.abs(mirror.action(std_mirrored))) / 2

    def value(processor, params, obs):
        return (value_of(processor, params, obs) + value_of(processor, params, mirror.obs(obs))) / 2

    return nets.replace(  # pyright: ignore[reportAttributeAccessIssue]
        policy_network=dataclasses.replace(nets.policy_network, apply=policy),
        value_network=dataclasses.replace(nets.value_network, apply=value),
    )


if not hasattr(jax, "device_put_replicated"):  # brax 0.14.2 calls it; jax 0.10 dropped it (brax issue 671)

    def _replicate(tree, devices):
        sharding = jax.sharding.NamedSharding(jax.sharding.Mesh(np.array(devices), ("i",)), jax.sharding.PartitionSpec("i"))
        return jax.device_put(jax.tree.map(lambda x: jnp.stack([x] * len(devices)), tree), sharding)

    jax.device_put_replicated = _replicate


class Task(BraxEnv):
    """A fleetjax environment as brax sees it; brax's own wrappers reset it and cut its episodes."""

    def __init__(self, training: Training, stage: Stage):
        self.env = training.make_env(**stage.options)
        self.training, self.stage = training, stage

    def reset(self, rng: jax.Array) -> State:
        """Start an episode."""
        state: Any = self.env.reset(rng, jnp.int32(0))  # brax expects its own kind of state, and looks at none of it
        seen = self.training.view(state.obs)
        return State(state, seen, state.reward, jnp.float32(0), {"successes": jnp.float32(0)}, {"key": rng})

    def step(self, state: Any, action: jax.Array) -> State:
        """Take one control step; a violation ends the episode."""
        key_next, key_vary, key_step, key_goal = jax.random.split(state.info["key"], 4)
        before = self.stage.vary(state.pipeline_state, key_vary)
        after = self.env.step(before, action, jnp.bool_(True), key_step)
        reward, done = self.stage.reward(before, after), after.violation.astype(jnp.float32)
        success = after.success.astype(jnp.float32)
        info = {**state.info, "key": key_next}
        if self.env.next_goal:
            after = tree.where(after.success, self.env.next_goal(after, key_goal), after)
        metrics = {**state.metrics, "successes": success}
        return state.replace(
            pipeline_state=after, obs=self.training.view(after.obs), reward=reward, done=done, metrics=metrics, info=info
        )

    @property
    def observation_size(self) -> int:
        """Length of what the networks see of the observation."""
        return jax.eval_shape(self.training.view, jnp.zeros(self.env.spec.observation_size)).shape[0]

    @property
    def action_size(self) -> int:
        """Length of the action."""
        return self.env.spec.action_size

    @property
    def backend(self) -> str:
        """Name that brax's registry would use."""
        return "fleetjax"


def template(task: Task):
    """Return parameters of the right structure, to read a checkpoint into."""
    nets = network_factory(task.training)(task.observation_size, task.action_size)
    key = jax.random.key(0)
    statistics = running_statistics.init_state(specs.Array((task.observation_size,), jnp.dtype("float32")))
    return statistics, nets.policy_network.init(key), nets.value_network.init(key)


def checkpoints(folder: Path) -> list[Path]:
    """Return the checkpoints of a run, oldest first."""
    return sorted(folder.glob("checkpoint_*.msgpack"))


def train_expert(
    name: str, folder: Path, *, num_timesteps: int, evaluate_every: int, seed: int, settings: Mapping[str, float]
) -> None:
    """Train until `num_timesteps` in all, from the last checkpoint if there is one; `settings` go before a stage's own."""
    folder.mkdir(parents=True, exist_ok=True)
    stages = TRAININGS[name].stages
    ends = [*(stage.begins for stage in stages[1:]), num_timesteps]
    for stage, end in zip(stages, ends, strict=True):
        if steps_done(folder) < min(end, num_timesteps):
            train_stage(
                Task(TRAININGS[name], stage._replace(settings={**stage.settings, **settings})),
                folder,
                num_timesteps=min(end, num_timesteps),
                evaluate_every=evaluate_every,
                seed=seed,
            )


def steps_of(checkpoint: Path) -> int:
    """Return the environment steps that went into a checkpoint."""
    return int(checkpoint.stem.split("_")[1])


def steps_done(folder: Path) -> int:
    """Return the environment steps that went into the last checkpoint; 0 if there is none."""
    return max(map(steps_of, checkpoints(folder)), default=0)


def set_noise(policy: Any, noise: float) -> Any:
    """Return the parameters of a `CLIPPED_NORMAL` policy whose actions have this standard deviation."""
    return {
        "params": {
            **policy["params"],
            "std_logparam": jax.tree.map(lambda x: jnp.full_like(x, jnp.log(noise)), policy["params"]["std_logparam"]),
        }
    }


def train_stage(task: Task, folder: Path, *, num_timesteps: int, evaluate_every: int, seed: int) -> None:
    """Train with the settings of one stage, from the last checkpoint if there is one."""
    done, restore = steps_done(folder), None
    if done:
        last = checkpoints(folder)[-1]
        statistics, policy, value = serialization.from_bytes(template(task), last.read_bytes())
        restore = (statistics, set_noise(policy, task.stage.noise) if task.stage.noise else policy, value)
        print(f"resuming from {last} at {done:,} steps")
    start = time.time()

    def save(step: int, _, params) -> None:
        if step > 0:
            temporary = folder / "checkpoint.tmp"
            temporary.write_bytes(serialization.to_bytes(params))
            temporary.rename(folder / f"checkpoint_{done + step:010d}.msgpack")

    def log(step: int, metrics) -> None:
        row = {
            "steps": done + step,
            "seconds": round(time.time() - start, 1),
            "episode_return": round(float(metrics["eval/episode_reward"]), 1),
            "episode_return_std": round(float(metrics["eval/episode_reward_std"]), 1),
            "episode_length": round(float(metrics["eval/avg_episode_length"]), 1),
            "successes": round(float(metrics["eval/episode_successes"]), 2),
        }
        new = not (folder / "curve.csv").exists()
        with (folder / "curve.csv").open("a", newline="") as file:
            writer = csv.DictWriter(file, row)
            if new:
                writer.writeheader()
            writer.writerow(row)
        shown = ("kl", "learning_rate", "mean_std", "sps")
        print(row, {k: float(v) for k, v in metrics.items() if any(word in k for word in shown)}, flush=True)

    remaining = num_timesteps - done
    usual: dict[str, Any] = {**SHARED, "episode_length": task.stage.episode_length or task.training.episode_length}
    train.train(
        environment=task,
        num_timesteps=remaining,
        normalize_observations=True,
        network_factory=network_factory(task.training, task.stage.mirror),
        num_evals=max(2, 1 + remaining // evaluate_every),
        deterministic_eval=True,
        seed=seed + done,
        progress_fn=log,
        policy_params_fn=save,
        restore_params=restore,
        **usual | task.stage.settings,
    )


def with_mirror_image(layers: list[Any], statistics: Any, mirror: Mirror) -> list[dict[str, np.ndarray]]:
    """Return layers, twice as wide, that do what `symmetric` makes of a policy's layers."""
    first, *inner, last = [{name: np.asarray(value) for name, value in layer.items()} for layer in layers]
    mean, std = np.asarray(statistics.mean), np.asarray(statistics.std)
    seen, done = np.asarray(mirror.obs(jnp.eye(mean.size))), np.asarray(mirror.action(jnp.eye(last["bias"].size)))
    turned, shift = std[:, None] * seen / std, (mean @ seen - mean) / std  # of normalised observations
    kernel, bias = first["kernel"], first["bias"]
    return [
        {"kernel": np.hstack([kernel, turned @ kernel]), "bias": np.hstack([bias, bias + shift @ kernel])},
        *({"kernel": np.kron(np.eye(2), layer["kernel"]), "bias": np.tile(layer["bias"], 2)} for layer in inner),
        {"kernel": np.vstack([last["kernel"], last["kernel"] @ done]) / 2, "bias": (last["bias"] + last["bias"] @ done) / 2},
    ]


def as_weights(params, training: Training) -> dict[str, np.ndarray]:
    """Turn brax parameters into the arrays that the package ships (see `fleetjax.supervisors.expert`)."""
    statistics, policy, _ = params
    modules = policy["params"]
    clipped = "MLP_0" in modules
    layers = [layer for _, layer in sorted((modules["MLP_0"] if clipped else modules).items())]
    layers = [*layers, modules["Dense_0"]] if clipped else layers
    mirror = training.stages[-1].mirror
    layers = layers if mirror is None else with_mirror_image(layers, statistics, mirror)
    weights: dict[str, Any] = {"obs_mean": statistics.mean, "obs_std": statistics.std}
    for i, layer in enumerate(layers):
        actions = layer["bias"].size // 2 if layer is layers[-1] and not clipped else None  # the other half are their scales
        weights[f"kernel_{i}"], weights[f"bias_{i}"] = layer["kernel"][:, :actions], layer["bias"][:actions]
    weights |= {"bound": np.float32(1.0)} if clipped else {}
    return {name: np.asarray(value, np.float32) for name, value in weights.items()}


def ship(name: str, folder: Path, output: Path, *, candidates: int, num_episodes: int) -> None:
    """Score the most promising checkpoints on fresh episodes and write the best into the folder `output`.

    Episodes whose return is at least 95 % of the mean over full-length episodes (and the task's floor) succeed;
    the checkpoint with most successes wins. Where there are goals, the one that reaches most of them wins.
    """
    with (folder / "curve.csv").open() as file:
        curve = {int(row["steps"]): float(row["episode_return"]) for row in csv.DictReader(file)}
    training = TRAININGS[name]
    task, (label, measure) = Task(training, training.stages[-1]), training.measure
    finished = [path for path in checkpoints(folder) if steps_of(path) > training.stages[-1].begins]
    ranked = sorted(finished, key=lambda path: -curve.get(steps_of(path), -np.inf))
    best = None
    for path in ranked[:candidates]:
        weights = as_weights(serialization.from_bytes(template(task), path.read_bytes()), training)
        score = jax.jit(
            lambda w, key: expert.score(task.env, w, measure, num_episodes=num_episodes, key=key, view=training.view)
        )
        returns, lengths, measured = map(np.asarray, score(weights, jax.random.key(1)))
        full = lengths == task.env.spec.horizon
        mean = float(returns[full].mean()) if full.any() else float("nan")
        record = {
            "environment": name,
            "steps": steps_of(path),
            "num_episodes": num_episodes,
            "mean_return": round(float(returns.mean()), 1),
            "mean_return_full_length": round(mean, 1),
            "share_full_length": round(float(full.mean()), 4),
            "share_successful": round(float((full & (returns > max(training.success_floor, 0.95 * mean))).mean()), 4),
            label: round(float(measured.sum() / lengths.sum()), 4),
        }
        print(record, flush=True)
        criterion = label if task.env.next_goal else "share_successful"
        if best is None or record[criterion] > best[0][criterion]:
            best = (record, weights)
    assert best is not None, f"no checkpoint of the last stage in {folder}"
    output.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(output / f"{name}.npz", **best[1])  # pyright: ignore[reportArgumentType]
    (output / f"{name}.json").write_text(json.dumps(best[0], indent=2) + "\n")
    (output / f"{name}_curve.csv").write_text((folder / "curve.csv").read_text())
    print(f"shipped {best[0]}")


def setting(text: str) -> tuple[str, float]:
    """Return the name and the number in `NAME=NUMBER`."""
    name, number = text.split("=")
    return name, json.loads(number)


def main() -> None:
    """Parse the command line and train or ship."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("environment", choices=sorted(TRAININGS))
    parser.add_argument("--output", type=Path, help="folder of checkpoints (default: runs/experts/ENVIRONMENT)")
    parser.add_argument("--num-timesteps", type=int, default=40_000_000, help="environment steps in all")
    parser.add_argument("--evaluate-every", type=int, default=1_000_000, help="environment steps between evaluations")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--learning-rate", type=float, help="in place of the task's setting, to anneal a resumed run")
    parser.add_argument(
        "--settings",
        nargs="+",
        type=setting,
        metavar="NAME=NUMBER",
        default=[],
        help="of brax's PPO, in place of the task's: num_envs=256",
    )
    parser.add_argument("--ship", action="store_true", help="choose the best checkpoint and write it into --weights")
    parser.add_argument("--weights", type=Path, default=PACKAGE_WEIGHTS, help="folder of --ship [default: the package's]")
    parser.add_argument("--candidates", type=int, default=5, help="checkpoints to score with --ship")
    parser.add_argument("--num-episodes", type=int, default=512, help="episodes a checkpoint is scored on with --ship")
    args = parser.parse_args()
    folder = args.output or Path("runs/experts") / args.environment
    if args.ship:
        ship(args.environment, folder, args.weights, candidates=args.candidates, num_episodes=args.num_episodes)
    else:
        train_expert(
            args.environment,
            folder,
            num_timesteps=args.num_timesteps,
            evaluate_every=args.evaluate_every,
            seed=args.seed,
            settings=dict(args.settings) | ({} if args.learning_rate is None else {"learning_rate": args.learning_rate}),
        )


if __name__ == "__main__":
    main()
