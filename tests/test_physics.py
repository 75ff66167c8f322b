"""Physics: MuJoCo to the bit on the native backend, MJX close to it, and robots that leave each other alone."""

import functools
import importlib.util
import subprocess
import sys

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from agreement import NUM_ROBOTS, assert_agree_with_native, mixed, mover, recorded, rows
from commands import refused
from compiling import compiled
from record_states import ROBOTS, count_contacts, make_policy, physics_of

import fleetjax
from fleetjax.physics import mjx, native
from fleetjax.physics.base import PhysicsState, check_backend, make_physics, resolve_backend

BACKENDS = ("native", "mjx")
QUICK = "anymal"  # MJX takes long to compile a robot, and this one least of all: the others are among the long tests


def test_a_model_of_ones_own_is_loaded_by_its_absolute_path(tmp_path):
    joint = '<body><joint type="slide"/><geom size="0.1"/></body>'
    option = '<option timestep="0.01"><flag eulerdamp="disable"/></option>'
    path = tmp_path / "slide.xml"
    path.write_text(f"<mujoco>{option}<worldbody>{joint}</worldbody></mujoco>")
    physics = make_physics(str(path), substeps=3, backend="native")
    assert physics.model.nq == 1
    assert physics.control_step == pytest.approx(0.03)


each_robot = pytest.mark.parametrize("name", ROBOTS)
each_robot_and_backend = pytest.mark.parametrize(
    ("name", "backend"),
    [
        pytest.param(name, backend, marks=[pytest.mark.long] if backend == "mjx" and name != QUICK else [])
        for name in ROBOTS
        for backend in BACKENDS
    ],
)


def assert_same(tree, other):
    jax.tree.map(np.testing.assert_array_equal, tree, other)


def plain_mujoco(name, state, control):
    """Step one robot by MuJoCo alone."""
    model = physics_of(name).model
    data = mujoco.MjData(model)
    data.time, data.qpos[:], data.qvel[:] = state.time, state.qpos, state.qvel
    data.qacc_warmstart[:], data.ctrl[:] = state.warmstart, control
    for _ in range(ROBOTS[name].module.SUBSTEPS):
        mujoco.mj_step(model, data)
    return data


@each_robot
def test_half_of_the_recorded_states_have_three_contacts(name):
    contacts = count_contacts(physics_of(name).model, recorded(name)[0].qpos)
    assert contacts.size >= 64
    assert np.sum(contacts >= 3) >= contacts.size / 2
    assert np.sum(contacts == 0) > 0


@each_robot
def test_native_is_mujoco(name):
    states, controls = mixed(name)
    after = mover(name, "native")(states, controls)
    for i in range(NUM_ROBOTS):
        data = plain_mujoco(name, rows(states, i), controls[i])
        got = rows(after, i)
        np.testing.assert_array_equal(got.qpos, data.qpos.astype(np.float32))
        np.testing.assert_array_equal(got.qvel, data.qvel.astype(np.float32))
        np.testing.assert_array_equal(got.sensors, data.sensordata.astype(np.float32))
        np.testing.assert_allclose(got.time, data.time, rtol=1e-6)
        np.testing.assert_allclose(got.warmstart, data.qacc_warmstart, rtol=1e-6, atol=1e-6)
    assert not after.diverged.any()


@each_robot
def test_the_number_of_threads_changes_no_bit(name, monkeypatch):
    states, controls = mixed(name)
    expected = states
    for _ in range(5):
        expected = mover(name, "native")(expected, controls)
    for threads in ("1", "2", "3"):
        monkeypatch.setenv("FLEETJAX_NUM_THREADS", threads)
        step = compiled(jax.vmap(make_physics(f"{name}.xml", substeps=ROBOTS[name].module.SUBSTEPS, backend="native").step))
        after = states
        for _ in range(5):
            after = jax.tree.map(np.asarray, step(after, controls, jnp.ones(NUM_ROBOTS, bool)))
        assert_same(after, expected)


@pytest.mark.slow
@each_robot
def test_mjx_agrees_with_native(name):
    """The tail is wide: a few states lie where a contact or a joint limit opens within rounding, or where the two engines place
    the contacts of a box differently, or where two solvers, stopped after few iterations, stand at different points.
    """
    assert_agree_with_native(name, "mjx")


@pytest.mark.slow
@each_robot
def test_warp_agrees_with_native(name):
    """On a CPU, too, though users need a GPU for it: there Warp is slow."""
    pytest.importorskip("warp", reason='needs pip install "fleetjax[warp]"')
    assert_agree_with_native(name, "warp")


