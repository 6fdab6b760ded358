"""Lucas-Kanade in all its forms [K-12, K-20...K-23, K-27, K-72]: known warps, finite differences, seeds of noise."""

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from benchmarks import baker_matthews
from scipy.ndimage import map_coordinates, spline_filter

import jaxloc as jl
from jaxloc.alignment import ecc, multi_start
from jaxloc.alignment import lucas_kanade as lk
from jaxloc.alignment.lucas_kanade.covariance import AlignmentData
from jaxloc.alignment.lucas_kanade.normal_equations import equations
from jaxloc.alignment.lucas_kanade.pyramid_level import Frame
from jaxloc.images.warps import Affine, Euclidean, Homography, Similarity, Translation
from jaxloc.solvers import Huber, Status, Tukey

SIZE, PLACE = 48, np.array([27.0, 22.0])
CORNERS = np.array([[0, 0], [SIZE - 1, 0], [SIZE - 1, SIZE - 1], [0, SIZE - 1]], float)
TANGENT = np.array([1.2, -0.9, 0.03, 0.02, -0.02, 0.015, 1e-4, -8e-5])
ALL = [lk.InverseCompositional(), lk.InverseAdditive(), lk.ForwardsCompositional(), lk.ForwardsAdditive()]


def texture(rng, shape=(96, 104), smoothness=2.5):
    """A smooth random image."""
    v, u = np.meshgrid(np.fft.fftfreq(shape[0]), np.fft.fftfreq(shape[1]), indexing="ij")
    spectrum = np.fft.fft2(rng.normal(size=shape)) * np.exp(-2 * (np.pi * smoothness) ** 2 * (u**2 + v**2))
    photo = np.fft.ifft2(spectrum).real
    return 120 + 45 * photo / photo.std()


def truth(group):
    """A known warp of a group, as a matrix."""
    with jax.enable_x64(True):
        return np.asarray(
            (group.of(Translation(jnp.asarray(PLACE))) @ group.exp(jnp.asarray(TANGENT[: group.dof]))).matrix()
        )


def cut(image, matrix):
    """The template under a warp, by splines of order five."""
    u, v = np.meshgrid(np.arange(SIZE), np.arange(SIZE))
    places = matrix @ np.stack([u.ravel(), v.ravel(), np.ones(SIZE**2)])
    right, down = places[:2] / places[2]
    coefficients = spline_filter(image, order=5, mode="mirror")
    return map_coordinates(coefficients, [down, right], order=5, mode="mirror", prefilter=False).reshape(SIZE, SIZE)


def start(dtype=jnp.float32):
    return Translation(jnp.asarray(PLACE, dtype))


def corner_error(estimate, matrix):
    """Root mean square distance of the template's corners, px."""
    found = np.asarray(estimate.value.matrix(), float)
    places = [m @ np.concatenate([CORNERS.T, np.ones((1, 4))]) for m in (found, matrix)]
    first, second = (place[:2] / place[2] for place in places)
    return float(np.sqrt(np.mean(np.sum((first - second) ** 2, axis=0))))


@pytest.fixture(scope="module")
def pair():
    image = texture(np.random.default_rng(1))
    warp = truth(Homography)
    return image, cut(image, warp), warp


@pytest.mark.slow
@pytest.mark.parametrize("group", [Translation, Euclidean, Similarity, Affine, Homography])
def test_every_group_finds_its_warp(group):
    image = texture(np.random.default_rng(2))
    warp = truth(group)
    template = cut(image, warp)
    fit = lk.align(np.float32(0.7 * image + 15), np.float32(template), group, start())
    assert bool(fit.ok) and corner_error(fit, warp) < 0.03


@pytest.mark.slow
@pytest.mark.parametrize("formulation", ALL, ids=lambda f: type(f).__name__)
def test_formulations_agree(formulation):
    image = texture(np.random.default_rng(3))
    warp = truth(Affine)
    template = cut(image, warp)
    method = lk.LucasKanade(formulation=formulation, scales=lk.FullSize())
    fit = lk.align(np.float32(image), np.float32(template), Affine, start(), method=method)
    assert bool(fit.ok) and corner_error(fit, warp) < 0.03


@pytest.mark.slow
@pytest.mark.parametrize(
    "descent, bound",
    [
        (lk.LevenbergMarquardtStep(), 0.03),
        (lk.NewtonStep(), 0.03),
        (lk.DiagonalStep(), 0.5),
        (lk.DiagonalStep(1.0), 0.5),
        (lk.SteepestDescentStep(), 0.5),
    ],
    ids=["levenberg", "newton", "diagonal", "diagonal-newton", "steepest"],
)
@pytest.mark.parametrize("formulation", [lk.InverseCompositional(), lk.ForwardsAdditive()], ids=["inverse", "forwards"])
def test_descents_reach_the_warp(descent, bound, formulation):
    if descent.newton and not formulation.inverse:
        pytest.skip("from 2 px away the image's Hessian is indefinite here: see the next test for its terms")
    image = texture(np.random.default_rng(3))
    warp = truth(Affine)
    template = cut(image, warp)
    method = lk.LucasKanade(formulation=formulation, descent=descent, scales=lk.FullSize(), max_steps=100)
    fit = lk.align(np.float32(image), np.float32(template), Affine, start(), method=method)
    assert corner_error(fit, warp) < bound


