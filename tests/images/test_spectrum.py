"""Spectra: amplitudes know no shift [R-33]; NumPy is the oracle."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxloc.images.spectrum import amplitude, hann


def test_amplitude_knows_no_shift(rng):
    image = jnp.asarray(rng.normal(size=(31, 40)), jnp.float32)
    np.testing.assert_allclose(amplitude(image), np.abs(np.fft.fft2(image)), rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(amplitude(jnp.roll(image, (5, 9), (0, 1))), amplitude(image), rtol=1e-3, atol=1e-3)
    assert np.all(np.isfinite(jax.grad(lambda x: amplitude(x).sum())(jnp.zeros((8, 8)))))


def test_window_fades(dtype):
    window = hann((16, 20), dtype)
    assert window.dtype == dtype and float(window[0].max()) < 0.01 < 0.95 < float(window.max()) <= 1.0
