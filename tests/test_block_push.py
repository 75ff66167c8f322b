"""Block pushing: what a push does, what is out of bounds, what the image shows, what the teacher would do."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fleetjax
from fleetjax import envs
from fleetjax.envs import base, block_push

RIGHT, UP, LEFT, DOWN = range(4)


@pytest.fixture(scope="module")
def env():
    return envs.make("block_push")


def table(position=(0.0, 0.0), angle=0.0, goal=(0.5, 0.5)):
    return block_push.Table(jnp.array(position, jnp.float32), jnp.float32(angle), jnp.array(goal, jnp.float32))


def begun(*args, **kwargs):
    """Return an episode that begins with such a table."""
    what = table(*args, **kwargs)
    return base.begin(what, block_push.observe(what))


def pushes(env, state, face, number=2000):
    """Return the states after many independent pushes of one face."""
    keys = jax.random.split(jax.random.key(face), number)
    action = jax.nn.one_hot(face, 4)
    return jax.jit(jax.vmap(lambda key: env.step(state, action, jnp.bool_(True), key)))(keys)


@pytest.mark.parametrize(("face", "way"), [(RIGHT, (1, 0)), (UP, (0, 1)), (LEFT, (-1, 0)), (DOWN, (0, -1))])
def test_a_push_moves_the_cube_away_from_its_face_slips_and_turns_it(env, face, way):
    after = pushes(env, begun(), face)
    moved, way = np.asarray(after.physics.position), np.array(way)
    along, sideways = moved @ way, moved @ [-way[1], way[0]]
    assert 0.105 - 1e-6 <= along.min() < 0.107
    assert 0.148 < along.max() <= 0.15 + 1e-6
    np.testing.assert_allclose(along.mean(), 0.1275, atol=1e-3)
    np.testing.assert_allclose([sideways.mean(), sideways.std()], [0, 0.015], atol=1.5e-3)
    np.testing.assert_allclose([after.physics.angle.mean(), after.physics.angle.std()], [0, 0.06], atol=5e-3)


@pytest.mark.slow
def test_faces_turn_with_the_cube_and_look_alike_after_a_quarter(env):
    turned = pushes(env, begun(angle=0.5), UP).physics
    np.testing.assert_allclose(turned.position.mean(axis=0), 0.1275 * np.array([-np.sin(0.5), np.cos(0.5)]), atol=2e-3)
    over = pushes(env, begun(angle=np.pi / 4 - 1e-3), UP).physics.angle
    assert -np.pi / 4 <= over.min() < -0.6  # turned on, it is called by the other end of the range
    assert 0.6 < over.max() < np.pi / 4


@pytest.mark.parametrize(
    ("position", "angle", "lost"),
    [
        ((0.79, 0.0), 0.0, False),
        ((0.81, 0.0), 0.0, True),
        ((-0.81, 0.0), 0.0, True),
        ((0.0, 0.81), 0.0, True),
        ((0.0, -0.81), 0.0, True),
        ((0.77, 0.0), 0.0, False),
        ((0.77, 0.0), np.pi / 4 - 1e-3, True),  # a corner of the cube touches the border
        ((0.69, 0.69), 0.0, False),
        ((0.71, 0.71), 0.0, True),
        ((-0.71, -0.71), 0.0, True),
        ((-0.75, 0.75), 0.0, False),  # these two corners can be reached
        ((0.75, -0.75), 0.0, False),
    ],
)
def test_border_and_two_opposite_corners_are_violations(position, angle, lost):
    assert bool(block_push.is_lost(jnp.array(position), jnp.float32(angle))) == lost


def test_a_push_over_the_border_is_a_violation_and_no_success(env):
    after = pushes(env, begun((0.78, 0.0), goal=(0.85, 0.0)), RIGHT)
    assert after.violation.all()
    assert not after.success.any()


def test_a_goal_is_reached_within_its_radius(env):
    after = pushes(env, begun(goal=(0.22, 0.0)), RIGHT)
    distance = np.linalg.norm(np.asarray(after.physics.position) - [0.22, 0.0], axis=1)
    assert 0.3 < np.mean(distance < 0.1) < 0.9
    np.testing.assert_array_equal(after.success, distance < 0.1)


def test_a_goal_that_is_reached_is_a_success_and_gives_way_to_a_new_one(env):
    state = begun((0.4, 0.4), goal=(0.53, 0.4))
    after = pushes(env, state, RIGHT)
    assert after.success.mean() > 0.99
    assert not pushes(env, state, LEFT).success.any()
    left = np.linalg.norm(after.physics.goal - after.physics.position, axis=1)
    np.testing.assert_allclose(after.reward, 0.13 - left, atol=1e-6)  # by how much it came closer
    one = jax.tree.map(lambda x: x[0], after)
    renewed = env.next_goal(one, jax.random.key(0))
    np.testing.assert_array_equal(renewed.physics.position, one.physics.position)
    np.testing.assert_array_equal(renewed.obs, block_push.observe(renewed.physics))
    assert np.linalg.norm(renewed.physics.goal - renewed.physics.position) >= block_push.NEAREST_GOAL


def test_starts_and_goals_are_in_bounds(env):
    start = jax.jit(jax.vmap(lambda k: env.reset(k, jnp.int32(0)).physics))(jax.random.split(jax.random.key(0), 3000))
    goal, position = np.asarray(start.goal), np.asarray(start.position)
    assert np.abs(position).max() <= 0.3
    assert 0.58 < np.abs(goal).max() <= 0.6
    assert np.abs(goal.sum(axis=1)).max() < 1.1
    assert np.linalg.norm(goal - position, axis=1).min() >= 0.3
    assert not jax.vmap(block_push.is_lost, in_axes=(0, None))(start.goal, np.pi / 4).any()


def test_the_image_shows_cube_goal_and_bounds():
    """Each where it is: x to the right, y upwards, a pixel is 1/32."""
    image = np.asarray(block_push.observe(table((0.5, 0.25), 0.0, (-0.5, -0.25)))).reshape(64, 64, 3)

    def pixel(x, y):
        return image[int((1 - y) * 32), int((1 + x) * 32)]

    assert np.all(image == np.round(image))
    np.testing.assert_array_equal(pixel(0.5, 0.25), block_push.FACE)
    np.testing.assert_array_equal(pixel(0.0, 0.0), block_push.WOOD)
    red = [pixel(x, y) for x, y in ((0.97, 0), (-0.97, 0), (0, 0.97), (0, -0.97), (0.85, 0.85), (-0.85, -0.85))]
    np.testing.assert_array_equal(red, [block_push.LOST] * 6)
    np.testing.assert_array_equal([pixel(0.85, -0.85), pixel(-0.85, 0.85)], [block_push.WOOD] * 2)
    green = pixel(-0.5 + 0.09, -0.25)
    assert green[1] > green[0] + 30
    np.testing.assert_array_equal(pixel(-0.5, -0.25), block_push.WOOD)  # the ring is open
    blue = image[..., 2] > image[..., 0] + 60
    assert abs(blue.sum() - (0.2 * 32) ** 2) < 12


def test_people_see_the_same_in_more_pixels(env):
    state = begun((0.3, -0.2), 0.4)
    large = np.asarray(env.picture(state), np.float32)
    assert large.shape == (256, 256, 3)
    small = np.asarray(state.obs).reshape(64, 64, 3)
    assert np.abs(large.reshape(64, 4, 64, 4, 3).mean(axis=(1, 3)) - small).mean() < 2.0


@pytest.mark.parametrize(
    ("position", "angle", "goal", "good"),
    [
        ((0, 0), 0.0, (0.5, 0.5), {RIGHT, UP}),
        ((0, 0), 0.0, (-0.5, 0.4), {LEFT, UP}),
        ((0, 0), 0.0, (0.6, 0.0), {RIGHT}),
        ((0, 0), 0.7, (0.0, 0.6), {UP, RIGHT}),  # the cube is turned: its right face pushes up as well
        ((0.62, -0.4), 0.0, (0.9, -0.2), {UP}),  # to the right would be quicker, if it were safe
    ],
)
def test_the_teacher_knows_all_good_pushes(position, angle, goal, good):
    found = set(np.flatnonzero(block_push.good_pushes(table(position, angle, goal))))
    assert found == good
    keys = jax.random.split(jax.random.key(0), 400)
    actions = jax.jit(jax.vmap(lambda key: block_push.teach(begun(position, angle, goal), key)))(keys)
    counts = np.asarray(actions).sum(axis=0)
    assert set(np.flatnonzero(counts)) == good
    assert counts[sorted(good)].min() > 0.4 * 400 / len(good)


@pytest.mark.slow
def test_the_teacher_reaches_goal_after_goal_without_a_violation(env):
    config = fleetjax.make_config("block_push", "expert", num_robots=64, num_steps=250)
    metrics = jax.jit(fleetjax.run)(config, jax.random.key(0)).metrics
    assert int(metrics.violations.sum()) == 0
    assert int(metrics.successes.sum()) / 64 > 30  # a goal every eight pushes


@pytest.mark.statistical
@pytest.mark.slow
def test_what_the_teacher_shows_is_learnt_from_images():
    """A policy of chance reaches none of these goals: see the second half."""
    config = fleetjax.make_config("block_push", "constraint", num_steps=60, num_robots=24, pretraining_steps=1500)
    config = config.replace(extra_demonstrations=0)
    state = jax.jit(fleetjax.prepare)(config, jax.random.key(0))
    pairs = state.human_data.pairs
    assert int(pairs.added) == 3750
    assert pairs.rows.obs.dtype == jnp.uint8
    learnt = jax.jit(fleetjax.evaluate)(config, jax.random.key(1), state.policy).metrics
    chance = state.policy._replace(params=jax.tree.map(jnp.zeros_like, state.policy.params))
    none = jax.jit(fleetjax.evaluate)(config, jax.random.key(1), chance).metrics
    assert int(learnt.successes.sum()) > 24  # about 50
    assert int(none.successes.sum()) < 12
