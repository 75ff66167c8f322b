"""Allegro hand: the model's numbers, the observation entry by entry, goals, rewards, and what ends an episode."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fleetjax.envs import allegro_hand
from fleetjax.envs.rotation import multiply
from fleetjax.physics.base import make_physics

NAMES = [f"{finger}_{joint}" for finger in ("index", "middle", "ring", "thumb") for joint in range(4)]
FINGER = [(-0.558489, 0.558489)] + 3 * [(-0.279244, 1.727825)]
THUMB = [(0.279244, 1.57075), (-0.331603, 1.151883), (-0.279244, 1.727825), (-0.279244, 1.762731)]
LIMITS = np.array(3 * FINGER + THUMB)
LOW, HIGH = jnp.asarray(LIMITS.T, jnp.float32)


@pytest.fixture(scope="module")
def physics():
    return make_physics("allegro_hand.xml", substeps=allegro_hand.SUBSTEPS, backend="native")


@pytest.fixture(scope="module")
def env():
    return allegro_hand.make_env(backend="native")


@pytest.fixture(scope="module")
def step(env):
    return jax.jit(lambda state, action: env.step(state, action, True, jax.random.key(0)))


@pytest.fixture(scope="module")
def start(env):
    return jax.jit(env.reset)(jax.random.key(0), jnp.int32(0))


def scalar_first(rotation):
    return np.roll(rotation.as_quat(), 1)


NO_TURN, STILL = (1, 0, 0, 0), (0, 0, 0)


def hand(
    physics,
    *,
    angles=0.0,
    speeds=0.0,
    position=(0, -0.2, 0.52),
    turn=NO_TURN,
    velocity=STILL,
    spin=STILL,
    goal=NO_TURN,
    target=0.0,
):
    qpos = jnp.concatenate([jnp.asarray(x, jnp.float32) for x in (np.broadcast_to(angles, 16), position, turn)])
    qvel = jnp.concatenate([jnp.asarray(x, jnp.float32) for x in (np.broadcast_to(speeds, 16), velocity, spin)])
    body = physics.initial._replace(qpos=qpos, qvel=qvel)
    return allegro_hand.Hand(body, jnp.asarray(goal, jnp.float32), jnp.broadcast_to(jnp.float32(target), 16))


# The model


def test_joints_and_servos(physics):
    model = physics.model
    assert [model.joint(i).name for i in range(16)] == NAMES
    assert [model.joint(j).name for j in model.actuator_trnid[:, 0]] == NAMES
    np.testing.assert_allclose(model.jnt_range[:16], LIMITS, rtol=1e-6)
    np.testing.assert_allclose(model.actuator_gainprm[:, 0], 3)
    np.testing.assert_allclose(model.actuator_biasprm[:, :3], [[0, -3, -0.1]] * 16)
    np.testing.assert_allclose(model.actuator_forcerange, [[-0.5, 0.5]] * 16)
    np.testing.assert_allclose(model.dof_armature[:16], 0.001)


def test_masses(physics):
    model = physics.model
    np.testing.assert_allclose(model.body_subtreemass[model.body("palm").id], 1.0217 - 0.05, atol=1e-4)  # without its mount
    np.testing.assert_allclose([model.body("index_1").mass[0], model.body("thumb_3").mass[0]], [0.065, 0.0388 + 0.021])
    np.testing.assert_allclose(model.body("cube").mass, 0.0864, rtol=1e-6)
    np.testing.assert_allclose(model.body("cube").inertia, 5.184e-5, rtol=1e-6)
    np.testing.assert_allclose(model.body_gravcomp[1 : model.body("cube").id], 1)
    assert model.body_gravcomp[model.body("cube").id] == 0


def test_geometry(physics):
    """Fingers stretched, thumb at its lower limit: where the far ends of the tips are, and which way joints turn."""
    model, data = physics.model, mujoco.MjData(physics.model)
    data.qpos[12] = 0.279
    mujoco.mj_forward(model, data)
    expected = {
        "index": (-0.058, -0.279, 0.490),
        "middle": (0, -0.281, 0.489),
        "ring": (0.058, -0.279, 0.490),
        "thumb": (-0.185, -0.040, 0.541),
    }
    for finger, place in expected.items():
        tip = data.geom(f"{finger}_tip")
        end = tip.xpos - tip.xmat.reshape(3, 3)[:, 2] * model.geom(f"{finger}_tip").size[1]
        other = tip.xpos + tip.xmat.reshape(3, 3)[:, 2] * model.geom(f"{finger}_tip").size[1]
        assert min(np.abs(end - place).max(), np.abs(other - place).max()) < 2e-3, finger
    palm = data.body("palm").xmat.reshape(3, 3)
    axes = {"index_0": (0.9962, -0.0872, 0), "middle_1": (0, -1, 0), "ring_2": (0.0872, -0.9962, 0)}
    for name, axis in (axes | {"thumb_0": (-0.9962, 0.0872, 0)}).items():
        np.testing.assert_allclose(palm.T @ data.joint(name).xaxis, axis, atol=2e-4, err_msg=name)


# The observation


def test_spec(env, physics):
    spec = env.spec
    assert (spec.observation_size, spec.action_size, spec.horizon) == (88, 16, 600)
    np.testing.assert_allclose([spec.control_step, physics.control_step], 0.03334, rtol=1e-6)
    assert spec.has_goal
    assert env.next_goal is not None


def test_observation_at_rest(physics):
    target = -(HIGH + LOW) / (HIGH - LOW)  # angles of zero: no torque
    obs = allegro_hand.observe(hand(physics, target=target), LOW, HIGH)
    expected = np.zeros(88)
    expected[:16] = np.array(3 * [0, -0.7217, -0.7217, -0.7217] + [-1.4324, -0.5529, -0.7217, -0.7265])
    expected[48:51] = expected[61:64] = 0, -0.2, 0.52
    expected[[54, 67, 71]] = 1
    expected[72:] = target
    np.testing.assert_allclose(obs, expected, atol=1e-4)


def test_observation_of_motion_and_orientation(physics):
    cube, goal = (Rotation.from_euler("xyz", angles) for angles in ((0.4, -1.1, 2.0), (-0.7, 0.3, 1.2)))
    speeds, spin = np.linspace(-6, 6, 16), np.array([3.0, -2.0, 1.0])
    moving = hand(
        physics, angles=np.full(16, 0.5), speeds=speeds, position=(0.01, -0.18, 0.55), turn=scalar_first(cube),
        velocity=(0.3, -0.2, 0.1), spin=spin, goal=scalar_first(goal),
    )  # fmt: skip
    obs = allegro_hand.observe(moving, LOW, HIGH)
    low, high = LIMITS.T
    torques = np.clip(3 * ((low + high) / 2 - 0.5) - 0.1 * speeds, -0.5, 0.5)
    np.testing.assert_allclose(obs[:16], (1 - high - low) / (high - low), atol=1e-5)
    np.testing.assert_allclose(obs[16:32], speeds / 5, atol=1e-6)
    np.testing.assert_allclose(obs[32:48], 10 * torques, atol=1e-5)
    np.testing.assert_allclose(obs[48:51], (0.01, -0.18, 0.55), atol=1e-6)
    np.testing.assert_allclose(obs[51:55], cube.as_quat(), atol=1e-6)
    np.testing.assert_allclose(obs[55:58], (0.3, -0.2, 0.1), atol=1e-6)
    np.testing.assert_allclose(obs[58:61], 0.2 * cube.apply(spin), atol=1e-6)
    np.testing.assert_allclose(obs[64:68], goal.as_quat(), atol=1e-6)
    between = Rotation.from_quat(np.asarray(obs[68:72]))
    assert (between.inv() * cube * goal.inv()).magnitude() < 1e-3


# Episodes


def test_episodes_start_at_rest_with_the_cube_in_the_hand(env, physics):
    state = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 64), jnp.arange(64))
    qpos = np.asarray(state.physics.body.qpos)
    assert len(np.unique(qpos, axis=0)) > 50
    assert np.all(qpos[:, :16] >= LIMITS[:, 0] - 0.02)
    assert np.all(qpos[:, :16] <= LIMITS[:, 1] + 0.02)
    held = jax.jit(jax.vmap(env.step, in_axes=(0, 0, None, None)))
    after = state
    for _ in range(15):  # half a second
        after = held(after, jnp.zeros((64, 16)), True, jax.random.key(0))
    moved = np.linalg.norm(np.asarray(after.physics.body.qpos[:, 16:19]) - qpos[:, 16:19], axis=1)
    assert np.median(moved) < 5e-3
    assert not after.violation.any()


def test_goals_are_two_turns():
    """About the world's y, then its x, each uniform."""
    goals = np.asarray(jax.vmap(allegro_hand.draw_orientation)(jax.random.split(jax.random.key(0), 2000)))
    np.testing.assert_allclose(np.linalg.norm(goals, axis=1), 1, atol=1e-6)
    turns = Rotation.from_quat(np.roll(goals, -1, axis=1)).as_matrix()
    np.testing.assert_allclose(turns[:, 0, 1], 0, atol=1e-6)  # the cube's y stays in the world's plane of y and z
    about_x = np.arctan2(turns[:, 2, 1], turns[:, 1, 1])
    np.testing.assert_allclose([about_x.mean(), about_x.std()], [0, np.pi / np.sqrt(3)], atol=0.15)


