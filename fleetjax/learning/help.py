"""Estimators that learn from human data when help is due: discrepancies, proxy value of interventions, energies."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from fleetjax.config import Config
from fleetjax.envs import Env
from fleetjax.field import PARAMETERS
from fleetjax.learning import buffer
from fleetjax.learning.critic import Transition
from fleetjax.learning.estimator import Estimator, Step
from fleetjax.learning.imitation import HumanData, Learner, Pair, PolicyState, stored_obs
from fleetjax.learning.networks import ADAM, descend, make_network
from fleetjax.supervisors import Supervisor
from fleetjax.tree import take

MEMBERS = 2  # energy models
PROPOSALS = 8  # actions among which they tell the human's, or each other, apart
FEWER = 4  # a batch of theirs is a quarter of the policy's: each pair is seen beside all its proposals
NEAR = 0.2  # standard deviation of the half of them that lie about the robot's action


class Trained(NamedTuple):
    """Parameters of a network, and its optimizer's state."""

    params: Any
    opt_state: Any


def _begin(params: Any) -> Trained:
    return Trained(params, ADAM.init(params))


def _descend(trained: Trained, loss: Any, learning_rate: jax.Array | float) -> Trained:
    return Trained(*descend(trained.params, jax.grad(loss)(trained.params), trained.opt_state, learning_rate))


def _draw(data: HumanData, key: jax.Array, number: int) -> tuple[Pair, jax.Array]:
    """Return pairs [B] of all human data, and f32[], 1, or 0 if there are none."""
    pairs = take(data.pairs.rows, buffer.draw_index(key, (number,), data.pairs.size))
    return pairs, (data.pairs.size > 0).astype(jnp.float32)


def _repeat(update: Any, config: Config, key: jax.Array, state: Any, policy: PolicyState, data: HumanData) -> Any:
    """Return the state after `critic_pretraining_steps` updates on the demonstrations."""
    step = lambda i, state: update(state, policy, data, jax.random.fold_in(key, i))  # noqa: E731
    return jax.lax.fori_loop(0, config.critic_pretraining_steps, step, state)


def make_discrepancy(config: Config, env: Env, learner: Learner, supervisor: Supervisor) -> Estimator:
    """Chance that the robot's action differs from the human's by more than `discrepancy_tau`, in mean square.

    A classifier of observations. Its labels compare the human's actions in all human data with what the policy does there
    now. For an algorithm without the parameter `discrepancy_tau` it is 0.0025.

    Reference: Zhang and Cho, SafeDAgger, 2017; Hoque et al., LazyDAgger, 2021 (Section IV).
    """
    del supervisor
    network = make_network(env.spec, config.hidden_sizes, 1)
    tau = config.parameters.get("discrepancy_tau", PARAMETERS["safe_dagger"]["discrepancy_tau"].default)

    def init(key: jax.Array, data: HumanData, policy: PolicyState) -> Trained:
        key_network, key_train = jax.random.split(key)
        fresh = _begin(network.init(key_network, jnp.zeros(env.spec.observation_size)))
        return _repeat(update, config, key_train, fresh, policy, data)

    def value(state: Trained, policy: PolicyState, obs: jax.Array, robot_action: jax.Array) -> jax.Array:
        del robot_action
        return jax.nn.sigmoid(network.apply(state.params, policy.normalizer(obs))[..., 0])

    def update(state: Trained, policy: PolicyState, data: HumanData, key: jax.Array) -> Trained:
        pairs, known = _draw(data, key, config.batch_size)
        robot_action, _ = learner.predict(policy, pairs.obs)
        label = (jnp.mean((robot_action - pairs.action) ** 2, axis=-1) > tau).astype(jnp.float32)

        def loss(params: Any) -> jax.Array:
            logit = network.apply(params, policy.normalizer(pairs.obs))[..., 0]
            return known * jnp.mean(optax.sigmoid_binary_cross_entropy(logit, label))

        return _descend(state, loss, config.learning_rate)

    return Estimator(init, value, lambda state, steps, moving: state, update)


