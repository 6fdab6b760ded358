"""Tracking on textures that move exactly, under other exposures, beside OpenCV, and where it cannot work."""

import cv2
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.ndimage
from scipy.stats import chi2

from jaxloc.alignment.klt import Klt, prepare, track, track_frames, track_sequence
from jaxloc.alignment.klt.frames import relative_gain
from jaxloc.alignment.klt.patch_sums import regress, sum_patches

SHAPE, N = (120, 160), 100
# Gradients of small patches and few levels compile quickly.
SMALL = Klt(size=7, levels=2, chunk=16, num_steps=8)


class Texture:
    """A periodic 1/f texture that moves by any fraction of a pixel (Fourier shift theorem)."""

    def __init__(self, seed=0):
        fu, fv = np.meshgrid(np.fft.fftfreq(SHAPE[1]), np.fft.fftfreq(SHAPE[0]))
        frequency = np.hypot(fu, fv)
        shape = np.where(frequency > 0, 1 / np.maximum(frequency, 1e-3), 0) * np.exp(-((frequency / 0.2) ** 2))
        self.spectrum = np.fft.fft2(np.random.default_rng(seed).normal(size=SHAPE)) * shape
        self.fu, self.fv = fu, fv
        self.scale = 40 / np.fft.ifft2(self.spectrum).real.std()

    def moved(self, right, down):
        phase = np.exp(-2j * np.pi * (self.fu * right + self.fv * down))
        return 120 + self.scale * np.fft.ifft2(self.spectrum * phase).real


MOTION = np.array([5.3, -3.6])


def case(rng, gain=1.0, bias=0.0, noise=0.0, dtype=np.float32, seed=0):
    texture = Texture(seed)
    uv = np.stack([rng.uniform(16, side - 17, N) for side in SHAPE[::-1]], axis=1)
    previous = texture.moved(0, 0) + noise * rng.normal(size=SHAPE)
    current = gain * texture.moved(*MOTION) + bias + noise * rng.normal(size=SHAPE)
    return [jnp.asarray(x, dtype) for x in (previous, current, uv)], uv + MOTION


def errors(found, truth):
    return np.linalg.norm(np.asarray(found.points) - truth, axis=1)


def test_points_are_found(rng, dtype):  # K-27
    inputs, truth = case(rng, dtype=dtype)
    found = track(*inputs)
    assert found.points.dtype == found.covariance.dtype == dtype
    assert float(found.ok.mean()) > 0.97
    error = errors(found, truth)[np.asarray(found.ok)]
    assert np.median(error) < 0.03 and error.max() < 0.3


def test_opencv_agrees(rng):
    inputs, _ = case(rng)
    images = [np.asarray(x).clip(0, 255).round().astype(np.uint8) for x in inputs[:2]]
    uv = np.asarray(inputs[2])
    peer, status, _ = cv2.calcOpticalFlowPyrLK(*images, uv[:, None], None, winSize=(21, 21), maxLevel=3)
    found = track(*(jnp.asarray(x) for x in images), inputs[2])
    both = np.asarray(found.ok) & (status[:, 0] > 0)
    apart = np.linalg.norm(np.asarray(found.points) - peer[:, 0], axis=1)[both]
    assert both.mean() > 0.9 and np.median(apart) < 0.03 and np.quantile(apart, 0.95) < 0.2


@pytest.mark.parametrize("gain, bias", [(0.6, 30.0), (1.4, -40.0)])
def test_exposure_does_not_matter(rng, gain, bias):
    inputs, truth = case(rng, gain, bias, noise=2.0)
    found = track(*inputs)
    ok = np.asarray(found.ok)
    assert ok.mean() > 0.95 and (errors(found, truth) > 1).mean() <= 0.02
    assert np.median(errors(found, truth)[ok]) < 0.08
    np.testing.assert_allclose(np.median(np.asarray(found.gain)[ok]), gain, rtol=0.03)
    assert abs(float(relative_gain(*(prepare(x) for x in inputs[:2]))) / gain - 1) < 0.05


def test_covariance_is_calibrated(rng):
    squared = []
    for seed in range(5):
        inputs, truth = case(rng, 0.8, 10.0, 4.0, seed=seed)
        found = track(*inputs)
        error = np.asarray(found.points) - truth
        ok = np.asarray(found.ok)
        squared += list(np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.covariance), error)[ok] / 2)
    # Never smaller than the scatter, and at most twice as large.
    assert len(squared) > 480 and 0.5 < np.mean(squared) < chi2.ppf(0.995, 2 * len(squared)) / (2 * len(squared))


@pytest.mark.slow
def test_guess_and_way_back(rng):
    inputs, truth = case(rng)
    far = [inputs[0], jnp.roll(inputs[1], 30, axis=1), inputs[2]]
    guess = inputs[2] + jnp.asarray([[33.0, -2.0]])
    options = Klt(max_forward_backward=0.5)
    found = track(*inputs, options=options)
    ok = np.asarray(found.ok)
    assert ok.mean() > 0.9 and float(found.forward_backward[found.ok].max()) <= 0.5
    assert errors(found, truth)[ok].max() < 0.5
    straight = track(*far, initial=guess)
    inside = truth[:, 0] + 30 < SHAPE[1] - 12
    assert (errors(straight, truth + [30, 0]) < 0.3)[inside].mean() > 0.95


