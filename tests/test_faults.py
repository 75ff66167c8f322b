"""Seeded faults: each makes the comparison with the NumPy oracle fail, in the quantity that it should spoil."""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import pytest
import toy_envs
from compiling import compiled
from reference import recording

import fleetjax
from fleetjax import allocation, fleet
from fleetjax.envs import Env
from fleetjax.fleet import Fleet, make_fleet
from fleetjax.learning import critic, imitation
from fleetjax.priority import base
from fleetjax.types import HumanState

pytestmark = pytest.mark.usefixtures("toy_supervisors")

FALLS_AT = [7, 7, 7, 11, 0, 13]
SUCCEEDS_AT = [0, 0, 0, 0, 6, 0]
FAULTS: dict[str, tuple[Callable[..., Fleet], str, str]] = {}


def fault(algorithm: str, spoils: str):
    """Add a fault: `(monkeypatch, config, env) -> Fleet`, seen with `algorithm` as a difference in `spoils` (a pattern)."""

    def add(seed):
        FAULTS[seed.__name__] = (seed, algorithm, spoils)
        return seed

    return add


@fault("cu", "metric hard_resets")
def a_reset_one_step_late(patch, config, env):
    late = make_fleet(config.replace(hard_reset_time=config.hard_reset_time + 1), env)
    return make_fleet(config, env)._replace(advance=late.advance)


@fault("cu", "allocation")
def a_lock_off_by_one(patch, config, env):
    real = base.allocate
    patch.setattr(base, "allocate", lambda score, humans, min_time, *rest: real(score, humans, min_time - 1, *rest))
    return make_fleet(config, env)


@fault("cu", "allocation|durations")
def type_judged_before_the_lock(patch, config, env):
    real = make_fleet(config, env)

    def plan(state, *rest):
        helped = allocation.helper_of(state.humans, config.num_robots) >= 0
        return real.plan(state._replace(resetting=helped & state.env.violation), *rest)

    return real._replace(plan=plan)


@fault("cu", "durations")
def clock_goes_on_when_the_type_changes(patch, config, env):
    patch.setattr(fleet, "restart_clocks", lambda humans, *rest: humans)
    return make_fleet(config, env)


@fault("c", "allocation")
def ties_broken_by_index(patch, config, env):
    patch.setattr(allocation, "tie_order", lambda key, n: jnp.arange(n))
    return make_fleet(config, env)


@fault("cu", "allocation")
def free_human_left_assigned(patch, config, env):
    real = base.allocate

    def allocate(score, humans, *rest):
        new = real(score, humans, *rest)
        taken = allocation.helper_of(new, config.num_robots) >= 0
        lingers = (new.robot < 0) & (humans.robot >= 0) & ~taken[humans.robot]
        return HumanState(jnp.where(lingers, humans.robot, new.robot), jnp.where(lingers, humans.duration, new.duration))

    patch.setattr(base, "allocate", allocate)
    return make_fleet(config, env)


@fault("cu", "allocation|durations")
def human_not_kept_on_its_robot(patch, config, env):
    real = base.allocate

    def allocate(score, humans, min_time, *rest):
        unlocked = humans.duration >= min_time[humans.robot]
        forgetful = HumanState(jnp.where(unlocked, -1, humans.robot), jnp.where(unlocked, 0, humans.duration))
        return real(score, forgetful, min_time, *rest)

    patch.setattr(base, "allocate", allocate)
    return make_fleet(config, env)


@fault("cu", "allocation")
def zero_priority_helped(patch, config, env):
    real = base.allocate
    patch.setattr(base, "allocate", lambda score, *rest: real(score + 1e-3, *rest))
    return make_fleet(config, env)


@fault("cu", "allocation")
def humans_who_are_not_there_assigned(patch, config, env):
    real = base.allocate
    patch.setattr(base, "allocate", lambda score, humans, min_time, key, *rest: real(score, humans, min_time, key))
    return make_fleet(config, env)


@fault("cu", "scores")
def initial_period_ignored(patch, config, env):
    return make_fleet(config.replace(initial_period=0), env)


@fault("cu", "metric idle")
def idle_counted_after_the_reset(patch, config, env):
    real = make_fleet(config, env)

    def advance(*args):
        state, metrics = real.advance(*args)
        return state, metrics._replace(idle=jnp.sum(state.env.violation, dtype=jnp.int32))

    return real._replace(advance=advance)


