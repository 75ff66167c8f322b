"""Physics: MuJoCo to the bit on the native backend, MJX close to it, and robots that leave each other alone."""

import functools
import subprocess
import sys

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from compiling import compiled
from record_states import FILE, count_contacts

from fleetjax import envs, supervisors
from fleetjax.physics import mjx, native
from fleetjax.physics.base import PhysicsState, make_physics, resolve_backend

SUBSTEPS = 3
NUM_ROBOTS = 32  # of every batch, so that MJX compiles once
BACKENDS = ("native", "mjx")


class Robots:
    """A batch of humanoids on one backend."""

    def __init__(self, backend: str):
        self.env = envs.make("humanoid", backend)
        self._step = compiled(jax.vmap(self.env.step, in_axes=(0, 0, 0, None)))

    def step(self, state: envs.base.EnvState, action, active=True) -> envs.base.EnvState:
        return self._step(state, action, jnp.broadcast_to(active, NUM_ROBOTS), jax.random.key(0))

    def move(self, physics: PhysicsState, action, active=True) -> PhysicsState:
        state = jax.vmap(envs.begin)(physics, jnp.zeros((NUM_ROBOTS, self.env.spec.observation_size)))
        return jax.tree.map(np.asarray, self.step(state, action, active).physics)


@functools.cache
def robots(backend: str) -> Robots:
    return Robots(backend)


@pytest.fixture(scope="module")
def recorded() -> tuple[PhysicsState, np.ndarray]:
    """128 states before a fall, the first half of them with three contacts or more, and an action for each."""
    with np.load(FILE) as arrays:
        fields = dict(arrays)
    action = fields.pop("action")
    return PhysicsState(**fields), action


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return make_physics("humanoid.xml", substeps=SUBSTEPS, backend="native").model


def rows(tree, index):
    return jax.tree.map(lambda x: x[index], tree)