def test_reward_far_from_the_goal(env, step, start):
    action = jnp.linspace(-2, 2, 16)
    after = step(start, action)
    body, goal, _ = after.physics
    angle = (Rotation.from_quat(np.roll(body.qpos[19:23], -1)) * Rotation.from_quat(np.roll(goal, -1)).inv()).magnitude()
    assert angle > 0.1
    distance = np.linalg.norm(np.asarray(body.qpos[16:19]) - (0, -0.2, 0.52))
    expected = -10 * distance + 1 / (angle + 0.1) - 2e-4 * np.sum(np.clip(action, -1, 1) ** 2)
    np.testing.assert_allclose(after.reward, expected, rtol=1e-4)
    assert not after.success


@pytest.mark.parametrize(("turn", "reached"), [(0.05, True), (0.25, False)])
def test_a_goal_is_reached_within_a_tenth_of_a_radian(env, step, start, turn, reached):
    body = start.physics.body
    near = Rotation.from_rotvec([0, 0, turn]) * Rotation.from_quat(np.roll(body.qpos[19:23], -1))
    sign = -1 if reached else 1  # the same orientation has two quaternions
    goal = jnp.asarray(sign * scalar_first(near), jnp.float32)
    after = step(start._replace(physics=start.physics._replace(goal=goal)), jnp.zeros(16))
    assert bool(after.success) == reached
    assert (after.reward > 200) == reached
    fresh = env.next_goal(after, jax.random.key(1))
    np.testing.assert_allclose(fresh.obs[:61], after.obs[:61], atol=1e-5)
    np.testing.assert_allclose(fresh.obs[72:], after.obs[72:], atol=1e-6)
    np.testing.assert_allclose(fresh.obs[64:68], np.roll(fresh.physics.goal, -1), atol=1e-6)
    assert fresh.episode_step == after.episode_step == 1
    assert np.abs(fresh.physics.goal - goal).max() > 1e-3