@fault("cu", "allocation kept")
def human_freed_by_a_soft_reset(patch, config, env):
    real = make_fleet(config, env)

    def advance(*args):
        state, metrics = real.advance(*args)
        restarted = (state.env.episode_step == 0)[state.humans.robot] & ~state.resetting[state.humans.robot]
        humans = state.humans._replace(robot=jnp.where(restarted, -1, state.humans.robot))
        return state._replace(humans=humans), metrics

    return real._replace(advance=advance)


@fault("cu", "number of human data")
def pair_recorded_that_nobody_gave(patch, config, env):
    real = imitation.append
    patch.setattr(imitation, "append", lambda data, pairs, mask, key, choice=None: real(data, pairs, jnp.ones_like(mask), key))
    return make_fleet(config, env)


@fault("cu", "state physics|state reward|metric reward")
def action_taken_of_a_supervisor_who_gave_none(patch, config, env):
    real = make_fleet(config, env)

    def advance(state, plan, human_action, given, key):
        return real.advance(state, plan, human_action, jnp.ones_like(given), key)

    return real._replace(advance=advance)


@fault("cu", "resampled pairs")
def one_bootstrap_shared_by_all_members(patch, config, env):
    real = imitation.append

    def append(*args):
        data = real(*args)
        return data._replace(resample=jnp.broadcast_to(data.resample[:, :1], data.resample.shape))

    patch.setattr(imitation, "append", append)
    return make_fleet(config, env)


@fault("cur", "safety critic's negatives: next_obs")
def next_state_taken_after_the_reset(patch, config, env):
    def step(state, action, active, key):
        after = env.step(state, action, active, key)
        fresh = env.reset(key, state.physics["robot"])
        ended = after.success | after.timeout
        return after._replace(obs=jnp.where(ended, fresh.obs, after.obs))

    return make_fleet(config, env._replace(step=step))


@fault("cur", "number of safety critic's positives")
def critic_learns_from_robots_that_stand_still(patch, config, env):
    real = critic.make_critic

    def make_critic(*args):
        parts = real(*args)
        return parts._replace(append=lambda state, steps, mask: parts.append(state, steps, jnp.ones_like(mask)))

    patch.setattr(critic, "make_critic", make_critic)
    return make_fleet(config, env)


ENV = toy_envs.scripted(FALLS_AT, SUCCEEDS_AT, horizon=20)


@functools.cache
def start(algorithm: str) -> tuple[fleetjax.Config, fleetjax.FleetState]:
    """Return configuration and first state of six robots that fall and succeed on schedule, and their two humans."""
    config = fleetjax.make_config(
        ENV,
        algorithm,
        num_robots=6,
        num_humans=2,
        num_steps=60,
        min_teleop_time=4,
        hard_reset_time=3,
        initial_period=12,
        uncertainty_threshold=0.1,  # about half of what these networks report lies above
        hidden_sizes=(2,),
        ensemble_size=2,
        gradient_steps=0,
        batch_size=4,
        num_demonstrations=4,
        critic_capacity=1000,
    )
    return config, compiled(lambda key: recording.start(config, ENV, key))(jax.random.key(4))


def run_against_the_oracle(algorithm: str, make: Callable[[fleetjax.Config, Env], Fleet]) -> recording.Trace:
    """Run the fleet that `make` builds, compare it with the oracle, and return its trace."""
    config, first = start(algorithm)

    def run(config, first, key):
        return recording.record(config, ENV, make(config, ENV), first, key, absence=0.05, silence=0.2)

    trace = compiled(run)(config, first, jax.random.key(0))
    recording.compare(config, ENV, trace)
    return trace


@pytest.mark.parametrize("algorithm", ["cu", "cur"])
def test_without_a_fault_the_fleet_agrees_with_the_oracle(algorithm):
    trace = run_against_the_oracle(algorithm, make_fleet)
    assert int(trace.metrics.hard_resets.sum()) > 3
    assert int(trace.metrics.teleop_steps.sum()) > 20


@pytest.mark.parametrize("name", FAULTS)
def test_fault_is_caught(name, monkeypatch):
    seed, algorithm, spoils = FAULTS[name]
    with pytest.raises(AssertionError, match=f"^({spoils}).* differs at t ="):
        run_against_the_oracle(algorithm, lambda config, env: seed(monkeypatch, config, env))
