"""Phase correlation and Fourier-Mellin against OpenCV, scikit-image and known warps."""

from pathlib import Path

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import chi2

from jaxloc.alignment import phase_correlation
from jaxloc.images.spectrum import LogPolar

SIDE = 96
SHIFT = np.array([4.3, -2.6])
SAMPLING = LogPolar(angles=128, radii=128)


def moved(image, right, down):
    fu, fv = np.meshgrid(np.fft.fftfreq(image.shape[1]), np.fft.fftfreq(image.shape[0]))
    return np.fft.ifft2(np.fft.fft2(image) * np.exp(-2j * np.pi * (fu * right + fv * down))).real


def texture(rng, side=2 * SIDE, sigma=0.8):
    image = np.fft.fft2(rng.normal(size=(side, side)))
    fu, fv = np.meshgrid(np.fft.fftfreq(side), np.fft.fftfreq(side))
    frequency = np.hypot(fu, fv)
    image = np.fft.ifft2(image * np.exp(-2 * (np.pi * sigma * frequency) ** 2) / np.maximum(frequency, 0.02)).real
    return 120 + 40 * image / image.std()


def pair(rng, dtype=np.float32, shift=SHIFT):
    scene = texture(rng)
    views = scene[40 : 40 + SIDE, 40 : 40 + SIDE], moved(scene, *shift)[40 : 40 + SIDE, 40 : 40 + SIDE]
    return [jnp.asarray(view, dtype) for view in views]


def test_translation_finds_the_shift(rng, dtype):
    for shift in (SHIFT, np.array([-11.25, 7.5])):
        previous, current = pair(rng, dtype, shift)
        found = phase_correlation.translation(previous, current)
        assert bool(found.ok) and found.value.translation.dtype == dtype
        np.testing.assert_allclose(found.value.translation, shift, atol=0.1)


def test_translation_beside_peers(rng):
    registration = pytest.importorskip("skimage.registration")
    previous, current = (np.asarray(x, float) for x in pair(rng))
    found = phase_correlation.translation(jnp.asarray(previous, jnp.float32), jnp.asarray(current, jnp.float32))
    opencv = cv2.phaseCorrelate(previous, current, cv2.createHanningWindow((SIDE, SIDE), cv2.CV_64F))[0]
    peer = registration.phase_cross_correlation(current, previous, upsample_factor=50)[0][::-1]
    np.testing.assert_allclose(found.value.translation, opencv, atol=0.5)
    np.testing.assert_allclose(found.value.translation, peer, atol=0.5)
    error = np.linalg.norm(np.asarray(found.value.translation) - SHIFT)
    assert error < np.linalg.norm(np.array(opencv) - SHIFT)


def test_covariance_is_calibrated(rng):
    views = np.stack(pair(rng, float))
    noisy = jnp.asarray(views + 4 * rng.normal(size=(200, *views.shape)), jnp.float32)
    found = jax.vmap(lambda both: phase_correlation.translation(both[0], both[1]))(noisy)
    error = np.asarray(found.value.translation, float) - SHIFT
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(np.asarray(found.covariance, float)), error)
    # Never smaller than the scatter, and at most 40 % larger.
    assert np.asarray(found.ok).all() and 1.2 < nees.mean() < chi2.ppf(0.995, 2 * 200) / 200


def test_derivatives(rng, x64):
    previous, current = pair(rng, np.float64)
    across = jnp.asarray(rng.normal(size=previous.shape))
    place = jax.jit(lambda t: phase_correlation.translation(previous, current + t * across).value.translation)
    got = jax.jacfwd(place)(0.0)
    np.testing.assert_allclose(got, (place(1e-4) - place(-1e-4)) / 2e-4, rtol=1e-3, atol=1e-6)


def test_degenerate_images(rng):
    previous, current = pair(rng)
    unrelated = jnp.asarray(rng.normal(size=(SIDE, SIDE)), jnp.float32)
    cases = {
        "flat": (jnp.full_like(previous, 9.0), current),
        "both flat": (jnp.full_like(previous, 9.0),) * 2,
        "unrelated": (unrelated, current),
        "nan": (jnp.full_like(previous, jnp.nan), current),
    }
    both = jax.jit(
        jax.value_and_grad(
            lambda a, b: (jnp.sum((f := phase_correlation.translation(a, b)).value.translation), f), has_aux=True
        )
    )
    for name, images in cases.items():
        (total, found), slope = both(*images)
        assert not bool(found.ok), name
        assert all(np.all(np.isfinite(leaf)) for leaf in (total, slope, *jax.tree.leaves(found))), name
    dotted = phase_correlation.translation(previous.at[3, 4].set(jnp.nan), current)
    assert bool(dotted.ok) and np.all(np.isfinite(dotted.covariance))


def test_bytes_and_shapes(rng):
    previous, current = (jnp.clip(jnp.round(x), 0, 255).astype(jnp.uint8) for x in pair(rng))
    np.testing.assert_allclose(phase_correlation.translation(previous, current).value.translation, SHIFT, atol=0.1)
    for function in (phase_correlation.translation, phase_correlation.similarity):
        with pytest.raises(ValueError):
            function(previous, current[:-1])
    with pytest.raises(ValueError):
        phase_correlation.similarity(previous, current, rounds=0)


@pytest.mark.slow
def test_similarity_finds_any_turn(rng):
    skimage_data = pytest.importorskip("skimage.data")
    scene = cv2.imread(str(Path(skimage_data.__file__).with_name("brick.png")), cv2.IMREAD_GRAYSCALE)
    scene = cv2.GaussianBlur(scene.astype(float), (0, 0), 1.0)
    side, center = 128, np.array([63.5, 63.5])
    corners = np.array([[0, 0, 1], [127, 0, 1], [0, 127, 1], [127, 127, 1]]).T
    for degrees, scale in ((25, 1.2), (-100, 0.8), (178, 1.0), (90, 1.35), (-45, 0.72)):
        angle, shift = np.radians(degrees), rng.uniform(-6, 6, 2)
        warp = np.eye(3)
        warp[:2, :2] = scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        warp[:2, 2] = center + shift - warp[:2, :2] @ center
        back = np.linalg.inv(warp)[:2]
        back[:, 2] += 192
        image = cv2.warpAffine(scene, back, (side, side), flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP)
        template = scene[192 : 192 + side, 192 : 192 + side]
        found = phase_correlation.similarity(
            jnp.asarray(image, jnp.float32), jnp.asarray(template, jnp.float32), sampling=SAMPLING
        )
        error = (np.asarray(found.value.matrix()) - warp) @ corners
        assert bool(found.ok), degrees
        assert np.sqrt(np.mean(np.sum(error[:2] ** 2, axis=0))) < 1.0, degrees


def test_similarity_of_blank_images():
    found = phase_correlation.similarity(jnp.zeros((128, 128)), jnp.zeros((128, 128)), sampling=SAMPLING)
    assert not bool(found.ok) and all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(found))
