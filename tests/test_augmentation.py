"""Augmented images: each change has the size that the paper gives, and what is stored keeps its label."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage

import fleetjax
from fleetjax.learning import augmentation, imitation

IMAGE_SHAPE = (16, 12, 3)


def oracle(image, key):
    """Return what the definition gives, in NumPy and with SciPy's Gaussian filter."""
    keys = jax.random.split(key, 7)

    def uniform(i, low, high, shape=()):
        return np.asarray(jax.random.uniform(keys[i], shape, minval=low, maxval=high), np.float64)

    image = 127.5 + uniform(0, 0.85, 1.15) * (image - 127.5)
    image = np.clip(image + uniform(1, -10, 10, (3,)), 0, 255)
    image = 255 * (image / 255) ** uniform(2, 0.9, 1.1)
    for axis in (0, 1):
        image = ndimage.gaussian_filter1d(image, uniform(3, 0, 0.3), axis=axis, mode="nearest", radius=1)
    grey = image @ [0.299, 0.587, 0.114]
    image = grey[..., None] + uniform(4, 0.95, 1.05) * (image - grey[..., None])
    image += uniform(5, 0, 255 / 80) * np.asarray(jax.random.normal(keys[6], image.shape), np.float64)
    return np.clip(image, 0, 255)


@pytest.mark.parametrize("seed", [0, 1, 2, 3, 4, 21])  # 21 draws almost the widest blur
def test_an_augmented_image_is_that_of_the_definition(seed):
    image = np.random.default_rng(seed).integers(0, 256, IMAGE_SHAPE).astype(np.float32)
    found = np.asarray(jax.jit(augmentation.augment)(image, jax.random.key(seed)))
    assert np.all(found == np.round(found))
    assert np.abs(found - oracle(image, jax.random.key(seed))).max() <= 0.51
    assert np.abs(found - image).mean() > 1


@pytest.mark.slow
def test_changes_have_the_sizes_of_the_paper():
    """On a grey image contrast, blur and saturation change nothing: the additions are within 10, and so on."""
    image = jnp.full(IMAGE_SHAPE, 127.5)
    found = np.asarray(jax.vmap(augmentation.augment, in_axes=(None, 0))(image, jax.random.split(jax.random.key(0), 600)))
    means = found.mean(axis=(1, 2))
    assert 127.5 * 0.85 < means.min() < 114
    assert 141 < means.max() < 127.5 * 1.15
    noise = found.std(axis=(1, 2)).mean(axis=1)
    assert noise.min() < 0.6
    assert 2.7 < noise.max() < 3.7


def stored(copies, mask):
    spec = fleetjax.EnvSpec("images", 16 * 12 * 3, 4, 10, 1.0, discrete=True, image_shape=IMAGE_SHAPE)
    data = imitation.create_data(spec, ensemble_size=1, capacity=40)
    obs = jnp.round(jax.random.uniform(jax.random.key(0), (3, spec.observation_size), maxval=255))
    pairs = imitation.Pair(obs, jax.nn.one_hot(jnp.array([2, 0, 1]), 4))
    options = {"image_shape": IMAGE_SHAPE, "copies": copies}
    return obs, jax.jit(lambda d: imitation.append_augmented(d, pairs, jnp.array(mask), jax.random.key(1), **options))(data)


def test_each_pair_is_stored_in_copies_with_its_action():
    obs, data = stored(10, [True, False, True])
    assert int(data.pairs.added) == 20
    images, actions = np.asarray(data.pairs.rows.obs[:20]), np.asarray(data.pairs.rows.action[:20])
    assert images.dtype == np.uint8
    np.testing.assert_array_equal(actions.argmax(axis=1), [2] * 10 + [1] * 10)
    assert len(np.unique(images, axis=0)) == 20
    near = [np.argmin(np.abs(np.asarray(obs) - image).mean(axis=1)) for image in images]
    assert near == [0] * 10 + [2] * 10
    assert np.all(data.resample[:20] < 20)


def test_nobody_helped_nothing_is_stored():
    _, data = stored(10, [False, False, False])
    assert int(data.pairs.added) == 0
    assert not data.pairs.rows.obs.any()


def test_copies_need_images():
    with pytest.raises(ValueError, match="augmented_copies = 3 needs images, and environment = 'navigation' has none"):
        fleetjax.make_config("navigation", augmented_copies=3)
