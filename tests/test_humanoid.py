"""Humanoid: the observation entry by entry, the reward term by term, and how episodes begin and end."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from humanoid_facts import EFFORT, GEARS, JOINTS, NAMES

from fleetjax.envs import humanoid
from fleetjax.physics.base import make_physics

KNEE = NAMES.index("right_knee")
UPRIGHT = (1.0, 0.0, 0.0, 0.0)
HALF = np.sqrt(0.5)


@pytest.fixture(scope="module")
def physics():
    return make_physics("humanoid.xml", substeps=humanoid.SUBSTEPS, backend="native")


@pytest.fixture(scope="module")
def joints(physics):
    return humanoid._Joints(physics.model)


@pytest.fixture(scope="module")
def env():
    return humanoid.make_env(backend="native", success_return=6000.0)


@pytest.fixture(scope="module")
def step(env):
    return jax.jit(lambda state, action: env.step(state, action, True, jax.random.key(0)))


def body(
    physics, *, position=(0, 0, 1.34), turn=UPRIGHT, angles=0.0, velocity=(0, 0, 0), spin=(0, 0, 0), speeds=0.0, sensors=0.0
):
    """Return a state of the body; angles and speeds are those of the joints."""
    return physics.initial._replace(
        qpos=jnp.asarray(np.concatenate([position, turn, np.broadcast_to(angles, 21)]), jnp.float32),
        qvel=jnp.asarray(np.concatenate([velocity, spin, np.broadcast_to(speeds, 21)]), jnp.float32),
        sensors=jnp.broadcast_to(jnp.asarray(sensors, jnp.float32), 12),
    )


def test_spec(env, physics):
    spec = env.spec
    assert (spec.observation_size, spec.action_size, spec.horizon) == (108, 21, 999)
    np.testing.assert_allclose([spec.control_step, physics.control_step], 0.0166, rtol=1e-6)
    assert not spec.discrete
    assert not spec.has_goal


# The observation


def test_observation_upright_at_rest(physics, joints):
    obs = humanoid.observe(joints, body(physics), jnp.zeros(21))
    expected = np.zeros(108)
    expected[[0, 10, 11]] = 1.34, 1, 1
    expected[12:33] = [row[6] for row in JOINTS.values()]
    np.testing.assert_allclose(obs, expected, atol=6e-5)


@pytest.mark.parametrize(
    ("pose", "velocity", "yaw", "roll", "bearing", "up", "heading"),
    [
        # A quarter turn to the left: the target is to the right; forwards in the world is to the right of the robot.
        ({"turn": (HALF, 0, 0, HALF)}, ((1, 0, 0), (0, -1, 0)), np.pi / 2, 0, -np.pi / 2, 1, 0),
        # Half a turn: the target is behind, where the angle jumps from pi to -pi.
        ({"turn": (0.01, 0, 0, np.sqrt(1 - 1e-4))}, ((1, 0, 0), (-0.9998, -0.02, 0)), 3.1216, 0, -3.1216, 1, -0.9998),
        # Lying on its right side: upwards is to its left.
        ({"turn": (HALF, HALF, 0, 0)}, ((0, 0, 1), (0, 1, 0)), 0, np.pi / 2, 0, 0, 1),
        # Leaning 60 degrees forwards: downwards in the world is partly forwards for the robot.
        ({"turn": (np.sqrt(0.75), 0, 0.5, 0)}, ((0, 0, -2), (np.sqrt(3), 0, -1)), 0, 0, 0, 0.5, 0.5),
        # Off the line: from (400, 800) the target at (1000, 0) lies along (0.6, -0.8).
        ({"position": (400, 800, 1.34)}, ((3, 4, 5), (3, 4, 5)), 0, 0, -0.9273, 1, 0.6),
    ],
)
def test_observation_of_the_pose(physics, joints, pose, velocity, yaw, roll, bearing, up, heading):
    world, own = velocity
    obs = humanoid.observe(joints, body(physics, velocity=world, **pose), jnp.zeros(21))
    np.testing.assert_allclose(obs[0], 1.34)
    np.testing.assert_allclose(obs[1:4], own, atol=1e-3)
    np.testing.assert_allclose(obs[7:12], [yaw, roll, bearing, up, heading], atol=1e-3)


def test_observation_of_motion_and_forces(physics, joints):
    angles = np.linspace(-0.3, 0.03, 21)
    speeds = np.linspace(-4, 6, 21)
    action = np.linspace(1, -1, 21)
    sensors = np.arange(12) * 10.0
    moving = body(physics, spin=(4, 8, -12), angles=angles, speeds=speeds, sensors=sensors)
    obs = humanoid.observe(joints, moving, jnp.asarray(action, jnp.float32))
    low, high = np.radians([row[1] for row in JOINTS.values()]).T
    damping, stiffness = np.array([row[2:4] for row in JOINTS.values()]).T
    np.testing.assert_allclose(obs[4:7], [1, 2, -3])  # the body's own frame already
    np.testing.assert_allclose(obs[12:33], -1 + 2 * (angles - low) / (high - low), atol=1e-5)
    np.testing.assert_allclose(obs[33:54], speeds / 10, atol=1e-6)
    np.testing.assert_allclose(obs[54:75], (GEARS * action - stiffness * angles - damping * speeds) / 100, atol=1e-5)
    np.testing.assert_allclose(obs[75:87], sensors / 100, atol=1e-6)
    np.testing.assert_allclose(obs[87:108], action, atol=1e-6)


def test_observation_after_a_step(joints, env, step):
    """It is that of the new body and of the clipped action."""
    action = jnp.linspace(-3, 3, 21)
    after = step(env.reset(jax.random.key(0), jnp.int32(0)), action)
    clipped = jnp.clip(action, -1, 1)
    np.testing.assert_allclose(after.obs, humanoid.observe(joints, after.physics, clipped), atol=1e-5)
    np.testing.assert_array_equal(after.obs[87:], clipped)


def test_foot_sensors(physics):
    """Right foot first, force before torque; the soles carry the weight, and nothing acts on feet in free fall."""
    move = jax.jit(physics.step)
    falling = move(body(physics, position=(0, 0, 3)), jnp.zeros(21), True)
    np.testing.assert_allclose(falling.sensors, 0, atol=0.5)
    landed = body(physics, position=(0, 0, 1.285))
    for _ in range(10):
        landed = move(landed, jnp.zeros(21), True)
    right, left = landed.sensors[:3], landed.sensors[6:9]
    np.testing.assert_allclose(right[2], left[2], rtol=0.05)  # the stance is symmetric
    assert abs(right[2]) > 50
    names = [physics.model.site(i).name for i in physics.model.sensor_objid]
    assert names == ["right_foot", "right_foot", "left_foot", "left_foot"]


# The reward


def reward(physics, joints, before, after, action=0.0):
    action = jnp.broadcast_to(jnp.asarray(action, jnp.float32), 21)
    return humanoid._reward(joints, physics, before, after, humanoid.observe(joints, after, action), action)


def test_reward_of_standing(physics, joints):
    """Alive 2, upright 0.1, heading 0.5."""
    np.testing.assert_allclose(reward(physics, joints, body(physics), body(physics)), 2.6, atol=1e-6)


@pytest.mark.parametrize(
    ("start", "end", "speed"),
    [
        ((0, 0), (0.0332, 0), 2.0),
        ((0, 0), (-0.0166, 0), -1.0),
        ((0, 0), (0, 0.0166), 0.0),
        ((400, 800), (400 + 0.6 * 0.0166, 800 - 0.8 * 0.0166), 1.0),
    ],
)
def test_reward_of_progress(physics, joints, start, end, speed):
    """The approach to (1000, 0) in m/s; a millimetre's precision at a kilometre's distance, in single precision."""
    before, after = body(physics, position=(*start, 1.34)), body(physics, position=(*end, 1.34))
    shift = np.asarray(after.qpos[:2], np.float64) - np.asarray(before.qpos[:2], np.float64)
    target = np.array([1000.0, 0.0]) - np.asarray(before.qpos[:2], np.float64)
    exact = (np.linalg.norm(target) - np.linalg.norm(target - shift)) / 0.0166
    np.testing.assert_allclose(exact, speed, atol=5e-3)
    gained = reward(physics, joints, before, after) - reward(physics, joints, after, after)
    np.testing.assert_allclose(gained, exact, atol=1e-4)


@pytest.mark.parametrize(
    ("turn", "expected"),
    [
        ((HALF, 0, 0, HALF), 2.0 + 0.1),  # heads across: nothing for the heading
        ((np.sqrt(0.85), 0, 0, np.sqrt(0.15)), 2.0 + 0.1 + 0.5 * 0.7 / 0.8),  # cosine 0.7
        ((np.sqrt(0.95), 0, 0, np.sqrt(0.05)), 2.0 + 0.1 + 0.5),  # cosine 0.9
        ((np.sqrt(0.96), np.sqrt(0.04), 0, 0), 2.0 + 0.5),  # up 0.92: not upright
        ((np.sqrt(0.97), np.sqrt(0.03), 0, 0), 2.0 + 0.1 + 0.5),  # up 0.94
    ],
)
def test_reward_of_posture(physics, joints, turn, expected):
    turned = body(physics, turn=turn)
    np.testing.assert_allclose(reward(physics, joints, turned, turned), expected, atol=1e-5)


def test_cost_of_action_and_energy(physics, joints):
    """0.01 a^2 a motor; 0.05 |a v / 10| a motor, weighted by its share of the strongest one's torque."""
    at_rest = body(physics)
    np.testing.assert_allclose(reward(physics, joints, at_rest, at_rest, 0.5), 2.6 - 0.01 * 21 / 4, atol=1e-5)
    moving = body(physics, speeds=-4.0)
    expected = 2.6 - 0.01 * 21 / 4 - 0.05 * np.sum(0.5 * 0.4 * EFFORT)
    np.testing.assert_allclose(reward(physics, joints, moving, moving, 0.5), expected, atol=1e-5)


