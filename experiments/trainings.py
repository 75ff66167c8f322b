"""How the package's experts are trained: environments, rewards, hyper-parameters, stage by stage.

`train_expert.py` runs these tables.
"""

import functools
import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from fleetjax.envs import Env, allegro_hand, anymal, humanoid
from fleetjax.envs.rotation import angle_between
from fleetjax.supervisors import expert
from fleetjax.types import EnvState


class Mirror(NamedTuple):
    """What a robot's mirror image senses and does, in place of an observation f32[..., O] and an action f32[..., A]; linear."""

    obs: Callable[[jax.Array], jax.Array]
    action: Callable[[jax.Array], jax.Array]


class Stage(NamedTuple):
    """A part of a training.

    Attributes:
        reward: `(before, after) -> f32[]`, what PPO sees in place of the task's reward.
        settings: hyper-parameters of PPO besides `SHARED`; the rest are brax's defaults.
        begins: after how many environment steps.
        options: what `Training.make_env` is given.
        noise: standard deviation that actions of a `CLIPPED_NORMAL` policy have at the beginning; None leaves what it was.
        vary: `(EnvState, key) -> EnvState`, a disturbance before each training step.
        episode_length: where given, in place of the training's.
        mirror: where given, the policy is the mean of what it does and of what its mirror image does.
    """

    settings: dict[str, Any]
    reward: Callable[[EnvState, EnvState], jax.Array] = lambda before, after: after.reward
    begins: int = 0
    options: Mapping[str, Any] = {}
    noise: float | None = None
    vary: Callable[[EnvState, jax.Array], EnvState] = lambda state, key: state
    episode_length: int | None = None
    mirror: Mirror | None = None


class Training(NamedTuple):
    """How an expert is trained and judged.

    Attributes:
        make_env: builds the environment.
        success_floor: the return below which no episode succeeds.
        measure: name of what is reported beside the return, and `EnvState -> f32[]`, averaged over steps.
        stages: one after the other.
        hidden_sizes: units of the hidden layers of policy and value network.
        network: what else brax's networks are built with.
        episode_length: of training, in control steps; a stage may have its own.
        view: what the networks see of an observation.
    """

    make_env: Callable[..., Env]
    success_floor: float
    measure: tuple[str, Callable[[EnvState], jax.Array]]
    episode_length: int
    stages: tuple[Stage, ...]
    hidden_sizes: tuple[int, ...] = (256, 128)
    network: Mapping[str, Any] = {}
    view: expert.View = expert.everything


def progress(before: EnvState, after: EnvState) -> jax.Array:
    """Return ANYmal's reward, and more for each part of the commanded velocity that it reaches.

    The task's own reward is flat where the robot stands and should run. Standing still earns little here, and nothing is
    negative, for a robot that only loses learns to fall.
    """
    del before
    linear, angular = anymal.base_velocity(after.physics.body)
    told = after.physics.command
    missed = jnp.linalg.norm(linear[:2] - told[:2]) / jnp.maximum(jnp.linalg.norm(told[:2]), 0.3)
    turning_missed = jnp.abs(angular[2] - told[2]) / jnp.maximum(jnp.abs(told[2]), 0.3)
    reached = jnp.maximum(1.25 - missed, 0.0) + 0.5 * jnp.maximum(1.25 - turning_missed, 0.0)
    return after.reward + 0.03 * reached


def trembling(before: EnvState, after: EnvState) -> jax.Array:
    """Return the squared change f32[] of ANYmal's action."""
    return jnp.sum((after.obs[36:] - before.obs[36:]) ** 2)


def calm_walking(before: EnvState, after: EnvState) -> jax.Array:
    """Return ANYmal's reward, less a little for trembling."""
    return after.reward - 5e-4 * trembling(before, after)


def sure_walking(before: EnvState, after: EnvState) -> jax.Array:
    """Return the same with less said of trembling, and a violation punished: slow robots fell, fast ones lost return."""
    return after.reward - 2e-4 * trembling(before, after) - 1.0 * after.violation


def easy_command(key: jax.Array) -> jax.Array:
    """Draw a command f32[3] for ANYmal; slow ones are more frequent than in the task."""
    key_what, key_scale = jax.random.split(key)
    scale = jnp.minimum(1.0, jax.random.uniform(key_scale, maxval=3.0))
    return scale * jax.random.uniform(key_what, (3,), minval=-1.0, maxval=1.0) * anymal.COMMAND_RANGE


def hard_command(key: jax.Array) -> jax.Array:
    """Draw a command f32[3] for ANYmal; fast ones, with turns, are more frequent than in the task."""
    draw = jax.random.uniform(key, (3,), minval=-1.0, maxval=1.0)
    return jnp.sign(draw) * jnp.abs(draw) ** 0.4 * anymal.COMMAND_RANGE