def mixed(recorded):
    """Recorded states, half of each kind, and their actions, enough for a batch."""
    return rows(recorded, slice(64 - NUM_ROBOTS // 2, 64 + NUM_ROBOTS // 2))


def assert_same(tree, other):
    jax.tree.map(np.testing.assert_array_equal, tree, other)


def plain_mujoco(model, state, action):
    """Step one robot by MuJoCo alone."""
    data = mujoco.MjData(model)
    data.time, data.qpos[:], data.qvel[:] = state.time, state.qpos, state.qvel
    data.qacc_warmstart[:], data.ctrl[:] = state.warmstart, action
    for _ in range(SUBSTEPS):
        mujoco.mj_step(model, data)
    return data


def test_half_of_the_recorded_states_have_three_contacts(recorded, model):
    contacts = count_contacts(model, recorded[0].qpos)
    assert contacts.size >= 64
    assert np.sum(contacts >= 3) >= contacts.size / 2
    assert np.sum(contacts == 0) > 0


def test_native_is_mujoco(recorded, model):
    states, actions = mixed(recorded)
    after = robots("native").move(states, actions)
    for i in range(NUM_ROBOTS):
        data = plain_mujoco(model, rows(states, i), actions[i])
        got = rows(after, i)
        np.testing.assert_array_equal(got.qpos, data.qpos.astype(np.float32))
        np.testing.assert_array_equal(got.qvel, data.qvel.astype(np.float32))
        np.testing.assert_array_equal(got.sensors, data.sensordata.astype(np.float32))
        np.testing.assert_allclose(got.time, data.time, rtol=1e-6)
        np.testing.assert_allclose(got.warmstart, data.qacc_warmstart, rtol=1e-6, atol=1e-6)
    assert not after.diverged.any()


def test_mjx_agrees_with_native(recorded):
    """One control step; the largest error of a robot, over robots: median and 95th percentile.

    The bounds are three times what was measured or, for the tail, ten: a few states lie where a contact or a joint limit opens
    within rounding, or where the two solvers, stopped after two iterations, stand at different points.
    """
    errors = {name: [] for name in ("qpos", "qvel", "sensors", "warmstart")}
    for batch in np.split(np.arange(len(recorded[1])), len(recorded[1]) // NUM_ROBOTS):
        states, actions = rows(recorded, batch)
        one, other = (robots(backend).move(states, actions) for backend in BACKENDS)
        np.testing.assert_allclose(one.time, other.time, rtol=1e-6)
        for name, found in errors.items():
            found.append(np.abs(getattr(one, name) - getattr(other, name)).max(axis=1))
    bounds = {  # m and rad; m/s and rad/s; N and N m
        "qpos": (3e-6, 2e-4),
        "qvel": (2e-4, 2e-2),
        "sensors": (2e-2, 15.0),
        "warmstart": (3e-2, 5.0),
    }
    for name, (median, tail) in bounds.items():
        error = np.concatenate(errors[name])
        print(
            f"{name}: median {np.median(error):.1e}, 95th percentile {np.quantile(error, 0.95):.1e}, largest {error.max():.1e}"
        )
        assert np.median(error) < median, name
        assert np.quantile(error, 0.95) < tail, name


def walk(backend: str, num_steps: int):
    """Return for each robot the number of steps before it falls, under the expert and noise from none to much."""
    env = robots(backend).env
    supervisor = supervisors.make("humanoid", env)
    key_reset, key_noise = jax.random.split(jax.random.key(1))
    state = jax.vmap(env.reset)(jax.random.split(key_reset, NUM_ROBOTS), jnp.arange(NUM_ROBOTS))
    scale = np.linspace(0.0, 1.0, NUM_ROBOTS)[:, None]
    noise = scale * np.asarray(jax.random.normal(key_noise, (num_steps, NUM_ROBOTS, env.spec.action_size)))
    act = jax.jit(lambda state: jax.vmap(supervisor.act, in_axes=(0, None))(state, key_noise))
    upright, steps = np.ones(NUM_ROBOTS, bool), np.zeros(NUM_ROBOTS)
    for t in range(num_steps):
        state = robots(backend).step(state, np.clip(act(state) + noise[t], -1, 1), upright)
        upright &= ~np.asarray(state.violation)
        steps += upright
    return steps


def test_robots_fall_as_often_on_both_backends():
    """Share of falls within 200 steps, and steps before the fall: they differ by less than three standard errors."""
    one, other = (walk(backend, 200) for backend in BACKENDS)
    share, other_share = np.mean(one < 200), np.mean(other < 200)
    mean = (share + other_share) / 2
    print(f"falls: {share:.3f}, {other_share:.3f}; mean steps before them: {one.mean():.1f}, {other.mean():.1f}")
    assert 0 < mean < 1
    assert abs(share - other_share) < 3 * np.sqrt(2 * mean * (1 - mean) / NUM_ROBOTS)
    assert abs(one.mean() - other.mean()) < 3 * np.sqrt((one.var() + other.var()) / NUM_ROBOTS)


@pytest.mark.parametrize("backend", BACKENDS)
def test_inactive_robots_keep_their_state(backend, recorded):
    states, actions = mixed(recorded)
    states = states._replace(diverged=np.arange(NUM_ROBOTS) % 4 == 0)
    active = np.arange(NUM_ROBOTS) % 2 == 1
    after = robots(backend).move(states, actions, active)
    assert_same(rows(after, ~active), rows(states, ~active))
    assert not np.any(np.all(after.qpos[active] == states.qpos[active], axis=1))


@pytest.mark.parametrize("backend", BACKENDS)
def test_neighbours_do_not_matter(backend, recorded):
    states, actions = mixed(recorded)
    after = robots(backend).move(states, actions)
    others = np.roll(np.arange(NUM_ROBOTS), 7)
    assert_same(robots(backend).move(rows(states, others), actions[others]), rows(after, others))
    alone = np.arange(NUM_ROBOTS) == 5
    assert_same(rows(robots(backend).move(states, actions, alone), 5), rows(after, 5))


def test_number_of_threads_does_not_matter(monkeypatch, recorded):
    states, actions = mixed(recorded)
    results = []
    for threads in (1, 2, 5):
        monkeypatch.setenv("FLEETJAX_NUM_THREADS", str(threads))
        assert native.num_threads() == threads
        physics = make_physics("humanoid.xml", substeps=SUBSTEPS, backend="native")
        results.append(jax.jit(jax.vmap(physics.step))(states, actions, np.ones(NUM_ROBOTS, bool)))
    for result in results[1:]:
        assert_same(result, results[0])


SICK = {"control": 3, "velocity": 20, "position": 21}


def infect(states: PhysicsState, actions):
    """Return states and actions in which three robots are bound to diverge."""
    qpos, qvel, actions = states.qpos.copy(), states.qvel.copy(), actions.copy()
    actions[SICK["control"], 2] = np.nan
    qvel[SICK["velocity"], 10] = 1e12
    qpos[SICK["position"], 8] = np.inf
    return states._replace(qpos=qpos, qvel=qvel), actions


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_diverged_robot_keeps_its_last_state_and_spares_the_others(backend, recorded, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    states, actions = mixed(recorded)
    healthy = robots(backend).move(states, actions)
    sick_states, sick_actions = infect(states, actions)
    after = robots(backend).move(sick_states, sick_actions)
    sick = np.isin(np.arange(NUM_ROBOTS), list(SICK.values()))
    np.testing.assert_array_equal(after.diverged, sick)
    assert_same(rows(after._replace(diverged=sick_states.diverged), sick), rows(sick_states, sick))
    assert_same(rows(after, ~sick), rows(healthy, ~sick))
    assert list(tmp_path.iterdir()) == []  # MuJoCo's log would be here


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_diverged_robot_is_a_violation(backend, recorded):
    states, actions = mixed(recorded)
    actions = actions.copy()
    actions[SICK["control"]] = np.nan
    before = jax.vmap(envs.begin)(states, jnp.zeros((NUM_ROBOTS, robots(backend).env.spec.observation_size)))
    after = robots(backend).step(before, actions)
    assert after.violation[SICK["control"]]
    assert after.reward[SICK["control"]] == -1
    assert np.all(np.isfinite(after.obs))
    np.testing.assert_array_equal(after.physics.qpos[SICK["control"]], states.qpos[SICK["control"]])


LEG = """
<mujoco>
  <option timestep="0.005" integrator="Euler"><flag eulerdamp="disable"/></option>
  <worldbody>
    <body>
      <joint name="hip" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.05"/>
      <body pos="0 0 -0.3">
        <joint name="knee" axis="0 1 0" damping="0.1" stiffness="5" armature="0.01"/>
        <geom type="capsule" fromto="0 0 0 0.1 0 -0.3" size="0.04"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="knee" gear="20"/></actuator>
</mujoco>
"""


def test_mjx_is_differentiable_forwards():
    """On a smooth case, a leg that swings, the derivative of a control step equals central differences of MJX itself."""
    leg = mujoco.MjModel.from_xml_string(LEG)
    step = mjx.make_step(leg, SUBSTEPS)
    start = PhysicsState(
        qpos=jnp.asarray(leg.qpos0, jnp.float32).at[1].set(0.4),
        qvel=jnp.linspace(-0.5, 0.5, leg.nv),
        act=jnp.zeros(0),
        warmstart=jnp.zeros(leg.nv),
        sensors=jnp.zeros(0),
        time=jnp.zeros(()),
        diverged=jnp.zeros((), bool),
    )

    def move(shift):
        position, velocity, control = shift[0], shift[1:3], shift[3:]
        state = start._replace(qpos=start.qpos.at[1].add(position), qvel=start.qvel + velocity)
        after = step(state, control, True)
        return jnp.concatenate([after.qpos, after.qvel])

    directions = jnp.eye(4)
    derive = compiled(jax.vmap(lambda *point: jax.jvp(move, point[:1], point[1:])))
    forward, derivative = derive(0.05 * directions, 0 * directions)[0], derive(0 * directions, directions)[1]
    backward = derive(-0.05 * directions, 0 * directions)[0]
    differences = (forward - backward) / 0.1
    assert np.all(np.isfinite(derivative))
    assert np.abs(derivative[3]).max() > 0.1  # the motor matters
    np.testing.assert_allclose(derivative, differences, rtol=2e-2, atol=2e-3)


def test_backends_are_resolved():
    assert resolve_backend("auto") == ("native" if jax.default_backend() == "cpu" else "mjx")
    with pytest.raises(ValueError, match="backend = 'cuda' is unknown; choose one of auto, native, mjx"):
        make_physics("humanoid.xml", substeps=SUBSTEPS, backend="cuda")


def test_native_refuses_implicit_damping():
    implicit = mujoco.MjModel.from_xml_string(LEG.replace('<flag eulerdamp="disable"/>', ""))
    with pytest.raises(ValueError, match="eulerdamp disabled"):
        native.make_step(implicit, SUBSTEPS)


def test_importing_mjx_prints_nothing():
    command = [sys.executable, "-c", "import fleetjax.physics.mjx"]
    assert subprocess.run(command, capture_output=True, check=True, text=True).stdout == ""