def test_cost_of_joints_at_their_limit(physics, joints):
    """A joint at its limit costs 0.25 of its share of torque; half-way between 0.98 and the limit half of that."""
    for at, part in ((2.0, 1.0), (2 - 0.81, 0.5), (2 - 1.7, 0.0)):  # deg; 1 % of a knee's half range is 0.81
        bent = body(physics, angles=np.radians(at) * np.eye(21)[KNEE])
        expected = 2.6 - 0.25 * part * EFFORT[KNEE]
        np.testing.assert_allclose(reward(physics, joints, bent, bent), expected, atol=1e-4)


def test_reward_of_a_step(physics, joints, env, step):
    before = env.reset(jax.random.key(4), jnp.int32(0))
    action = jnp.sin(jnp.arange(21.0))
    after = step(before, action)
    expected = reward(physics, joints, before.physics, after.physics, action)
    np.testing.assert_allclose(after.reward, expected, atol=1e-4)


# Episodes


def test_reset(env, physics):
    """Root at rest 1.34 m up; angles in +-0.2 rad as far as the limits allow, speeds in +-0.1 rad/s, all independent."""
    states = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 4000), jnp.arange(4000))
    qpos, qvel = np.asarray(states.physics.qpos), np.asarray(states.physics.qvel)
    np.testing.assert_array_equal(qpos[:, :7], np.tile(np.float32([0, 0, 1.34, 1, 0, 0, 0]), (4000, 1)))
    np.testing.assert_array_equal(qvel[:, :6], 0)
    free = np.array([not name.endswith("knee") for name in NAMES])
    for draws, half in ((qpos[:, 7:][:, free], 0.2), (qvel[:, 6:], 0.1)):
        assert np.abs(draws).max() <= np.float32(half)
        assert np.abs(draws).max() > 0.99 * half
        np.testing.assert_allclose(draws.mean(axis=0), 0, atol=0.05 * half)
        np.testing.assert_allclose(draws.std(axis=0), half / np.sqrt(3), rtol=0.05)
    knee = qpos[:, 7 + KNEE]
    np.testing.assert_allclose(knee.max(), np.radians(2), rtol=1e-6)
    np.testing.assert_allclose(np.mean(knee == knee.max()), (0.2 - np.radians(2)) / 0.4, atol=0.03)
    drawn = np.concatenate([qpos[:, 7:], qvel[:, 6:]], axis=1)
    assert np.abs(np.corrcoef(drawn.T) - np.eye(42)).max() < 0.1
    np.testing.assert_array_equal(states.obs[:, 75:], 0)  # no sensors, no action yet