def command(state: EnvState, velocity: jax.Array) -> EnvState:
    """Return ANYmal as it is, told another velocity f32[3]."""
    walker = state.physics._replace(command=velocity)
    return state._replace(physics=walker, obs=anymal.observe(walker, state.obs[36:]))


def change_command(draw: Callable[[jax.Array], jax.Array], state: EnvState, key: jax.Array) -> EnvState:
    """Give ANYmal another command now and then, every 250 steps in the mean."""
    key_when, key_what = jax.random.split(key)
    return command(state, jnp.where(jax.random.uniform(key_when) < 1 / 250, draw(key_what), state.physics.command))


def fast_command(key: jax.Array) -> jax.Array:
    """Draw a command f32[3] for ANYmal; fast runs forward and backward are more frequent than in the task."""
    draw = jax.random.uniform(key, (3,), minval=-1.0, maxval=1.0)
    return draw.at[0].set(jnp.sign(draw[0]) * jnp.abs(draw[0]) ** 0.4) * anymal.COMMAND_RANGE


def extreme_command(key: jax.Array) -> jax.Array:
    """Draw a command f32[3] for ANYmal; slow walks and fast runs are more frequent than in the task."""
    key_which, key_what = jax.random.split(key)
    return jnp.where(jax.random.uniform(key_which) < 0.4, fast_command(key_what), easy_command(key_what))


def begin_with(draw: Callable[[jax.Array], jax.Array], state: EnvState, key: jax.Array) -> EnvState:
    """Give ANYmal another command for each episode, as the task does."""
    return command(state, jnp.where(state.episode_step == 0, draw(key), state.physics.command))


def mirrored_joints(values: jax.Array) -> jax.Array:
    """Return the values f32[..., 12] of ANYmal's joints with left and right changed over."""
    return jnp.roll(values, 6, axis=-1) * jnp.tile(jnp.array([-1.0, 1.0, 1.0]), 4)  # the first of each leg moves it sideways


def mirrored(obs: jax.Array) -> jax.Array:
    """Return what ANYmal's mirror image would observe f32[..., 48]."""
    signs = jnp.array([1.0, -1, 1, -1, 1, -1, 1, -1, 1, 1, -1, -1])  # velocities, gravity, command
    joints = [mirrored_joints(values) for values in jnp.split(obs[..., 12:], 3, axis=-1)]
    return jnp.concatenate([obs[..., :12] * signs, *joints], axis=-1)


def turning(before: EnvState, after: EnvState) -> jax.Array:
    """Return for the Allegro hand by how many radians the cube came closer to its goal, 2 for a goal and -1 for a drop.

    The task's own reward also pays for staying near a goal; this one pays for reaching goals fast. Metres that the cube comes
    closer to the goal's position count 5 times, so that a drop is felt as it begins.
    """
    hands = (before.physics.body.qpos, after.physics.body.qpos)
    angle, angle_after = (angle_between(qpos[19:23], before.physics.goal) for qpos in hands)
    distance, distance_after = (jnp.linalg.norm(qpos[16:19] - allegro_hand.GOAL_POSITION) for qpos in hands)
    closer = (angle - angle_after) + 5.0 * (distance - distance_after)
    return closer + 2.0 * after.success - 1.0 * after.violation