@pytest.mark.slow
def test_warp_steps_fleets_side_by_side_and_contains_divergence():
    pytest.importorskip("warp", reason='needs pip install "fleetjax[warp]"')
    states, controls = mixed(QUICK)
    healthy = mover(QUICK, "warp")(states, controls)
    sick_states, sick_controls = infect(states, controls)
    after = mover(QUICK, "warp")(sick_states, sick_controls, np.arange(NUM_ROBOTS) != 0)
    sick = np.isin(np.arange(NUM_ROBOTS), list(SICK.values()))
    np.testing.assert_array_equal(after.diverged, sick)
    assert_same(rows(after._replace(diverged=sick_states.diverged), sick), rows(sick_states, sick))
    assert_same(rows(after, 0), rows(states, 0))
    others = ~sick & (np.arange(NUM_ROBOTS) > 0)
    close = functools.partial(np.testing.assert_allclose, rtol=1e-3, atol=1e-3)
    jax.tree.map(close, rows(after, others), rows(healthy, others))
    halves = jax.tree.map(lambda x: x.reshape(2, NUM_ROBOTS // 2, *x.shape[1:]), (states, controls, np.ones(NUM_ROBOTS, bool)))
    two_fleets = jax.jit(jax.vmap(jax.vmap(physics_of(QUICK, "warp").step)))(*halves)
    again = jax.tree.map(lambda x: np.reshape(x, (NUM_ROBOTS, *x.shape[2:])), two_fleets)
    jax.tree.map(close, again, healthy)


@functools.cache
def actor(name: str, backend: str):
    """Return an environment, and `(states, actions, active, key) -> states` of a batch of its robots."""
    env = ROBOTS[name].module.make_env(backend=backend)
    return env, compiled(jax.vmap(env.step, in_axes=(0, 0, 0, None)))


def starts(env, key):
    return jax.vmap(env.reset)(jax.random.split(key, NUM_ROBOTS), jnp.arange(NUM_ROBOTS))


def act(name: str, backend: str, num_steps: int):
    """Return for each robot the number of steps before its violation, with noise from none to much."""
    env, step = actor(name, backend)
    policy = jax.jit(make_policy(name, env, NUM_ROBOTS))
    key_reset, key_noise = jax.random.split(jax.random.key(1))
    state = starts(env, key_reset)
    active, steps = np.ones(NUM_ROBOTS, bool), np.zeros(NUM_ROBOTS)
    for key in jax.random.split(key_noise, num_steps):
        state = step(state, policy(state, key), active, key)
        active &= ~np.asarray(state.violation)
        steps += active
    return steps


@pytest.mark.statistical
@pytest.mark.slow
@pytest.mark.parametrize("name", [pytest.param(x, marks=[pytest.mark.long] * (x != "humanoid")) for x in ROBOTS])
def test_robots_violate_as_often_on_both_backends(name):
    """Share of violations within 200 steps, and steps before them: they differ by less than four standard errors."""
    one, other = (act(name, backend, 200) for backend in BACKENDS)
    share, other_share = np.mean(one < 200), np.mean(other < 200)
    mean = (share + other_share) / 2
    print(f"{name}: violations {share:.3f}, {other_share:.3f}; mean steps before them: {one.mean():.1f}, {other.mean():.1f}")
    assert 0 < mean < 1
    assert abs(share - other_share) < 4 * np.sqrt(2 * mean * (1 - mean) / NUM_ROBOTS)
    assert abs(one.mean() - other.mean()) < 4 * np.sqrt((one.var() + other.var()) / NUM_ROBOTS)


@pytest.mark.slow
@each_robot_and_backend
def test_inactive_robots_keep_their_state(name, backend):
    states, controls = mixed(name)
    states = states._replace(diverged=np.arange(NUM_ROBOTS) % 4 == 0)
    active = np.arange(NUM_ROBOTS) % 2 == 1
    after = mover(name, backend)(states, controls, active)
    assert_same(rows(after, ~active), rows(states, ~active))
    assert not np.any(np.all(after.qpos[active] == states.qpos[active], axis=1))


@pytest.mark.slow
@each_robot_and_backend
def test_neighbours_do_not_matter(name, backend):
    states, controls = mixed(name)
    move = mover(name, backend)
    after = move(states, controls)
    others = np.roll(np.arange(NUM_ROBOTS), 7)
    assert_same(move(rows(states, others), controls[others]), rows(after, others))
    alone = np.arange(NUM_ROBOTS) == 5
    assert_same(rows(move(states, controls, alone), 5), rows(after, 5))


@each_robot
def test_number_of_threads_does_not_matter(name, monkeypatch):
    states, controls = mixed(name)
    results = []
    for threads in (1, 2, 5):
        monkeypatch.setenv("FLEETJAX_NUM_THREADS", str(threads))
        assert native.num_threads() == threads
        results.append(jax.jit(jax.vmap(physics_of(name).step))(states, controls, np.ones(NUM_ROBOTS, bool)))
    for result in results[1:]:
        assert_same(result, results[0])


SICK = {"control": 3, "velocity": 20, "position": 21}


def infect(states: PhysicsState, controls):
    """Return states and controls in which three robots are bound to diverge."""
    qpos, qvel, controls = states.qpos.copy(), states.qvel.copy(), controls.copy()
    controls[SICK["control"], 2] = np.nan
    qvel[SICK["velocity"], 10] = 1e12
    qpos[SICK["position"], 8] = np.inf
    return states._replace(qpos=qpos, qvel=qvel), controls


@each_robot_and_backend
def test_a_diverged_robot_keeps_its_last_state_and_spares_the_others(name, backend, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    states, controls = mixed(name)
    healthy = mover(name, backend)(states, controls)
    sick_states, sick_controls = infect(states, controls)
    after = mover(name, backend)(sick_states, sick_controls)
    sick = np.isin(np.arange(NUM_ROBOTS), list(SICK.values()))
    np.testing.assert_array_equal(after.diverged, sick)
    assert_same(rows(after._replace(diverged=sick_states.diverged), sick), rows(sick_states, sick))
    assert_same(rows(after, ~sick), rows(healthy, ~sick))
    assert list(tmp_path.iterdir()) == []  # MuJoCo's log would be here


@each_robot
@pytest.mark.parametrize("backend", ["native", pytest.param("mjx", marks=pytest.mark.slow)])
def test_a_diverged_robot_is_a_violation(name, backend):
    env, step = actor(name, backend)
    before, sick = starts(env, jax.random.key(0)), SICK["control"]
    action = np.zeros((NUM_ROBOTS, env.spec.action_size), np.float32)
    action[sick] = np.nan
    after = step(before, action, np.ones(NUM_ROBOTS, bool), jax.random.key(1))
    np.testing.assert_array_equal(after.violation, np.arange(NUM_ROBOTS) == sick)
    assert after.reward[sick] == (-1 if name == "humanoid" else 0)
    assert np.all(np.isfinite(after.obs))
    bodies = [ROBOTS[name].body(state.physics) for state in (before, after)]
    assert_same(bodies[1].qpos[sick], bodies[0].qpos[sick])


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


@pytest.mark.slow
def test_mjx_is_differentiable_forwards():
    """On a smooth case, a leg that swings, the derivative of a control step equals central differences of MJX itself."""
    leg = mujoco.MjModel.from_xml_string(LEG)
    step = mjx.make_step(leg, 3)
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
    with pytest.raises(ValueError, match="backend = 'cuda' is unknown; choose one of auto, native, mjx, warp"):
        make_physics("humanoid.xml", substeps=3, backend="cuda")


def test_warp_is_refused_without_a_gpu_before_anything_is_computed(capsys, tmp_path, monkeypatch):
    remedy = r"backend = 'warp' needs an NVIDIA GPU and pip install \"\.\[cuda12,warp\]\" \(.*{}.*\); or choose"
    for gpu, installed, missing in (
        (False, False, "JAX finds no GPU here and warp-lang is not installed"),
        (False, True, "JAX finds no GPU here"),
        (True, False, "warp-lang is not installed"),
    ):
        monkeypatch.setattr(jax, "default_backend", lambda gpu=gpu: "gpu" if gpu else "cpu")
        monkeypatch.setattr(importlib.util, "find_spec", lambda name, found=installed: found or None)
        with pytest.raises(ValueError, match=remedy.format(missing)):
            check_backend("warp")
    config = fleetjax.make_config("humanoid", backend="warp")  # a run can be described, and read, anywhere
    with pytest.raises(ValueError, match="backend = 'warp' needs an NVIDIA GPU"):
        jax.eval_shape(fleetjax.run, config, jax.random.key(0))
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: True)
    check_backend("warp")
    monkeypatch.undo()
    if not importlib.util.find_spec("warp"):
        step, states = jax.jit(physics_of("humanoid", "warp").step), rows(recorded("humanoid")[0], 0)
        with pytest.raises(jax.errors.JaxRuntimeError, match="backend = 'warp' needs an NVIDIA GPU"):
            jax.block_until_ready(step(states, jnp.zeros(21), jnp.ones((), bool)))
    said = refused(capsys, "run", "navigation", "--backend", "warp", "--output", tmp_path / "out")
    assert "backend = 'warp' needs an NVIDIA GPU" in said
    assert not (tmp_path / "out").exists()


def test_native_refuses_implicit_damping():
    implicit = mujoco.MjModel.from_xml_string(LEG.replace('<flag eulerdamp="disable"/>', ""))
    with pytest.raises(ValueError, match="eulerdamp disabled"):
        native.make_step(implicit, 3)


def test_importing_mjx_prints_nothing():
    command = [sys.executable, "-c", "import fleetjax.physics.mjx"]
    assert subprocess.run(command, capture_output=True, check=True, text=True).stdout == ""
