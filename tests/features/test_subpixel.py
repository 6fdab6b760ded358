"""Subpixel refinement on textures that were shifted exactly, and on a real stereo pair."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import chi2

from jaxloc.features import subpixel
from jaxloc.features.match import match, row_gate
from jaxloc.features.opencv import ORB, ShiTomasi, describe, detect
from jaxloc.features.subpixel import PatchRefinement, refine_stereo, refine_translation
from jaxloc.images.interpolation import Bicubic

SHAPE, N = (120, 160), 150
# Gradients of few pixels and steps compile in a third of the time.
SMALL = PatchRefinement(size=7, reach=1, num_steps=2)
METHODS = [PatchRefinement(), PatchRefinement(method=Bicubic())]


class Texture:
    """A periodic 1/f texture that moves by any fraction of a pixel (Fourier shift theorem)."""

    def __init__(self, seed=0):
        fu, fv = np.meshgrid(np.fft.fftfreq(SHAPE[1]), np.fft.fftfreq(SHAPE[0]))
        frequency = np.hypot(fu, fv)
        shape = np.where(frequency > 0, 1 / np.maximum(frequency, 1e-3), 0) * np.exp(-((frequency / 0.25) ** 2))
        self.spectrum = np.fft.fft2(np.random.default_rng(seed).normal(size=SHAPE)) * shape
        self.fu, self.fv = fu, fv
        self.scale = 40 / np.fft.ifft2(self.spectrum).real.std()

    def moved(self, right, down):
        phase = np.exp(-2j * np.pi * (self.fu * right + self.fv * down))
        return 120 + self.scale * np.fft.ifft2(self.spectrum * phase).real


def points(rng, margin=16):
    return np.stack([rng.uniform(margin, side - margin, N) for side in SHAPE[::-1]], axis=1)


def stereo_case(rng, noise=0.0, dtype=np.float32, seed=0, deviation=0.7):
    texture, uv = Texture(seed), points(rng)
    left = texture.moved(0, 0) + noise * rng.normal(size=SHAPE)
    right = 0.8 * texture.moved(-4.37, 0) + 15 + noise * rng.normal(size=SHAPE)
    truth = uv - [4.37, 0]
    initial = truth + deviation * rng.normal(size=(N, 2)).clip(-2.5, 2.5)
    return [jnp.asarray(x, dtype) for x in (left, right, uv, initial)], truth


def motion_case(rng, noise=0.0, dtype=np.float32, seed=0):
    texture, uv = Texture(seed), points(rng)
    previous = texture.moved(0, 0) + noise * rng.normal(size=SHAPE)
    current = 1.2 * texture.moved(2.3, -1.6) - 10 + noise * rng.normal(size=SHAPE)
    truth = uv + [2.3, -1.6]
    initial = truth + 0.7 * rng.normal(size=(N, 2)).clip(-2.5, 2.5)
    return [jnp.asarray(x, dtype) for x in (previous, current, uv, initial)], truth


@pytest.mark.parametrize("options", METHODS)
def test_stereo_finds_the_column(rng, dtype, options):  # T-10
    case, truth = stereo_case(rng, dtype=dtype)
    got = refine_stereo(*case, options=options)
    assert got.uv.dtype == got.variance.dtype == dtype
    ok = np.asarray(got.ok)
    assert ok.mean() > 0.98
    error = (np.asarray(got.uv) - truth)[ok]
    assert np.abs(error[:, 0]).max() < 0.06 and np.sqrt(np.mean(error[:, 0] ** 2)) < 0.025
    np.testing.assert_allclose(error[:, 1], 0, atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("options", METHODS)
def test_translation_finds_the_point(rng, dtype, options):
    case, truth = motion_case(rng, dtype=dtype)
    got = refine_translation(*case, options=options)
    assert got.covariance.dtype == dtype
    ok = np.asarray(got.ok)
    assert ok.mean() > 0.98
    error = (np.asarray(got.uv) - truth)[ok]
    assert np.abs(error).max() < 0.08 and np.sqrt(np.mean(error**2)) < 0.025


@pytest.mark.parametrize("noise", [2.0, 6.0])
def test_covariances_are_calibrated(rng, noise):
    columns, both = [], []
    for seed in range(4):
        case, truth = stereo_case(rng, noise, seed=seed)
        got = refine_stereo(*case)
        ok, error = np.asarray(got.ok), np.asarray(got.uv) - truth
        columns += list((error[:, 0] ** 2 / np.asarray(got.variance))[ok])
        case, truth = motion_case(rng, noise, seed=seed)
        got = refine_translation(*case)
        ok, error = np.asarray(got.ok), np.asarray(got.uv) - truth
        both += list(np.einsum("ni,nij,nj->n", error, np.linalg.inv(got.covariance), error)[ok] / 2)
    assert len(columns) > 580 and len(both) > 580
    # Never smaller than the scatter, and at most 40 % larger.
    assert 0.6 < np.mean(columns) < chi2.ppf(0.995, len(columns)) / len(columns)
    assert 0.6 < np.mean(both) < chi2.ppf(0.995, 2 * len(both)) / (2 * len(both))


def test_residual_is_the_noise(rng):
    case, _ = stereo_case(rng, noise=3.0)
    at_pixels = [*case[:2], jnp.round(case[2]), jnp.round(case[2]) - jnp.array([[4.0, 0.0]])]
    got = refine_stereo(*at_pixels)
    # The template lies on pixels, the match 0.37 px beside them: noise 3 * 0.8 and 3 * sqrt(.37^2 + .63^2).
    want = 3 * np.sqrt(0.8**2 + 0.37**2 + 0.63**2)
    np.testing.assert_allclose(np.median(np.asarray(got.residual)[np.asarray(got.ok)]), want, rtol=0.1)


@pytest.mark.parametrize("refine", [refine_stereo, refine_translation])
def test_degenerate_patches_are_flagged_and_finite(rng, refine):
    (first, second, uv, initial), _ = motion_case(rng)
    first = first.at[:40].set(90.0)
    uv = uv.at[:4].set(jnp.array([[60.0, 20.0], [2.0, 60.0], [jnp.nan, 3.0], [60.0, 60.0]]))
    initial = initial.at[:4].set(jnp.array([[60.0, 20.0], [4.0, 60.0], [9.0, 9.0], [500.0, jnp.inf]]))
    got = refine(first, second, uv, initial)
    assert not bool(got.ok[:4].any())
    assert all(bool(jnp.isfinite(x).all()) for x in jax.tree.leaves(got))

    def value(first, second, uv):
        found = refine(first, second, uv, initial, options=SMALL)
        return sum(x.sum() for x in jax.tree.leaves(found) if x.dtype != bool)

    for gradient in jax.grad(value, argnums=(0, 1, 2))(first, second, uv):
        assert bool(jnp.isfinite(gradient).all())


def test_identical_images_have_finite_gradients(rng):
    (image, _, uv, _), _ = motion_case(rng)
    gradient = jax.grad(lambda x: refine_translation(x, image, uv, uv, options=SMALL).residual.sum())(image)
    assert bool(jnp.isfinite(gradient).all())


def test_edges_have_no_position_along_them():
    stripes = jnp.asarray(np.broadcast_to(100 + 50 * np.sin(0.7 * np.arange(120.0)), (120, 120)), jnp.float32)
    uv = jnp.array([[30.0, 30.0]])
    assert not bool(refine_translation(stripes, stripes, uv, uv).ok[0])
    assert bool(refine_stereo(stripes, stripes, uv, uv).ok[0])
    assert not bool(refine_stereo(stripes.T, stripes.T, uv, uv).ok[0])


def test_wrong_initial_values_are_not_ok(rng):
    case, truth = stereo_case(rng)
    wrong = jnp.asarray(truth[rng.permutation(N)], jnp.float32)
    got = refine_stereo(*case[:3], wrong)
    assert float(got.ok.mean()) < 0.1


def test_gradient_moves_with_the_initial_and_the_scene(rng, x64):
    case, _ = stereo_case(rng, noise=1.0, dtype=np.float64)
    options = PatchRefinement(size=7, reach=2, num_steps=6, method=Bicubic())
    got = refine_stereo(*case, options=options)
    weights = jnp.where(got.ok, 1.0, 0.0)

    def value(right):
        return (refine_stereo(case[0], right, *case[2:], options=options).uv[:, 0] * weights).sum()

    step = 1e-4 * rng.normal(size=SHAPE)
    slope = (value(case[1] + step) - value(case[1] - step)) / 2
    np.testing.assert_allclose((jax.grad(value)(case[1]) * step).sum(), slope, rtol=1e-3)


def test_jit_vmap_and_masked_agree(rng):
    case, _ = stereo_case(rng)
    got = refine_stereo(*case)
    one_by_one = jax.vmap(lambda a, b: refine_stereo(*case[:2], a[None], b[None]).uv[0])(*case[2:])
    np.testing.assert_allclose(one_by_one, got.uv, atol=1e-3)
    bad = case[2].at[::2].set(jnp.nan)
    np.testing.assert_allclose(refine_stereo(*case[:2], bad, case[3]).uv[1::2], got.uv[1::2], atol=1e-4)


def test_new_images_do_not_retrace(rng, monkeypatch):
    case, _ = stereo_case(rng)
    traces, original = [], subpixel._refine_stereo.__wrapped__
    counted = eqx.filter_jit(lambda *args: (traces.append(1), original(*args))[1])
    monkeypatch.setattr(subpixel, "_refine_stereo", counted)
    for shift in (0.0, 1.0, 2.0):
        refine_stereo(case[0] + shift, *case[1:])
    assert len(traces) == 1


def test_a_real_stereo_pair():  # T-71 on the motorcycle of Middlebury
    data = pytest.importorskip("skimage.data")
    color = pytest.importorskip("skimage.color")
    left, right, disparity = data.stereo_motorcycle()
    left, right = ((255 * color.rgb2gray(x)).astype(np.float32) for x in (left, right))
    first, second = (detect(ShiTomasi(), x, 1500) for x in (left, right))
    gate = row_gate(first.uv, second.uv, tolerance=2.0, disparity=(0.0, 100.0))
    matches = match(describe(ORB(), left, first), describe(ORB(), right, second), gate=gate, ratio=0.9)
    got = refine_stereo(jnp.asarray(left), jnp.asarray(right), first.uv, second.uv[matches.index])
    ok = np.asarray(matches.valid & got.ok)
    column, row = np.round(np.asarray(first.uv)[ok]).astype(int).T
    truth = disparity[row, column]
    error = np.abs((np.asarray(first.uv) - np.asarray(got.uv))[ok, 0] - truth)[np.isfinite(truth) & (truth > 0)]
    assert len(error) > 500 and (error < 1).mean() > 0.9 and np.median(error) < 0.15