@pytest.mark.parametrize(("distance", "dropped"), [(0.22, False), (0.26, True)])
def test_a_dropped_cube_is_a_violation(step, start, distance, dropped):
    body = start.physics.body
    away = body.qpos.at[16:19].set(jnp.array([0, -0.2 - distance, 0.52]))
    after = step(start._replace(physics=start.physics._replace(body=body._replace(qpos=away))), jnp.zeros(16))
    assert bool(after.violation) == dropped
    assert not after.success


def test_an_action_changes_targets_between_the_limits(physics, step, start):
    """By .3 of half a joint's range at most; the observation tells where they are."""
    action = jnp.linspace(-1.5, 1.5, 16)
    low, high = LIMITS.T
    state, data = start, mujoco.MjData(physics.model)
    data.qpos[:] = state.physics.body.qpos
    target = np.asarray(state.physics.target)
    np.testing.assert_allclose(target, np.clip(2 * (data.qpos[:16] - low) / (high - low) - 1, -1, 1), atol=1e-5)
    for _ in range(7):
        state, target = step(state, action), np.clip(target + 0.3 * np.clip(action, -1, 1), -1, 1)
        data.ctrl[:] = low + (target + 1) / 2 * (high - low)
        mujoco.mj_step(physics.model, data, 4)
        np.testing.assert_allclose(state.obs[72:], target, atol=1e-6)
    np.testing.assert_allclose(state.physics.body.qpos[:16], data.qpos[:16], atol=1e-2)
    np.testing.assert_array_equal(target[[0, -1]], [-1, 1])


