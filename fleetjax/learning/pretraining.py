"""Before the fleet starts: demonstrations, the first clone, and offline transitions for the critics (paper, Appendix)."""

import jax
import jax.numpy as jnp

from fleetjax import priority, supervisors
from fleetjax.config import Config
from fleetjax.envs import Env
from fleetjax.learning import critic, imitation
from fleetjax.learning.networks import fit_normalizer, pixel_normalizer
from fleetjax.tree import where
from fleetjax.types import EnvState

LANES = 8  # episodes that are demonstrated side by side
TURNS = 100  # of all robots, after which a fleet without any demonstration gives up
MOST_LANES = 100  # robots that give offline transitions side by side
BURST = 20  # timesteps of offline transitions between two looks at their number


def collect_demonstrations(
    config: Config, env: Env, supervisor: supervisors.Supervisor, add, data: imitation.HumanData, key: jax.Array
) -> imitation.HumanData:
    """Fill `data` with supervisor actions from whole episodes of all robots in turn, the last one cut at the number asked for.

    Robots that start in violation do not move, and demonstrate nothing. If all do, again and again, `data` stays empty.

    Args:
        config: configuration.
        env: environment.
        supervisor: who demonstrates.
        add: the learner's `append`.
        data: what to fill.
        key: random key.
    """

    def step(carry: tuple[EnvState, jax.Array], keys: jax.Array):
        state, running = carry
        action = jax.vmap(supervisor.act)(state, keys[0])
        pair = imitation.Pair(state.obs, action)
        after = jax.vmap(env.step)(state, action, running, keys[1])
        ended = after.violation | after.timeout | (after.success & (env.next_goal is None))
        if env.next_goal:
            renewed = jax.vmap(env.next_goal)(after, keys[2])
            after = where(after.success, renewed, after)
        return (where(running, after, state), running & ~ended), (pair, running)

    def episodes(carry: tuple[imitation.HumanData, jax.Array]):
        data, count = carry
        robots = (count * LANES + jnp.arange(LANES)) % config.num_robots
        keys = jax.random.split(jax.random.fold_in(key, count), 1 + LANES * (1 + 3 * env.spec.horizon))
        key_data, keys_reset, keys_steps = keys[0], keys[1 : 1 + LANES], keys[1 + LANES :]
        start = jax.vmap(env.reset)(keys_reset, robots)
        _, (pairs, valid) = jax.lax.scan(step, (start, ~start.violation), keys_steps.reshape(-1, 3, LANES))
        # Episode after episode, each in order of time.
        pairs, valid = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1).reshape(-1, *x.shape[2:]), (pairs, valid))
        valid &= data.pairs.added // config.augmented_copies + jnp.cumsum(valid) <= wanted
        return add(data, pairs, valid, key_data), count + 1

    wanted = config.num_demonstrations + config.extra_demonstrations
    copies = wanted * config.augmented_copies
    limit = jnp.minimum(copies, data.pairs.capacity)
    enough = TURNS * -(-config.num_robots // LANES)

    def unfinished(carry: tuple[imitation.HumanData, jax.Array]) -> jax.Array:
        added = carry[0].pairs.added
        return (added < limit) & ((added > 0) | (carry[1] < enough))

    data, _ = jax.lax.while_loop(unfinished, episodes, (data, jnp.int32(0)))
    return data._replace(dropped=jnp.asarray(copies - data.pairs.added, jnp.int32))


def collect_transitions(config: Config, env: Env, act, add, store: critic.CriticState, key: jax.Array) -> critic.CriticState:
    """Add at most `num_critic_transitions` steps of a fleet under noisy actions; who ends an episode is reset at once.

    They are fewer where robots start in violation, since these do not move.

    In fleets of more than `MOST_LANES` robots, that many move at a time, and the end of an episode is the next one's turn.

    Args:
        config: configuration.
        env: environment.
        act: `(EnvState[L], key) -> f32[L, A]`.
        add: the critic's `append`.
        store: the critic.
        key: random key.
    """
    num_lanes = min(config.num_robots, MOST_LANES)
    lanes = jnp.arange(num_lanes)

    def step(carry, keys):
        state, ended, store, count, robots = carry
        (key_act, key_noise), keys_env, keys_reset = keys[:2], keys[2 : 2 + num_lanes], keys[2 + num_lanes :]
        state = where(ended, jax.vmap(env.reset)(keys_reset, robots), state)
        action = disturb(config, env, act(state, key_act), key_noise)
        after = jax.vmap(env.step)(state, action, jnp.ones(num_lanes, bool), keys_env)
        transition = critic.Transition(state.obs, action, after.obs, after.violation, after.success)
        wanted = (count + lanes < config.num_critic_transitions) & ~state.violation
        store = add(store, transition, wanted)
        ended = state.violation | after.violation | after.timeout | after.success
        robots = jnp.where(ended, (robots + num_lanes) % config.num_robots, robots)
        return (after, ended, store, count + num_lanes, robots), None

    def burst(carry):
        keys = jax.random.split(jax.random.fold_in(key, carry[3]), (BURST, 2 * (1 + num_lanes)))
        return jax.lax.scan(step, carry, keys)[0]

    nobody = jax.tree.map(
        lambda x: jax.lax.full_like(x, 0, shape=(num_lanes, *x.shape)), jax.eval_shape(env.reset, key, jnp.int32(0))
    )
    start = (nobody, jnp.ones(num_lanes, bool), store, jnp.int32(0), lanes)
    unfinished = lambda carry: carry[3] < config.num_critic_transitions  # noqa: E731
    return jax.lax.while_loop(unfinished, burst, start)[2]


def disturb(config: Config, env: Env, action: jax.Array, key: jax.Array) -> jax.Array:
    """Add noise of deviation `critic_noise` to actions f32[L, A]; choose at random that often where they are discrete."""
    if not env.spec.discrete:
        return jnp.clip(action + config.critic_noise * jax.random.normal(key, action.shape), -1.0, 1.0)
    key_whether, key_what = jax.random.split(key)
    other = jax.nn.one_hot(jax.random.randint(key_what, action.shape[:1], 0, action.shape[1]), action.shape[1])
    return where(jax.random.uniform(key_whether, action.shape[:1]) < config.critic_noise, other, action)


def pretrain(
    config: Config, env: Env, learner: imitation.Learner, supervisor: supervisors.Supervisor, key: jax.Array
) -> tuple[imitation.PolicyState, imitation.HumanData]:
    """Return the policy and the data that the fleet starts with.

    Reference: paper, Section 5.2.
    """
    key_demos, key_init, key_policy = jax.random.split(key, 3)
    pretrains = priority.get_algorithm(config.algorithm).pretrains
    data = imitation.data_of(config, env.spec)
    if pretrains:
        data = collect_demonstrations(config, env, supervisor, learner.append, data, key_demos)
    if env.spec.image_shape:
        normalizer = pixel_normalizer(env.spec.observation_size)
    else:
        normalizer = fit_normalizer(data.pairs.rows.obs, data.pairs.size, enabled=config.normalize_observations)
    policy = learner.init(key_init, normalizer)
    if pretrains:
        keys = lambda i: jax.random.fold_in(key_policy, i)  # noqa: E731
        policy = jax.lax.fori_loop(0, config.pretraining_steps, lambda i, p: learner.update(p, data, keys(i))[0], policy)
    return policy, data
