"""Exposure taken out [K-22]: what is left does not know gain and bias; SciPy and NumPy are the oracles."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import uniform_filter
from scipy.stats import rankdata

from jaxloc.images.normalization import as_gray, fit_gain_bias, rank_transform, standardize, standardize_locally


@pytest.fixture
def photo(rng):
    return rng.uniform(0, 200, (12, 17))


def test_standardize_is_a_z_score(photo, dtype):
    image = jnp.asarray(photo, dtype)
    result = standardize(image)
    assert result.dtype == dtype
    np.testing.assert_allclose(result, (photo - photo.mean()) / photo.std(), atol=1e-4)
    np.testing.assert_allclose(standardize(0.6 * image + 30), result, atol=1e-4)


def test_what_is_not_valid_does_not_count(photo):
    image = jnp.asarray(photo, jnp.float32).at[2, 3].set(jnp.nan)
    valid = jnp.ones(image.shape, bool).at[0].set(False)
    kept = np.asarray(valid) & np.isfinite(np.asarray(image))
    result = standardize(image, valid=valid)
    np.testing.assert_allclose(result[kept], (photo[kept] - photo[kept].mean()) / photo[kept].std(), atol=1e-4)
    assert np.all(np.asarray(result)[~kept] == 0)
    gradient = jax.grad(lambda x: jnp.sum(standardize(x, valid=valid) ** 3))(image)
    assert np.all(np.isfinite(gradient))


def test_flat_images_stay_finite():
    flat = jnp.full((5, 5), 173.3)
    assert np.all(np.asarray(standardize(flat)) == 0)
    assert np.all(np.isfinite(jax.grad(lambda x: standardize(x).sum())(flat)))
    fit = fit_gain_bias(flat, flat)
    assert not fit.ok and float(fit.gain) == 1.0


def test_gain_and_bias_equal_a_line_fit(photo, rng):
    image = 0.7 * photo + 12 + rng.normal(size=photo.shape)
    slope, offset = np.polyfit(photo.ravel(), image.ravel(), 1)
    fit = fit_gain_bias(jnp.asarray(image, jnp.float32), jnp.asarray(photo, jnp.float32))
    np.testing.assert_allclose([fit.gain, fit.bias], [slope, offset], rtol=1e-3)
    assert bool(fit.ok)


def test_local_standardization_equals_filters(photo):
    mean = uniform_filter(photo, 5, mode="mirror")
    variance = uniform_filter(photo**2, 5, mode="mirror") - mean**2
    result = standardize_locally(jnp.asarray(photo, jnp.float32), radius=2)
    np.testing.assert_allclose(result, (photo - mean) / np.sqrt(variance + 1), atol=1e-3)


def test_rank_counts_darker_neighbors(photo):
    result = np.asarray(rank_transform(jnp.asarray(photo, jnp.float32), radius=2))
    window = photo[3:8, 4:9]
    assert result[5, 6] == pytest.approx((rankdata(window)[12] - 1) / 24)
    darker = rank_transform(jnp.asarray((photo / 255) ** 2.2, jnp.float32), radius=2)
    np.testing.assert_array_equal(darker, result)


def test_bytes_keep_their_values_and_color_is_refused():
    assert as_gray(np.array([[7, 255]], np.uint8)).tolist() == [[7.0, 255.0]]
    with pytest.raises(ValueError, match="two axes"):
        as_gray(np.zeros((4, 4, 3)))