def make_mean_discrepancy(config: Config, env: Env, learner: Learner, supervisor: Supervisor) -> Estimator:
    """Mean squared difference between robot's and human's action over a batch of all human data, the same for every robot.

    It is computed anew at each gradient step, for the policy that there is then.

    Reference: Hoque et al., ThriftyDAgger, 2021: the threshold at which humans hand back.
    """
    del env, supervisor

    def mean(policy: PolicyState, data: HumanData, key: jax.Array) -> jax.Array:
        pairs, known = _draw(data, key, config.batch_size)
        return known * jnp.mean((learner.predict(policy, pairs.obs)[0] - pairs.action) ** 2)

    return Estimator(
        init=lambda key, data, policy: mean(policy, data, key),
        value=lambda state, policy, obs, robot_action: jnp.full(obs.shape[0], state),
        append=lambda state, steps, moving: state,
        update=lambda state, policy, data, key: mean(policy, data, key),
    )


class Proxy(NamedTuple):
    """A network, its slow copy, and a ring of the fleet's transitions."""

    trained: Trained
    target: Any
    transitions: buffer.Buffer


def make_intervention(config: Config, env: Env, learner: Learner, supervisor: Supervisor) -> Estimator:
    """Proxy value of the robot's action: -1 where a human did it, +1 where a human would correct it.

    On human data Q(o, a_h) is drawn to -1, and Q(o, a_r) to +1 where mean (a_r - a_h)^2 is above its mean in the batch. On the
    fleet's transitions Q(o, a) is drawn to `goal_discount` Q'(o', policy(o')), or 0 after a violation or success. The original
    has the maximum over actions in place of the policy's action.

    Reference: Adaptive Intervention Mechanism (AIM), 2025; reimplemented from the text. Its two episodes of warm-up are
    `critic_pretraining_steps` gradient steps on the demonstrations.
    """
    del supervisor
    spec = env.spec
    network = make_network(spec, config.hidden_sizes, 1)

    def proxy(params: Any, policy: PolicyState, obs: jax.Array, action: jax.Array) -> jax.Array:
        return network.apply(params, jnp.concatenate([policy.normalizer(obs), action], axis=-1))[..., 0]

    def init(key: jax.Array, data: HumanData, policy: PolicyState) -> Proxy:
        key_network, key_train = jax.random.split(key)
        params = network.init(key_network, jnp.zeros(spec.observation_size + spec.action_size))
        flag, obs = jnp.zeros((), bool), stored_obs(spec)
        example = Transition(obs, jnp.zeros(spec.action_size), obs, flag, flag)
        fresh = Proxy(_begin(params), jax.tree.map(jnp.copy, params), buffer.create(example, config.critic_capacity))
        return _repeat(update, config, key_train, fresh, policy, data)

    def value(state: Proxy, policy: PolicyState, obs: jax.Array, robot_action: jax.Array) -> jax.Array:
        return proxy(state.trained.params, policy, obs, robot_action)

    def append(state: Proxy, steps: Step, moving: jax.Array) -> Proxy:
        transitions = Transition(*steps[: len(Transition._fields)])
        return state._replace(transitions=buffer.append(state.transitions, transitions, moving, overwrite=True))

    def update(state: Proxy, policy: PolicyState, data: HumanData, key: jax.Array) -> Proxy:
        key_pairs, key_steps = jax.random.split(key)
        pairs, known = _draw(data, key_pairs, config.batch_size)
        robot_action, _ = learner.predict(policy, pairs.obs)
        apart = jnp.mean((robot_action - pairs.action) ** 2, axis=-1)
        corrected = (apart > jnp.mean(apart)).astype(jnp.float32)
        index = buffer.draw_index(key_steps, (config.batch_size,), state.transitions.size)
        steps, moved = buffer.read(state.transitions, index), (state.transitions.size > 0).astype(jnp.float32)
        ahead = proxy(state.target, policy, steps.next_obs, learner.predict(policy, steps.next_obs)[0])
        target = jnp.where(steps.violation | steps.success, 0.0, config.goal_discount * ahead)

        def loss(params: Any) -> jax.Array:
            good = (proxy(params, policy, pairs.obs, pairs.action) + 1.0) ** 2
            bad = corrected * (proxy(params, policy, pairs.obs, robot_action) - 1.0) ** 2
            behind = (proxy(params, policy, steps.obs, steps.action) - target) ** 2
            return known * jnp.mean(good + bad) + moved * jnp.mean(behind)

        trained = _descend(state.trained, loss, config.learning_rate)
        slow = optax.incremental_update(trained.params, state.target, config.target_rate)
        return state._replace(trained=trained, target=slow)

    return Estimator(init, value, append, update)