@pytest.mark.slow
@pytest.mark.parametrize("formulation", [lk.ForwardsCompositional(), lk.ForwardsAdditive()], ids=["composed", "added"])
def test_newton_has_the_exact_hessian(formulation, x64):
    """Second-order terms against the Hessian of the cost on an image that is known between its pixels."""

    def photo(u, v, wave):
        return 120 + 40 * wave(0.11 * u + 0.03 * v + 0.3) * wave(0.09 * v - 0.02 * u + 1.2) + 10 * wave(0.15 * v)

    u, v = np.meshgrid(np.arange(104.0), np.arange(96.0))
    matrix = truth(Homography)
    places = matrix @ np.stack([u[:SIZE, :SIZE].ravel(), v[:SIZE, :SIZE].ravel(), np.ones(SIZE**2)])
    template = photo(places[0] / places[2], places[1] / places[2], np.sin).reshape(SIZE, SIZE)
    image, weights = jnp.asarray(photo(u, v, np.sin)), jnp.ones((SIZE, SIZE))
    method = lk.LucasKanade(
        formulation=formulation, brightness=lk.Unchanged(), scales=lk.FullSize(), interpolation=jl.images.Bicubic()
    )
    data = AlignmentData(image, jnp.asarray(template), weights, None, Frame.of((SIZE, SIZE)), method)
    level = data.levels()[0]
    at = data.frame.normalize(Homography.from_matrix(jnp.asarray(matrix)))
    at = at.retract(jnp.array([0.1, -0.05, 0.03, 0.04, 0.02, -0.03, 0.02, 0.01]))

    def cost(delta):
        right, down = level.pixels(formulation.update(at, delta))
        return 0.5 * jnp.sum(level.weight * (photo(right, down, jnp.sin) - level.template) ** 2)

    exact = jax.hessian(cost)(jnp.zeros(8))
    scale = np.sqrt(np.abs(np.outer(np.diag(exact), np.diag(exact))))
    hessians = (equations(level, None, at, jnp.zeros(0), data.matching, second=s).hessian for s in (1.0, 0.0))
    newton, plain = (np.abs((hessian - exact) / scale).max() for hessian in hessians)
    assert newton < 0.01 and plain > 0.05


@pytest.mark.slow
def test_exposure_breaks_plain_differences_only(pair):  # K-22
    image, template, warp = pair
    dark = np.float32(0.6 * image + 30)
    gain = lk.align(dark, np.float32(template), Homography, start())
    plain = lk.align(dark, np.float32(template), Homography, start(), method=lk.LucasKanade(brightness=lk.Unchanged()))
    best = ecc.align(dark, np.float32(template), Homography, start())
    assert bool(gain.ok) and corner_error(gain, warp) < 0.03
    assert bool(best.ok) and corner_error(best, warp) < 0.03
    assert corner_error(plain, warp) > 0.3


@pytest.mark.slow
def test_outliers_lose_their_pull(pair):
    image, template, warp = pair
    hidden = np.float32(template).copy()
    hidden[10:24, 12:30] = 250
    plain = lk.align(np.float32(image), hidden, Homography, start())
    robust = lk.align(np.float32(image), hidden, Homography, start(), method=lk.LucasKanade(loss=Tukey()))
    assert bool(robust.ok) and corner_error(robust, warp) < 0.05 < corner_error(plain, warp)