@pytest.mark.parametrize(("height", "falls"), [(0.82, False), (0.79, True)])
def test_fall(env, physics, step, height, falls):
    """Below 0.8 m the robot violates, and the step is worth -1 whatever it did."""
    start = env.reset(jax.random.key(0), jnp.int32(0))
    prone = body(physics, position=(0, 0, height), turn=(HALF, 0, HALF, 0))  # face down, and clear of the floor
    low = start._replace(physics=prone)
    after = step(low, jnp.ones(21))
    assert (after.physics.qpos[2] < 0.8) == falls
    assert bool(after.violation) == falls
    assert (after.reward == -1) == falls


@pytest.mark.parametrize(
    ("steps", "total", "timeout", "success"),
    [(997, 7000.0, False, False), (998, 7000.0, True, True), (998, 5900.0, True, False), (998, 5999.0, True, True)],
)
def test_episode_ends_after_999_steps(env, step, steps, total, timeout, success):
    """It then succeeds if its return, the last step's reward included, is above the bar."""
    start = env.reset(jax.random.key(0), jnp.int32(0))
    late = start._replace(episode_step=jnp.int32(steps), episode_return=jnp.float32(total))
    after = step(late, jnp.zeros(21))
    assert not after.violation
    assert (bool(after.timeout), bool(after.success)) == (timeout, success)


def test_bar_for_success():
    """Unless told, 6000 or 95 % of the expert's return, the larger."""
    from fleetjax import expert_records

    bar = max(6000.0, 0.95 * expert_records.mean_return("humanoid"))
    env = humanoid.make_env(backend="native")
    start = env.reset(jax.random.key(0), jnp.int32(0))
    for total, success in ((bar - 10, False), (bar + 10, True)):
        late = start._replace(episode_step=jnp.int32(998), episode_return=jnp.float32(total))
        assert bool(env.step(late, jnp.zeros(21), True, jax.random.key(0)).success) == success
