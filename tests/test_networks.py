"""Networks that see images: patches, then places, against NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fleetjax
from fleetjax.learning import networks

SHAPE = (8, 12, 3)
SPEC = fleetjax.EnvSpec("images", 8 * 12 * 3, 4, 10, 1.0, discrete=True, image_shape=SHAPE)


def relu(x):
    return np.maximum(x, 0)


def dense(params, name, x):
    return x @ np.asarray(params[name]["kernel"], np.float64) + np.asarray(params[name]["bias"], np.float64)


def oracle(params, x):
    """Return what the network gives for one input f32[O + K]: patch by patch, place by place."""
    image, others = np.asarray(x[:288], np.float64).reshape(SHAPE), np.asarray(x[288:], np.float64)
    layers = params["params"]
    first = layers["layers_0"]
    features = np.empty((2, 3, 16))
    for i in range(2):
        for j in range(3):
            patch = image[4 * i : 4 * i + 4, 4 * j : 4 * j + 4].ravel()
            features[i, j] = relu(dense(first, "Dense_1", relu(dense(first, "Dense_0", patch))))
    weight = np.exp(np.asarray(first["sharpness"]) * features)
    weight /= weight.sum(axis=(0, 1))
    x_place = (weight * np.array([-1, 0, 1])[None, :, None]).sum(axis=(0, 1))
    y_place = (weight * np.array([-1, 1])[:, None, None]).sum(axis=(0, 1))
    places = np.stack([x_place, y_place], axis=1).ravel()
    return dense(layers, "layers_3", relu(dense(layers, "layers_1", np.concatenate([places, others]))))


def test_an_image_network_is_that_of_the_definition():
    network = networks.make_network(SPEC, (16,), 2)
    apply = jax.jit(network.apply)
    x = jax.random.normal(jax.random.key(0), (5, SPEC.observation_size + 4))
    params = jax.tree.map(
        lambda p: p + 0.3 * jax.random.normal(jax.random.key(1), p.shape), jax.jit(network.init)(jax.random.key(2), x[0])
    )
    found = apply(params, x)
    np.testing.assert_allclose(found, [oracle(params, row) for row in x], atol=1e-4)
    np.testing.assert_allclose(apply(params, x[3]), found[3], atol=1e-5)
    changed = apply(params, x.at[:, -1].add(1.0))  # what follows the image counts as well
    assert np.abs(changed - found).min() > 1e-4


def test_pixel_values_come_to_unit_scale():
    normalizer = networks.pixel_normalizer(4)
    seen = normalizer(jnp.array([0, 255, 127, 128], jnp.uint8))
    np.testing.assert_allclose(seen, [-1.99, 1.99, -0.008, 0.008], atol=5e-3)


def test_images_that_patches_do_not_fit_are_refused():
    with pytest.raises(ValueError, match=r"image_shape = \(10, 12, 3\) must have height and width that 4 divides"):
        networks.make_network(SPEC._replace(image_shape=(10, 12, 3)), (16,), 2)


def test_observations_are_clipped_at_ten_deviations_and_only_where_they_are_normalised():
    obs = jnp.array([[0.0, 100.0], [2.0, 100.0], [1e6, -1e6]])
    fitted = networks.fit_normalizer(obs[:2], jnp.int32(2), enabled=True)
    np.testing.assert_allclose(fitted(obs), [[-1.0, 0.0], [1.0, 0.0], [10.0, -10.0]])  # the second entry never varies
    identity = networks.fit_normalizer(obs[:2], jnp.int32(2), enabled=False)
    np.testing.assert_array_equal(identity(obs), obs)
