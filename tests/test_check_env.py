"""What an author of an environment gets wrong is told in words."""

import jax.numpy as jnp
import pytest
import toy_envs

import fleetjax
from fleetjax import envs

pytestmark = pytest.mark.usefixtures("toy_supervisors")

QUICK = ("navigation", "humanoid")  # the others are slow tests
GOOD = toy_envs.scripted([5, 0, 0, 0], [3, 0, 0, 0], horizon=20, new_goals=True)


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name not in QUICK)) for name in fleetjax.list_envs()]
)
def test_environments_that_ship_pass(name):
    fleetjax.check_env(envs.make(name))


def test_toys_pass():
    fleetjax.check_env(GOOD)
    fleetjax.check_env(GOOD._replace(success_margin=lambda state: jnp.where(state.success, 1.0, -1.0)))
    fleetjax.check_env(toy_envs.scripted([0] * 4, [0] * 4, horizon=7))


def stepping(change):
    """Return the toy with its step's result changed by `(before, after) -> after`."""

    def step(state, action, active, key):
        return change(state, GOOD.step(state, action, active, key))

    return GOOD._replace(step=step)


def resetting(change):
    return GOOD._replace(reset=lambda key, robot: change(GOOD.reset(key, robot)))


def in_spec(**facts):
    return GOOD._replace(spec=GOOD.spec._replace(**facts))


FAULTY = {
    "horizon": (in_spec(horizon=0), r"spec\.horizon = 0 must be above 0"),
    "image": (in_spec(image_shape=(2, 2, 3)), r"must have spec\.observation_size = 3 pixel values"),
    "goal": (in_spec(has_goal=False), r"spec\.has_goal must be True"),
    "observation": (in_spec(observation_size=4), r"obs must be float32\[4\], by spec\.observation_size, and is float32\[3\]"),
    "supervisor": (in_spec(supervisor="nobody"), "supervisor = 'nobody' is unknown"),
    "no state": (resetting(lambda state: state.obs), "reset must return an EnvState"),
    "reset fails": (resetting(lambda state: 1 / 0), r"reset\(key, robot\) fails: division by zero"),
    "flag": (resetting(lambda state: state._replace(success=jnp.float32(0))), r"success must be bool\[\] after a reset"),
    "step fails": (stepping(lambda a, b: b.missing), r"step\(state, action, active, key\) fails: .*missing"),
    "type": (
        stepping(lambda a, b: b._replace(physics=b.physics | {"clock": jnp.float32(1)})),
        r"must keep shapes and types: physics\['clock'\] is int32\[\] after a reset, and float32\[\] then",
    ),
    "structure": (stepping(lambda a, b: b._replace(physics=())), "must return a state of the structure that reset returns"),
    "begun": (resetting(lambda state: state._replace(episode_step=jnp.int32(3))), "reset must set reward, success, timeout"),
    "not finite": (stepping(lambda a, b: b._replace(obs=b.obs * jnp.nan)), "obs must stay finite"),
    "resets itself": (
        stepping(lambda a, b: b._replace(episode_step=b.episode_step % 4)),
        "step must add 1 to episode_step.* never reset by itself",
    ),
    "both": (stepping(lambda a, b: b._replace(success=b.violation)), "a violation beats success"),
    "no time-out": (
        stepping(lambda a, b: b._replace(timeout=jnp.bool_(False))),
        r"reaches spec\.horizon = 20 must set timeout",
    ),
    "margin": (
        GOOD._replace(success_margin=lambda state: jnp.float32(-1)),
        "success_margin must be above 0 where a step set success",
    ),
    "early": (stepping(lambda a, b: b._replace(timeout=~b.violation)), r"timeout must not be set before spec\.horizon = 20"),
}


@pytest.mark.parametrize("name", FAULTY)
def test_a_fault_is_named(name):
    env, told = FAULTY[name]
    with pytest.raises(ValueError, match=r"environment = 'scripted' does not meet the contract:\n- (.*\n)*.*" + told):
        fleetjax.check_env(env)
