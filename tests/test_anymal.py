"""ANYmal: the model's numbers, the observation entry by entry, the reward term by term, and what ends an episode."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from fleetjax.envs import anymal
from fleetjax.physics.base import make_physics

LEGS = ("LF", "LH", "RF", "RH")
NAMES = [f"{leg}_{joint}" for leg in LEGS for joint in ("HAA", "HFE", "KFE")]
MASSES = {"base": 26.37317, "hip": 2.781, "thigh": 3.071, "shank": 0.58842}  # kg
HALF = np.sqrt(0.5)


@pytest.fixture(scope="module")
def physics():
    return make_physics("anymal.xml", substeps=anymal.SUBSTEPS, backend="native")


@pytest.fixture(scope="module")
def env():
    return anymal.make_env(backend="native", success_return=60.0)


@pytest.fixture(scope="module")
def step(env):
    return jax.jit(lambda state, action: env.step(state, action, True, jax.random.key(0)))


def walker(physics, *, position=(0, 0, 0.62), turn=(1, 0, 0, 0), angles=None, velocity=(0, 0, 0), spin=(0, 0, 0), speeds=0.0):
    angles = anymal.DEFAULT_ANGLES if angles is None else angles
    body = physics.initial._replace(
        qpos=jnp.concatenate([jnp.array(x, jnp.float32) for x in (position, turn, angles)]),
        qvel=jnp.concatenate([jnp.array(x, jnp.float32) for x in (velocity, spin, np.broadcast_to(speeds, 12))]),
    )
    return anymal.Walker(body, jnp.array([1.5, -0.5, 0.8]))


# The model


def test_masses_and_inertias(physics):
    model = physics.model
    for i in range(1, model.nbody):
        np.testing.assert_allclose(model.body_mass[i], MASSES[model.body(i).name[-5:].split("_")[-1]], rtol=1e-6)
    np.testing.assert_allclose(model.body_mass.sum(), 52.1349, atol=1e-4)
    # Moments about the centre of mass, largest first, from the published products: a check of the tensor's sum and order.
    np.testing.assert_allclose(model.body("base").inertia.sum(), 0.21671174 + 1.78516169 + 1.83369945, rtol=1e-6)
    tensor = np.array(
        [[0.00881038, 5.357e-05, 0.00181935], [5.357e-05, 0.01016114, -2.266e-05], [0.00181935, -2.266e-05, 0.00154978]]
    )
    np.testing.assert_allclose(np.sort(model.body("LF_shank").inertia), np.linalg.eigvalsh(tensor), rtol=1e-4)


def test_joints_and_servos(physics):
    model = physics.model
    assert [model.joint(i).name for i in range(1, model.njnt)] == NAMES
    assert [model.joint(j).name for j in model.actuator_trnid[:, 0]] == NAMES
    for name in NAMES:
        joint = model.joint(name)
        limits = (-9.42478, 9.42478)
        if name.endswith("HAA"):
            limits = (-0.72, 0.49) if name.startswith("L") else (-0.49, 0.72)
        np.testing.assert_allclose(joint.axis, (1, 0, 0) if name.endswith("HAA") else (0, 1, 0))
        np.testing.assert_allclose(joint.range, limits)
    np.testing.assert_allclose(model.actuator_gainprm[:, 0], 85)
    np.testing.assert_allclose(model.actuator_biasprm[:, :3], [[0, -85, -2]] * 12)
    np.testing.assert_allclose(model.actuator_forcerange, [[-80, 80]] * 12)


def test_geometry(physics):
    """In the default pose: feet and centre of mass, from the base."""
    model, data = physics.model, mujoco.MjData(physics.model)
    data.qpos[7:] = anymal.DEFAULT_ANGLES
    mujoco.mj_forward(model, data)
    for leg, (x, y) in zip(LEGS, ((1, 1), (-1, 1), (1, -1), (-1, -1)), strict=True):
        np.testing.assert_allclose(data.geom(f"{leg}_foot").xpos, [0.4527 * x, 0.3166 * y, 0.62 - 0.5127], atol=1e-4)
    np.testing.assert_allclose(data.subtree_com[1], [-0.009, 0, 0.62 - 0.062], atol=1e-3)


def test_a_standing_robot_does_not_slide(env, step):
    """Under the default targets it sags and sways; then its feet stay where they are: less than 3 mm in 2 seconds."""
    state = env.reset(jax.random.key(0), jnp.int32(0))
    for _ in range(350):
        state = step(state, jnp.zeros(12))
    before = state.physics.body.qpos
    for _ in range(100):
        state = step(state, jnp.zeros(12))
    after = state.physics.body.qpos
    assert 0.45 < after[2] < 0.55
    np.testing.assert_allclose(after[:3], before[:3], atol=3e-3)
    assert not state.violation


# The observation


def test_spec(env, physics):
    spec = env.spec
    assert (spec.observation_size, spec.action_size, spec.horizon) == (48, 12, 2501)
    np.testing.assert_allclose([spec.control_step, physics.control_step], 0.02, rtol=1e-6)
    assert not spec.discrete
    assert not spec.has_goal


def test_observation_at_rest(physics):
    expected = np.zeros(48)
    expected[8] = -1
    expected[9:12] = 3.0, -1.0, 0.2
    np.testing.assert_allclose(anymal.observe(walker(physics), jnp.zeros(12)), expected, atol=1e-6)


@pytest.mark.parametrize(
    ("turn", "world", "own", "gravity"),
    [
        # A quarter turn to the left: forwards in the world is to the right of the robot; gravity does not notice.
        ((HALF, 0, 0, HALF), (1, 0, 0), (0, -1, 0), (0, 0, -1)),
        # Lying on its right side: upwards is to its left, gravity to its right.
        ((HALF, HALF, 0, 0), (0, 0, 1), (0, 1, 0), (0, -1, 0)),
        # Leaning 60 degrees forwards: gravity is partly forwards for the robot.
        ((np.sqrt(0.75), 0, 0.5, 0), (0, 0, -2), (np.sqrt(3), 0, -1), (np.sqrt(0.75), 0, -0.5)),
        # The same after half a turn about the vertical: what the robot feels does not depend on where it looks.
        ((0, -0.5, 0, np.sqrt(0.75)), (0, 0, -2), (np.sqrt(3), 0, -1), (np.sqrt(0.75), 0, -0.5)),
    ],
)
def test_observation_of_the_pose(physics, turn, world, own, gravity):
    obs = anymal.observe(walker(physics, turn=turn, velocity=world), jnp.zeros(12))
    np.testing.assert_allclose(obs[:3], 2 * np.array(own), atol=1e-5)
    np.testing.assert_allclose(obs[6:9], gravity, atol=1e-6)


def test_observation_of_motion(physics):
    offsets, speeds, action = np.linspace(-0.3, 0.4, 12), np.linspace(-8, 9, 12), np.linspace(1, -1, 12)
    moving = walker(physics, spin=(4, 8, -12), angles=anymal.DEFAULT_ANGLES + offsets, speeds=speeds)
    obs = anymal.observe(moving, jnp.asarray(action, jnp.float32))
    np.testing.assert_allclose(obs[3:6], [1, 2, -3])  # the base's own frame already
    np.testing.assert_allclose(obs[12:24], offsets, atol=1e-6)
    np.testing.assert_allclose(obs[24:36], speeds / 20, atol=1e-6)
    np.testing.assert_allclose(obs[36:48], action, atol=1e-6)
    fast = anymal.observe(walker(physics, velocity=(9, 0, 0), speeds=-200.0), jnp.zeros(12))
    assert fast[0] == 5
    assert np.all(fast[24:36] == -5)


def test_a_command_lasts_for_the_episode_and_differs_between_episodes(env, step):
    keys = jax.random.split(jax.random.key(0), 500)
    commands = np.asarray(jax.vmap(env.reset)(keys, jnp.arange(500)).physics.command)
    limits = np.array([2, 1, 1])
    assert np.all(np.abs(commands) <= limits)
    assert np.all(np.abs(commands).max(axis=0) > 0.95 * limits)
    np.testing.assert_allclose(commands.mean(axis=0) / limits, 0, atol=4 / np.sqrt(3 * 500))
    state = env.reset(keys[0], jnp.int32(0))
    after = step(state, jnp.ones(12))
    np.testing.assert_array_equal(after.physics.command, state.physics.command)


def test_episodes_start_near_the_default_pose(env):
    start = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 300), jnp.arange(300)).physics.body
    np.testing.assert_allclose(start.qpos[:, :7], [[0, 0, 0.62, 1, 0, 0, 0]] * 300)
    ratio = np.asarray(start.qpos[:, 7:] / anymal.DEFAULT_ANGLES)
    assert 0.5 <= ratio.min() < 0.52
    assert 1.48 < ratio.max() <= 1.5
    assert not np.any(start.qvel[:, :6])
    assert 0.095 < np.abs(start.qvel[:, 6:]).max() <= 0.1


# The reward, and what ends an episode


def test_reward_of_perfect_tracking(physics):
    """1 for the plane, 0.5 for turning, less torques squared: the servos hold the pose against no offset here."""
    ideal = walker(physics, velocity=(1.5, -0.5, 3.0), spin=(2, 2, 0.8))
    np.testing.assert_allclose(anymal._reward(ideal, anymal.DEFAULT_ANGLES), 1.5, atol=1e-6)


def test_reward_of_misses_and_torques(physics):
    missing = walker(physics, velocity=(1.0, 0.0, 0.0), spin=(0, 0, 0.3))
    tracking = np.exp(-(0.25 + 0.25) / 0.25) + 0.5 * np.exp(-0.25 / 0.25)
    np.testing.assert_allclose(anymal._reward(missing, anymal.DEFAULT_ANGLES), tracking, atol=1e-6)
    shifted, torque = anymal.DEFAULT_ANGLES + 0.1, 85 * 0.1
    np.testing.assert_allclose(anymal._reward(missing, shifted), tracking - 2.5e-5 * 12 * torque**2, atol=1e-5)
    pushed = walker(physics, velocity=(1.0, 0.0, 0.0), spin=(0, 0, 0.3), speeds=1.0)
    np.testing.assert_allclose(anymal._reward(pushed, shifted), tracking - 2.5e-5 * 12 * (torque - 2) ** 2, atol=1e-5)
    far = anymal._reward(missing, anymal.DEFAULT_ANGLES + 2)  # 80 N m at most
    np.testing.assert_allclose(far, max(0, tracking - 2.5e-5 * 12 * 80**2))


def test_an_action_moves_the_targets_by_half_a_radian(env, step, physics):
    state = env.reset(jax.random.key(0), jnp.int32(0))
    after = step(state, jnp.full(12, 3.0))
    np.testing.assert_array_equal(after.obs[36:], 1.0)
    data = mujoco.MjData(physics.model)
    data.qpos[:], data.qvel[:] = state.physics.body.qpos, state.physics.body.qvel
    data.ctrl[:] = anymal.DEFAULT_ANGLES + 0.5
    mujoco.mj_step(physics.model, data, 4)
    np.testing.assert_allclose(after.physics.body.qpos, data.qpos, atol=1e-6)


@pytest.mark.parametrize(
    ("height", "angles", "violates"),
    [
        (0.08, (0, -1.6, 0), True),  # on its belly, legs stretched
        (0.45, (0, 0.4, -0.8), False),  # on its feet
        (0.30, (0, 0.0, -2.2), True),  # on its knees
        (0.62, (0, 0.4, -0.8), False),  # in the air
    ],
)
def test_base_and_thighs_must_not_touch_the_floor(physics, env, step, height, angles, violates):
    fore, hind = np.array(angles), np.array(angles) * (1, -1, -1)
    placed = walker(physics, position=(0, 0, height), angles=np.concatenate([fore, hind, fore, hind]))
    state = env.reset(jax.random.key(0), jnp.int32(0))
    state, violated = state._replace(physics=placed), False
    for _ in range(10):  # the floor may first push out what was placed a little inside of it
        state = step(state, jnp.zeros(12))
        violated |= bool(state.violation)
    assert violated == violates


def test_a_robot_that_holds_its_pose_reaches_the_horizon_and_fails(env, step):
    state = env.reset(jax.random.key(0), jnp.int32(0))
    state = step(state._replace(episode_step=jnp.int32(2499)), jnp.zeros(12))
    assert not state.timeout
    done = step(state, jnp.zeros(12))
    assert done.timeout
    assert not done.success
    assert step(state._replace(episode_return=jnp.float32(60.1)), jnp.zeros(12)).success
