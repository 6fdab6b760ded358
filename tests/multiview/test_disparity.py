"""Dense stereo: known shifts, NumPy's windows, OpenCV behind the same call, and a real pair with true disparity."""

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, uniform_filter

from jaxloc.multiview.disparity import (
    SSD,
    ZNCC,
    BlockMatching,
    Census,
    DenseRefinement,
    DisparityMap,
    SemiGlobal,
    match,
    refine,
)

SHAPE, SPAN = (40, 96), 16
COSTS = [SSD(), ZNCC(), Census()]


def scene(shift, seed=0, smooth=1.5):
    """A textured wall that the right image shows further left by a shift, exactly: both come from one wave field."""
    rng = np.random.default_rng(seed)
    wide = gaussian_filter(rng.uniform(0, 255, (SHAPE[0], 4 * (SHAPE[1] + 20))), (smooth, 4 * smooth)) * 6
    wide += 128 - wide.mean()
    take = lambda start: wide[:, round(4 * start) :: 4][:, : SHAPE[1]].copy()  # noqa: E731
    return take(0.0), take(shift)


def blocks(cost, **options):
    return BlockMatching(cost, size=7, num_disparities=SPAN, **options)


@pytest.mark.parametrize("cost", COSTS, ids=lambda cost: type(cost).__name__)
def test_known_shift(dtype, cost):
    left, right = (jnp.asarray(image, dtype) for image in scene(6.25))
    found = jax.jit(lambda a, b: match(a, b, matcher=blocks(cost)))(left, right)
    valid = np.asarray(found.valid)
    assert found.disparity.dtype == dtype and valid[5:-5, 26:-8].mean() > 0.9
    assert not valid[:, :6].any() and np.all(found.disparity[~valid] == 0)
    assert np.abs(np.median(found.disparity[valid]) - 6.25) < 0.1
    assert (np.abs(found.disparity[valid] - 6.25) < 0.5).mean() > 0.98


def test_correlation_knows_no_gain_and_bias(x64):
    left, right = scene(5.0)
    plain = match(jnp.asarray(left), jnp.asarray(right), matcher=blocks(ZNCC()))
    darker = match(jnp.asarray(left), jnp.asarray(0.5 * right + 30.0), matcher=blocks(ZNCC()))
    np.testing.assert_allclose(plain.disparity, darker.disparity, atol=1e-6)


def test_costs_equal_numpy(x64):
    left, right = scene(0.5, seed=3)
    mean = lambda image: uniform_filter(image, 7, mode="nearest")  # noqa: E731
    squared = mean((left - right) ** 2)
    spread = [mean(x * x) - mean(x) ** 2 for x in (left, right)]
    correlation = (mean(left * right) - mean(left) * mean(right)) / np.sqrt(spread[0] * spread[1])
    inner = np.s_[3:-3, 3:-3]
    for cost, expected in ((SSD(), squared), (ZNCC(), 1.0 - correlation)):
        ours = cost.compare(*(cost.prepare(jnp.asarray(x), 7) for x in (left, right)), 7)
        np.testing.assert_allclose(ours[inner], expected[inner], atol=1e-7 * expected.max())


def test_census_counts_order(x64):
    left, right = (x[:9, :12] for x in scene(2.0, seed=4))
    cost = Census((1, 1))
    ours = np.asarray(cost.compare(*(cost.prepare(jnp.asarray(x), 1) for x in (left, right)), 1))

    def signature(image, i, j):
        return [image[i + a, j + b] < image[i, j] for a in (-1, 0, 1) for b in (-1, 0, 1) if (a, b) != (0, 0)]

    for i, j in ((1, 1), (4, 5), (7, 10)):
        differ = np.mean(np.not_equal(signature(left, i, j), signature(right, i, j)))
        assert ours[i, j] == pytest.approx(differ, abs=1e-6)


def test_variance_says_how_noise_moves_the_minimum(x64):
    left, right = scene(6.0)
    rng = np.random.default_rng(1)
    run = jax.jit(lambda a, b: match(a, b, matcher=blocks(SSD(), uniqueness=0.0)))
    at, ratios, errors = np.s_[8:-8:8, 30:-12:8], [], []
    for _ in range(40):
        noisy = [jnp.asarray(x + 4.0 * rng.normal(size=x.shape)) for x in (left, right)]
        found = run(*noisy)
        ratios.append(np.asarray((found.disparity - 6.0) ** 2 / found.variance)[at][np.asarray(found.valid)[at]].mean())
        errors.append(np.abs(found.disparity - 6.0)[at].max())
    # The parabola through whole pixels is not the sum of squares itself: within a factor, not within chi-square.
    assert max(errors) < 1.0 and 0.3 < np.mean(ratios) < 3.0