def test_regression_is_the_least_squares_fit(rng, x64):
    source, window, (right, down) = rng.normal(size=(10, 10)), rng.normal(size=(8, 8)), (0.3, 0.6)
    v, u = np.mgrid[:9, :9]
    template = scipy.ndimage.map_coordinates(source, [v + down, u + right], order=1)
    window = window + 3 * template[:8, :8]
    sums = sum_patches(*(jnp.asarray(x)[..., None] for x in (source, np.array([right, down]), window)))
    step, gain = regress(sums, jnp.zeros((2, 1)), jnp.array([0.0, 99.0]))
    inner = template[1:-1, 1:-1]
    slopes = (template[1:-1, 2:] - template[1:-1, :-2]) / 2, (template[2:, 1:-1] - template[:-2, 1:-1]) / 2
    design = np.stack([*(x.ravel() for x in (*slopes, inner)), np.ones(49)], axis=1)
    want = np.linalg.lstsq(design, window[:7, :7].ravel(), rcond=None)[0]
    np.testing.assert_allclose(gain[0], want[2], rtol=1e-9)
    np.testing.assert_allclose(step[:, 0], want[:2] / want[2], rtol=1e-9)


@pytest.mark.slow
def test_degenerate_points_are_flagged_and_finite(rng):
    (previous, current, uv), truth = case(rng)
    previous = previous.at[:60, :60].set(90.0)
    current = current.at[100, 140].set(jnp.nan)
    bad = jnp.array([[20.0, 20.0], [-4.0, 60.0], [jnp.nan, 3.0], [500.0, jnp.inf], [135.0, 104.0]])
    uv = uv.at[:5].set(bad)
    found = track(previous, current, uv)
    assert not bool(found.ok[:5].any())
    assert all(bool(jnp.isfinite(x).all()) for x in jax.tree.leaves(found) if x is not found.points)
    far = (truth[5:] > 62).any(axis=1) & (np.abs(truth[5:] - [140, 100]).max(axis=1) > 24)
    assert (errors(found, np.concatenate([truth[:5], truth[5:]]))[5:] < 0.3)[far].mean() > 0.9
    assert bool(jnp.isfinite(found.points).all())

    def value(previous, current, uv):
        found = track(previous, current, uv, options=SMALL)
        return sum(x.sum() for x in jax.tree.leaves(found) if x.dtype != bool)

    for gradient in jax.jit(jax.grad(value, argnums=(0, 1, 2)))(previous, current, uv):
        assert bool(jnp.isfinite(gradient).all())


def test_edges_of_the_image_and_of_size(rng):
    (previous, current, _), _ = case(rng)
    near = jnp.array([[4.0, 60.0], [80.0, 6.0], [150.0, 118.0]])
    found = track(previous, previous, near)
    assert bool(found.ok.all())
    np.testing.assert_allclose(found.points, near, atol=1e-3)
    small = jnp.asarray(previous[:30, :30])
    assert prepare(small).levels < 4
    with pytest.raises(ValueError, match="does not fit"):
        prepare(small[:10])
    with pytest.raises(ValueError, match="same shape"):
        track(previous, current[1:], near)
    with pytest.raises(ValueError, match="odd"):
        Klt(size=10)
    assert track(previous, current, jnp.zeros((0, 2))).points.shape == (0, 2)


@pytest.mark.slow
def test_gradients_are_those_of_the_solution(rng, x64):
    (previous, current, uv), _ = case(rng, 0.9, 5.0, 1.0, dtype=np.float64)
    weights = jnp.asarray(rng.normal(size=(N, 2)))

    def value(*inputs):
        found = track(*inputs, options=SMALL)
        return (jnp.where(found.ok[:, None], found.points, 0.0) * weights).sum()

    gradients = jax.jit(jax.grad(value, argnums=(0, 1, 2)))(previous, current, uv)
    value = jax.jit(value)
    inputs = (previous, current, uv)
    for k, gradient in enumerate(gradients):
        step = 1e-5 * jnp.asarray(rng.normal(size=gradient.shape))
        sides = [value(*(x + sign * step if i == k else x for i, x in enumerate(inputs))) for sign in (1, -1)]
        np.testing.assert_allclose((gradient * step).sum(), (sides[0] - sides[1]) / 2, rtol=2e-3)


def test_masked_chunked_and_alone_agree(rng):
    inputs, _ = case(rng)
    options = SMALL
    found = track(*inputs, valid=jnp.ones(N, dtype=bool), options=options)
    valid = jnp.arange(N) % 3 > 0
    masked = track(*inputs[:2], jnp.where(valid[:, None], inputs[2], jnp.nan), valid=valid, options=options)
    assert not bool(masked.ok[~valid].any())
    np.testing.assert_allclose(masked.points[valid], found.points[valid], atol=1e-4)
    frames = [prepare(x, options=options) for x in inputs[:2]]
    alone = jax.vmap(lambda uv: track_frames(*frames, uv[None], options=options).points[0])(inputs[2][:8])
    np.testing.assert_allclose(alone, found.points[:8], atol=1e-3)


def test_a_video_is_followed_and_traced_once(rng):
    texture = Texture()
    video = jnp.asarray(np.stack([texture.moved(1.5 * k, -0.5 * k) for k in range(4)]), jnp.float32)
    uv = jnp.asarray(np.stack([rng.uniform(20, side - 30, N) for side in SHAPE[::-1]], axis=1), jnp.float32)
    traces = []
    follow = eqx.filter_jit(lambda *x: (traces.append(1), track_sequence(*x))[1])
    followed = follow(video, uv)
    follow(video + 1.0, uv)
    assert len(traces) == 1 and followed.points.shape == (3, N, 2)
    want = np.asarray(uv) + [4.5, -1.5]
    ok = np.asarray(followed.ok[-1])
    assert ok.mean() > 0.9
    assert np.median(np.linalg.norm(np.asarray(followed.points[-1]) - want, axis=1)[ok]) < 0.05
    lost = ~np.asarray(followed.ok)
    assert not (lost[:-1] & ~lost[1:]).any()
