"""Fleets on other hardware: every environment's program lowers for GPUs and TPUs, with no part left to the host.

That a program lowers does not say that it runs there, or how fast.
"""

import jax
import numpy as np
import pytest

import fleetjax
from fleetjax import checks, envs

FLEET = {"num_robots": 4, "num_humans": 2, "num_steps": 20, "num_demonstrations": 300, "critic_capacity": 400}


@pytest.mark.slow
@pytest.mark.parametrize(
    "environment",
    [pytest.param(x, marks=[pytest.mark.long] * (x in ("anymal", "allegro_hand"))) for x in envs.list_envs()],
)
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


@pytest.mark.parametrize("environment", ["navigation", pytest.param("humanoid", marks=pytest.mark.slow)])
def test_a_robot_takes_the_bytes_of_the_formula(environment):
    used = []
    for num_robots in (4000, 8000):
        sizes = {"num_robots": num_robots, "num_humans": 10, "num_steps": 10, "num_demonstrations": 1000}
        config = fleetjax.make_config(environment, "uc", critic_capacity=20_000, human_capacity=20_000, **sizes)
        state = checks.state_shapes(config, envs.make(environment, config.backend))
        found = jax.jit(fleetjax.run).lower(config, jax.random.key(0), state).compile().memory_analysis()
        used.append(found.argument_size_in_bytes + found.output_size_in_bytes + found.temp_size_in_bytes)
    np.testing.assert_allclose(checks.robot_bytes(config, state), (used[1] - used[0]) / 4000, rtol=0.1)