def test_what_only_one_picture_shows_is_not_valid():
    """A near square hides the wall beside it: left of it the check from the right finds another partner."""
    left, right = scene(3.0)
    rng = np.random.default_rng(2)
    square = gaussian_filter(rng.uniform(0, 255, (20, 24)), 1.0) * 4 % 255
    left[10:30, 50:74], right[10:30, 39:63] = square, square
    found = match(jnp.asarray(left, jnp.float32), jnp.asarray(right, jnp.float32), matcher=blocks(Census()))
    assert np.median(found.disparity[16:24, 56:70]) == pytest.approx(11.0, abs=0.1)
    unchecked = match(
        jnp.asarray(left, jnp.float32),
        jnp.asarray(right, jnp.float32),
        matcher=blocks(Census(), consistency=np.inf, uniqueness=0.0),
    )
    hidden = np.s_[14:26, 42:48]
    assert found.valid[hidden].mean() < 0.5 * unchecked.valid[hidden].mean()


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["flat", "nan", "unrelated"])
def test_bad_images(dtype, kind):
    left, right = scene(4.0)
    if kind == "flat":
        left[:], right[:] = 100.0, 100.0
    if kind == "nan":
        left[:], right[10:20] = np.nan, np.inf
    if kind == "unrelated":
        right = scene(4.0, seed=9)[1]

    @jax.jit
    def total(a, b):
        found = match(a, b, matcher=blocks(ZNCC()))
        better = refine(a, b, found)
        return jnp.sum(better.disparity), (found, better)

    pair = (jnp.asarray(left, dtype), jnp.asarray(right, dtype))
    (_, maps), slope = jax.value_and_grad(total, has_aux=True)(*pair)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((maps, slope)))
    assert maps[0].valid.mean() < (0.5 if kind == "unrelated" else 1e-9)


def test_gradients_equal_differences(x64):
    left, right = (jnp.asarray(image) for image in scene(6.25, smooth=2.0))

    @jax.jit
    def place(image):
        found = match(left, image, matcher=blocks(ZNCC()))
        return jnp.stack([found.disparity[20, 50], refine(left, image, found).disparity[20, 60]])

    slopes = jax.jacfwd(lambda t: place(right + t * change))
    for seed in (0, 1):
        change = jnp.asarray(np.random.default_rng(seed).normal(size=SHAPE))
        difference = (place(right + 1e-5 * change) - place(right - 1e-5 * change)) / 2e-5
        np.testing.assert_allclose(slopes(0.0), difference, rtol=1e-4, atol=1e-8)


def test_batch_is_a_loop():
    pairs = [scene(shift) for shift in (3.0, 7.0)]
    left, right = (jnp.asarray(np.stack(images), jnp.float32) for images in zip(*pairs, strict=True))
    run = lambda a, b: match(a, b, matcher=blocks(ZNCC()))  # noqa: E731
    together = jax.jit(jax.vmap(run))(left, right)
    for i in range(2):
        np.testing.assert_allclose(together.disparity[i], run(left[i], right[i]).disparity, atol=1e-4)


def test_semi_global_is_opencvs():
    left, right = (np.clip(image, 0, 255).astype(np.uint8) for image in scene(6.0))
    found = match(left, right, matcher=SemiGlobal(num_disparities=SPAN))
    options = {"P1": 200, "P2": 800, "disp12MaxDiff": 1, "uniquenessRatio": 10, "speckleWindowSize": 100}
    theirs = cv2.StereoSGBM_create(0, SPAN, 5, speckleRange=2, **options).compute(left, right) / 16.0
    np.testing.assert_array_equal(found.disparity, np.where(theirs > 0, theirs, 0.0))
    assert bool(found.valid[20, 50])


def test_shapes_must_agree():
    with pytest.raises(ValueError, match="one shape"):
        match(np.zeros((4, 5)), np.zeros((4, 6)))


@pytest.mark.slow
def test_a_real_pair():
    """The motorcycle of Middlebury: not worse than OpenCV's semi-global matcher, and without its steps."""
    data = pytest.importorskip("skimage.data")
    *colors, truth = data.stereo_motorcycle()
    left, right = (cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in colors)
    pair = jnp.asarray(left, jnp.float32), jnp.asarray(right, jnp.float32)
    known = np.isfinite(truth) & (truth > 0)

    def figures(found: DisparityMap):
        shown = known & np.asarray(found.valid)
        errors = np.abs(np.asarray(found.disparity) - truth)[shown]
        return shown.sum() / known.sum(), (errors > 2).mean(), np.median(errors)

    semi_global = match(left, right)
    refined = refine(*pair, semi_global, options=DenseRefinement())
    census = match(*pair, matcher=BlockMatching(size=7))
    (density, bad, median), (dense, fewer, nearer) = figures(semi_global), figures(census)
    assert dense >= density and fewer <= bad and nearer <= median
    assert figures(refined)[1] <= bad + 0.001 and figures(refined)[2] < 0.8 * median
    fractions = np.asarray(refined.disparity)[np.asarray(refined.valid)] % 0.0625
    assert np.histogram(fractions, 5, (0.0, 0.0625))[0].max() < 0.4 * len(fractions)