@pytest.mark.slow
def test_masked_pixels_are_absent(pair):
    image, template, warp = pair
    weights = np.ones((SIZE, SIZE), np.float32)
    weights[30:, :] = 0
    wrong = np.float32(template).copy()
    wrong[30:, :] = np.nan
    other = np.where(weights > 0, np.float32(template), 77)
    # On one scale: smaller images mix what is masked with its neighbors.
    method = lk.LucasKanade(scales=lk.FullSize())
    one = lk.align(np.float32(image), wrong, Homography, start(), method=method)
    mask = np.ones((SIZE, SIZE), bool)
    mask[29:, :] = False
    two = lk.align(np.float32(image), other, Homography, start(), weights=jnp.asarray(mask), method=method)
    assert bool(one.ok) and corner_error(one, warp) < 0.05
    np.testing.assert_allclose(one.value.matrix(), two.value.matrix(), atol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("brightness", [lk.GainBias(), lk.Correlation()], ids=["gain-bias", "correlation"])
@pytest.mark.parametrize(
    "formulation", [lk.InverseCompositional(), lk.ForwardsCompositional()], ids=["inverse", "forwards"]
)
def test_gradient_equals_finite_differences(brightness, formulation, pair, x64):
    image, template, _ = pair
    image = image + np.random.default_rng(4).normal(size=image.shape) * 2
    method = lk.LucasKanade(
        formulation=formulation,
        brightness=brightness,
        scales=lk.Blurred((2.0, 0.0)),
        interpolation=jl.images.Bicubic(),
        tolerance=1e-10,
        max_steps=60,
    )

    @jax.jit
    def value(image, template):
        fit = lk.align(image, template, Affine, start(jnp.float64), method=method)
        return jnp.sum(fit.value.apply(jnp.asarray(CORNERS)) * jnp.array([[1.0, -0.5]]))

    arguments = jnp.asarray(0.8 * image), jnp.asarray(template)
    slopes = jax.jit(jax.grad(value, argnums=(0, 1)))(*arguments)
    rng = np.random.default_rng(5)
    for index in (0, 1):
        way = jnp.asarray(rng.normal(size=arguments[index].shape))
        ahead, behind = (
            value(*[a + sign * 1e-4 * way if i == index else a for i, a in enumerate(arguments)]) for sign in (1, -1)
        )
        expected = (ahead - behind) / 2e-4
        assert abs(float(jnp.sum(slopes[index] * way)) - expected) <= 1e-4 * max(1.0, abs(expected))


@pytest.mark.slow
@pytest.mark.parametrize("clean", [False, True], ids=["two noisy images", "clean template"])
def test_covariance_is_consistent(clean, pair):
    """NEES over 200 seeds of noise inside the 95 % band of its mean."""
    image, affine = pair[0], truth(Affine)
    template, rng = cut(image, affine), np.random.default_rng(6)
    method = lk.LucasKanade(
        scales=lk.FullSize(), template_noise=0.0 if clean else 1.0, interpolation=jl.images.Bicubic(), tolerance=1e-3
    )
    images = jnp.asarray(0.8 * image + 10 + 4 * rng.normal(size=(200, *image.shape)), jnp.float32)
    templates = jnp.asarray(template + (0 if clean else 5) * rng.normal(size=(200, SIZE, SIZE)), jnp.float32)
    known = jnp.asarray(affine, jnp.float32)

    def nees(photos):
        fit = lk.align(photos[0], photos[1], Affine, start(), method=method)
        return fit.gaussian().mahalanobis_squared(Affine.from_matrix(known)), fit.ok

    values, ok = jax.lax.map(jax.jit(nees), (images, templates), batch_size=20)
    assert bool(jnp.all(ok))
    # 95 % of means of 200 chi-square numbers of 6 degrees lie within 6 +- 0.48.
    assert 5.5 < float(jnp.mean(values)) < 6.5


@pytest.mark.slow
def test_multi_start_converges_from_far(pair):  # K-24
    image, template, warp = pair
    grid = multi_start.translations_around(
        jnp.asarray(PLACE + np.array([9.0, -7.0]), jnp.float32), spacing=6.0, count=5
    )
    fit = multi_start.align(np.float32(image), np.float32(template), Homography, grid)
    assert bool(fit.ok) and corner_error(fit, warp) < 0.03
    alone = lk.align(
        np.float32(image), np.float32(template), Homography, Translation(jnp.asarray(PLACE + 12.0, jnp.float32))
    )
    # A single initial value 12 px away does not converge, and says so.
    assert not bool(alone.ok) and corner_error(alone, warp) > 1


@pytest.mark.slow
def test_batched_and_jitted_like_single(pair):
    image, template, _ = pair
    image, template = jnp.asarray(image, jnp.float32), jnp.asarray(template, jnp.float32)
    starts = jnp.asarray(PLACE + np.array([[0.0, 0.0], [1.0, 1.0]]), jnp.float32)

    def run(place):
        return lk.align(image, template, Homography, Translation(place))

    batch = jax.vmap(run)(starts)
    for i in range(2):
        np.testing.assert_allclose(batch.value.homogeneous[i], run(starts[i]).value.homogeneous, atol=2e-4)
    inside = jax.jit(run)(starts[0])
    np.testing.assert_allclose(inside.value.homogeneous, run(starts[0]).value.homogeneous, atol=2e-4)


def bad(kind, image, template):
    image, template = image.copy(), template.copy()
    initial = PLACE
    if kind == "flat":
        template[:] = 100
    elif kind == "edge":
        template[:] = np.where(np.arange(SIZE) > SIZE / 2, 200, 50)[None]
        image[:] = np.where(np.arange(image.shape[1]) > PLACE[0] + SIZE / 2, 200, 50)[None]
    elif kind == "outside":
        initial = np.array([500.0, 500.0])
    elif kind == "nan":
        image[:] = np.nan
    elif kind == "start":
        initial = np.array([np.nan, 0.0])
    elif kind == "noise":
        template[:] = np.random.default_rng(0).uniform(0, 255, template.shape)
    return image, template, initial


@jax.jit
def differentiated(image, template, place, loss):
    """An estimate, and derivatives by both images."""

    def value(image, template):
        method = lk.LucasKanade(loss=loss, scales=lk.Pyramid(2))
        fit = lk.align(image, template, Affine, Translation(place), method=method)
        return jnp.sum(fit.value.matrix()), fit

    (_, fit), slopes = jax.value_and_grad(value, argnums=(0, 1), has_aux=True)(image, template)
    return fit, slopes


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["flat", "edge", "outside", "nan", "start", "noise"])
@pytest.mark.parametrize("loss", [jl.solvers.Quadratic(), Huber(1.345)], ids=["plain", "robust"])
def test_non_finite_values_are_flagged(kind, loss, pair):
    image, template, place = (jnp.asarray(x, jnp.float32) for x in bad(kind, np.float32(pair[0]), np.float32(pair[1])))
    fit, slopes = differentiated(image, template, place, loss)
    assert not bool(fit.ok)
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves((fit, slopes)))
    if kind in ("flat", "edge"):
        assert int(fit.status) == int(Status.RANK_DEFICIENT)