def jeffreys(energies: jax.Array) -> jax.Array:
    """Return f32[...], the Jeffreys divergence of the two softmaxes of -`energies` f32[2, ..., P] over P proposals."""
    logs = jax.nn.log_softmax(-energies, axis=-1)
    return jnp.sum((jnp.exp(logs[0]) - jnp.exp(logs[1])) * (logs[0] - logs[1]), axis=-1)


def make_divergence(config: Config, env: Env, learner: Learner, supervisor: Supervisor) -> Estimator:
    """Jeffreys divergence of two energy models of the human's action: sum_a (p_1 - p_2) (log p_1 - log p_2).

    p_k(a) is the softmax of -E_k(o, a) over proposed actions: half of them about the robot's action, half anywhere. Each model
    learns by telling the human's action from proposals (InfoNCE), on its own bootstrap of the human data where the policy is
    an ensemble, else on the same. The original samples actions from each model's own distribution.

    Reference: Datta et al., IIFL, 2023; Florence et al., Implicit behavioral cloning, 2021.
    """
    del supervisor
    spec = env.spec
    network = make_network(spec, config.hidden_sizes, 1)

    def propose(robot_action: jax.Array, key: jax.Array) -> jax.Array:
        """f32[..., P, A] actions."""
        lead, half = robot_action.shape[:-1], PROPOSALS // 2
        key_near, key_far = jax.random.split(key)
        if spec.discrete:
            every = jnp.eye(spec.action_size)
            return jnp.broadcast_to(every, (*lead, *every.shape))
        noise = NEAR * jax.random.normal(key_near, (*lead, half, spec.action_size))
        near = jnp.clip(robot_action[..., None, :] + noise, -1.0, 1.0)
        return jnp.concatenate([near, jax.random.uniform(key_far, noise.shape, minval=-1.0)], axis=-2)

    def energy(params: Any, obs: jax.Array, actions: jax.Array) -> jax.Array:
        """f32[..., P] of one model, for normalised observations f32[..., O] and actions f32[..., P, A]."""
        same = jnp.broadcast_to(obs[..., None, :], (*actions.shape[:-1], obs.shape[-1]))
        return network.apply(params, jnp.concatenate([same, actions], axis=-1))[..., 0]

    def init(key: jax.Array, data: HumanData, policy: PolicyState) -> Trained:
        key_network, key_train = jax.random.split(key)
        inputs = jnp.zeros(spec.observation_size + spec.action_size)
        params = jax.vmap(lambda k: network.init(k, inputs))(jax.random.split(key_network, MEMBERS))
        return _repeat(update, config, key_train, _begin(params), policy, data)

    def value(state: Trained, policy: PolicyState, obs: jax.Array, robot_action: jax.Array) -> jax.Array:
        # The same noise at every timestep: what changes is what the models say.
        actions = propose(robot_action, jax.random.key(0))
        energies = jax.vmap(energy, (0, None, None))(state.params, policy.normalizer(obs), actions)
        return jeffreys(energies)

    def update(state: Trained, policy: PolicyState, data: HumanData, key: jax.Array) -> Trained:
        key_pairs, key_actions = jax.random.split(key)
        draw = buffer.draw_index(key_pairs, (MEMBERS, max(config.batch_size // FEWER, 1)), data.pairs.size)
        columns = jnp.arange(MEMBERS)[:, None] % data.resample.shape[1]
        pairs = take(data.pairs.rows, data.resample[draw, columns])
        known = (data.pairs.size > 0).astype(jnp.float32)
        robot_action, _ = learner.predict(policy, pairs.obs)
        others = propose(robot_action, key_actions)
        obs = policy.normalizer(pairs.obs)

        def loss(params: Any) -> jax.Array:
            good = jax.vmap(energy)(params, obs, pairs.action[..., None, :])
            bad = jax.vmap(energy)(params, obs, others)
            if spec.discrete:  # the human's action is one of them
                return known * jnp.mean(good[..., 0] + jax.nn.logsumexp(-bad, axis=-1))
            return known * -jnp.mean(jax.nn.log_softmax(-jnp.concatenate([good, bad], axis=-1), axis=-1)[..., 0])

        return _descend(state, loss, config.learning_rate)

    return Estimator(init, value, lambda state, steps, moving: state, update)