# What the expert sees


@pytest.fixture(scope="module")
def turned(physics):
    """Cubes as drawn, and turned onto themselves together with their goals: observations f32[24, 88] of one hand."""
    cube, goal = Rotation.random(rng=np.random.default_rng(1)), Rotation.random(rng=np.random.default_rng(2))
    angles = np.linspace(0.3, 0.6, 16)
    hands = [
        hand(
            physics,
            angles=angles,
            speeds=0.5,
            turn=scalar_first(cube * same),
            goal=scalar_first(goal * same),
            target=jnp.linspace(-1, 1, 16),
        )
        for same in Rotation.create_group("O")
    ]
    return cube, goal, np.stack([allegro_hand.observe(h, LOW, HIGH) for h in hands])


def test_the_view_is_the_same_for_a_cube_turned_onto_itself(turned):
    _, _, obs = turned
    assert np.ptp(obs[:, 51:55], axis=0).min() > 0.5
    np.testing.assert_allclose(np.ptp(allegro_hand.view(obs), axis=0), 0, atol=2e-6)


def test_the_view_is_the_same_for_both_quaternions_of_a_turn(turned):
    obs = turned[2][0]
    for entries in (slice(51, 55), slice(68, 72)):
        other = obs.copy()
        other[entries] *= -1
        np.testing.assert_allclose(allegro_hand.view(other), allegro_hand.view(obs), atol=2e-6)


def test_the_view_entry_by_entry(turned):
    cube, goal, obs = turned
    view = np.asarray(allegro_hand.view(obs[0]))
    np.testing.assert_array_equal(view[:32], obs[0, :32])
    np.testing.assert_allclose(view[32:35], 0, atol=1e-6)
    edges = cube.as_matrix()
    moments = np.einsum("ai,bi,ci,di->abcd", edges, edges, edges, edges)
    np.testing.assert_allclose(view[35], moments[0, 0, 0, 0], atol=1e-6)
    np.testing.assert_allclose(view[39], moments[0, 0, 1, 2], atol=1e-6)
    np.testing.assert_allclose(view[49], moments[2, 2, 2, 2], atol=1e-6)
    six = np.concatenate([edges.T, -edges.T])
    np.testing.assert_allclose(view[50:53], six[np.argmax(six[:, 0])], atol=1e-6)
    np.testing.assert_allclose(view[53:56], six[np.argmax(six[:, 2])], atol=1e-6)
    np.testing.assert_array_equal(view[56:62], obs[0, 55:61])
    left = goal * cube.inv()
    np.testing.assert_allclose(view[62:65], left.as_rotvec(), atol=1e-5)
    np.testing.assert_allclose(view[65], left.magnitude(), atol=1e-5)
    np.testing.assert_allclose(view[66:69], left.as_rotvec() / (left.magnitude() + 0.1), atol=1e-5)
    np.testing.assert_array_equal(view[69:], obs[0, 72:])


def test_the_view_at_the_goal_is_finite(physics):
    obs = allegro_hand.observe(hand(physics), LOW, HIGH)
    np.testing.assert_allclose(allegro_hand.view(obs)[62:69], 0, atol=1e-6)


@pytest.mark.parametrize("angle", [0.05, 0.099, 0.101, 1.0, np.pi])
def test_the_success_margin_is_the_distance_from_the_tolerance_and_has_a_derivative(physics, env, start, angle):
    def margin(turn):
        goal = jnp.roll(jnp.asarray(Rotation.from_euler("zyx", [0.3, 0.2, 0.1]).as_quat(), jnp.float32), 1)
        turned = jnp.concatenate([jnp.cos(turn / 2)[None], jnp.sin(turn / 2) * jnp.array([0.6, 0.0, 0.8])])
        state = start._replace(physics=hand(physics, turn=multiply(turned, goal), goal=goal))
        return env.success_margin(state)

    value, slope = jax.value_and_grad(margin)(jnp.float32(angle))
    np.testing.assert_allclose(value, 1 - np.sin(angle / 2) / np.sin(0.05), rtol=1e-4, atol=1e-4)
    assert (value > 0) == (angle <= allegro_hand.TOLERANCE)
    np.testing.assert_allclose(slope, -0.5 * np.cos(angle / 2) / np.sin(0.05), rtol=1e-3, atol=1e-4)