@pytest.mark.slow
def test_single_bad_pixels_do_no_harm():
    matrix = truth(Affine)
    image = texture(np.random.default_rng(7))
    template = cut(image, matrix)
    image[40, 50], template[11, 12] = np.nan, np.inf
    photos = jnp.asarray(image, jnp.float32), jnp.asarray(template, jnp.float32)
    fit, slopes = differentiated(*photos, jnp.asarray(PLACE, jnp.float32), jl.solvers.Quadratic())
    assert bool(fit.ok) and corner_error(fit, matrix) < 0.05
    assert all(np.all(np.isfinite(slope)) for slope in slopes)


@pytest.mark.slow
def test_pictures_of_any_numbers_and_sizes(pair):
    image, template, warp = pair
    mixed = lk.align(np.uint8(np.clip(image, 0, 255)), np.float32(template), Homography, start())
    assert bool(mixed.ok) and corner_error(mixed, warp) < 0.05
    bytes_ = lk.align(np.uint8(np.clip(image, 0, 255)), np.uint8(np.clip(template, 0, 255)), Homography, start())
    assert bool(bytes_.ok) and bytes_.value.matrix().dtype == jnp.float32
    larger = lk.align(np.float32(template), np.float32(image), Homography, start().inverse())
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(larger))
    with pytest.raises(ValueError, match="weights"):
        lk.align(np.float32(image), np.float32(template), Affine, start(), weights=jnp.ones((3, 3)))
    with pytest.raises(ValueError, match="InverseCompositional"):
        method = lk.LucasKanade(formulation=lk.InverseAdditive())
        lk.align(np.float32(image), np.float32(template), Homography, start(), method=method)


def test_new_numbers_do_not_compile_anew(pair):
    image, template, _ = pair
    traces = []

    @jax.jit
    def run(image):
        traces.append(1)
        return lk.align(image, np.float32(template), Translation, start()).value.translation

    run(jnp.asarray(image, jnp.float32))
    run(jnp.asarray(image + 1, jnp.float32))
    assert len(traces) == 1


@pytest.mark.slow
@pytest.mark.recordings
def test_baker_and_matthews_table():  # section C.1 of the inventory; all sigmas and 1000 runs are in the benchmark
    scene, offsets = baker_matthews.recorded("takeo"), baker_matthews.offsets(200, 3)
    share = 100 * np.mean(baker_matthews.errors(scene, offsets, baker_matthews.steps(14), 5.0) <= 1)
    assert abs(share - 90.8) < 5  # two standard deviations of 200 runs


@pytest.mark.slow
def test_ecc_equals_opencv(pair):
    image, template, _ = pair
    matrix = np.array([[1, 0, PLACE[0]], [0, 1, PLACE[1]]], np.float32)
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 200, 1e-9)
    _, expected = cv2.findTransformECC(
        np.float32(template), np.float32(image), matrix, cv2.MOTION_AFFINE, criteria, None, 1
    )
    method = lk.LucasKanade(formulation=lk.ForwardsCompositional(), scales=lk.FullSize())
    fit = ecc.align(np.float32(image), np.float32(template), Affine, start(), method=method)
    ours, theirs = fit.value.apply(jnp.asarray(CORNERS, jnp.float32)), CORNERS @ expected[:, :2].T + expected[:, 2]
    np.testing.assert_allclose(ours, theirs, atol=0.06)