SHARED = {
    "num_envs": 1024,
    "num_eval_envs": 128,
    "unroll_length": 16,
    "batch_size": 64,
    "num_minibatches": 32,
    "num_updates_per_batch": 4,
    "learning_rate": 3e-4,
    "max_grad_norm": 1.0,
}
LARGE_BATCHES = {
    "clipping_epsilon": 0.2,
    "entropy_cost": 2e-3,
    "num_envs": 2048,
    "unroll_length": 24,
    "batch_size": 512,
    "num_minibatches": 4,
    "num_updates_per_batch": 5,
    "learning_rate": 5e-4,
    "learning_rate_schedule": "ADAPTIVE_KL",
    "learning_rate_schedule_max_lr": 3e-3,
    "desired_kl": 0.012,
    "vf_loss_coefficient": 1.0,
}
TURNING = LARGE_BATCHES | {
    "unroll_length": 16,
    "num_updates_per_batch": 4,
    "discounting": 0.99,
    "reward_scaling": 1.0,
    "desired_kl": 0.016,
    "entropy_cost": 1e-3,
}
MORE_UPDATES = {"num_envs": 1024, "batch_size": 256}
SMALL_STEPS = {"learning_rate": 3e-5, "desired_kl": 0.006}
FINE = {"discounting": 0.99, "reward_scaling": 5.0, "entropy_cost": 0.0}
WALKING = LARGE_BATCHES | FINE | {"desired_kl": 0.01}
EASY = functools.partial(change_command, easy_command)
HARD = functools.partial(change_command, hard_command)
FAST = functools.partial(begin_with, fast_command)
EXTREME = functools.partial(begin_with, extreme_command)
SIDES = Mirror(mirrored, mirrored_joints)
# Actions from a normal distribution that the environment clips, of a width that does not depend on the state: a wide one
# keeps the robot moving until it has found a gait. With brax's default, a normal distribution under tanh, ANYmal learns to
# stand, and goes on standing.
CLIPPED_NORMAL = {
    "distribution_type": "normal",
    "noise_std_type": "log",
    "init_noise_std": 1.0,
    "mean_kernel_init_fn": lambda: jax.nn.initializers.variance_scaling(0.01, "fan_in", "uniform"),
}
TRAININGS = {
    "allegro_hand": Training(
        make_env=allegro_hand.make_env,
        success_floor=math.inf,  # goals count, returns do not
        measure=("goals_per_step", lambda state: state.success.astype(jnp.float32)),
        hidden_sizes=(256, 256),
        network=CLIPPED_NORMAL | {"init_noise_std": 0.6},
        view=allegro_hand.view,
        episode_length=allegro_hand.HORIZON,
        stages=(
            Stage(TURNING, turning, options={"tolerance": 0.4}),
            Stage(TURNING, turning, options={"tolerance": 0.2}, begins=23_500_000),
            Stage(TURNING, turning, begins=30_000_000),
            # Goals came hardly faster now. Back to what is learnt fast, with twice as many updates, and on from there.
            Stage(TURNING | MORE_UPDATES, turning, options={"tolerance": 0.4}, begins=33_000_000),
            Stage(TURNING | MORE_UPDATES, turning, options={"tolerance": 0.2}, begins=40_000_000),
            Stage(TURNING | MORE_UPDATES, turning, begins=46_000_000, noise=0.3),
            # The 49 million steps before saw a view without entries 66 to 68, whose weights now began at zero.
            Stage(TURNING | MORE_UPDATES, turning, begins=49_000_000, noise=0.4),
            Stage(TURNING | SMALL_STEPS | {"entropy_cost": 0.0}, turning, begins=58_000_000),
        ),
    ),
    "anymal": Training(
        make_env=functools.partial(anymal.make_env, success_return=math.inf),
        success_floor=anymal.SUCCESS_FLOOR,
        measure=("mean_tracking_error", anymal.tracking_error),
        network=CLIPPED_NORMAL,
        episode_length=1000,
        # The first 6 million steps ran with two iterations of the solver, the rest with the model's ten.
        stages=(
            Stage(LARGE_BATCHES | {"discounting": 0.98, "reward_scaling": 3.0}, progress, vary=EASY),
            Stage(LARGE_BATCHES | FINE, calm_walking, begins=10_000_000, noise=0.3, vary=EASY),
            Stage(WALKING | SMALL_STEPS, sure_walking, begins=18_000_000, noise=0.12, vary=EASY),
            Stage(WALKING, sure_walking, begins=25_000_000, noise=0.2, vary=EASY),
            Stage(WALKING | SMALL_STEPS, sure_walking, begins=32_000_000, noise=0.1, vary=EASY),
            Stage(WALKING, sure_walking, begins=35_500_000, noise=0.2, vary=HARD),
            Stage(WALKING | SMALL_STEPS, sure_walking, begins=46_000_000, noise=0.1, vary=HARD),
            Stage(WALKING, sure_walking, begins=52_000_000, noise=0.15, vary=HARD),
            # Above 1.6 m/s a third of the episodes still cost too much torque: the gait loads one hind leg more than the other.
            Stage(WALKING, sure_walking, begins=58_000_000, noise=0.2, vary=FAST, mirror=SIDES),
            # Half the misses were gone, but now the slowest robots fell.
            Stage(WALKING, sure_walking, begins=62_000_000, vary=EXTREME, mirror=SIDES),
            Stage(WALKING | SMALL_STEPS, sure_walking, begins=66_000_000, noise=0.1, vary=EXTREME, mirror=SIDES),
            # What falls were left happened within two seconds of a start: more starts.
            Stage(WALKING, sure_walking, begins=67_500_000, noise=0.12, vary=EXTREME, episode_length=200, mirror=SIDES),
        ),
    ),
    "humanoid": Training(
        make_env=functools.partial(humanoid.make_env, success_return=math.inf),
        success_floor=humanoid.SUCCESS_FLOOR,
        measure=("mean_forward_speed", humanoid.forward_speed),
        episode_length=humanoid.HORIZON,
        stages=(Stage({"clipping_epsilon": 0.3, "entropy_cost": 1e-3, "discounting": 0.97, "reward_scaling": 0.1}),),
    ),
}
