"""Fleets on other hardware: every environment's program lowers for GPUs and TPUs, with no part left to the host.

That a program lowers does not say that it runs there, or how fast.
"""

import jax
import pytest

import fleetjax
from fleetjax import envs

FLEET = {"num_robots": 4, "num_humans": 2, "num_steps": 20, "num_demonstrations": 300, "critic_capacity": 400}


@pytest.mark.slow
@pytest.mark.parametrize("environment", envs.list_envs())
def test_every_fleet_lowers_for_accelerators(environment):
    config = fleetjax.make_config(environment, "cur", **FLEET, backend="mjx")
    traced = jax.jit(fleetjax.run).trace(config, jax.random.key(0))
    for platform in ("cuda", "tpu"):
        program = traced.lower(lowering_platforms=(platform,)).as_text()
        assert "stablehlo.while" in program
        assert "callback" not in program


def test_the_native_backend_takes_the_host():
    config = fleetjax.make_config("humanoid", "expert", num_robots=2, num_humans=2, num_steps=4, backend="native")
    assert "callback" in jax.jit(fleetjax.run).trace(config, jax.random.key(0)).lower().as_text()
