"""Template search against NumPy loops and OpenCV, on textures that were shifted exactly."""

import cv2
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.alignment.correlation import (
    ColoredNoise,
    Direct,
    Fourier,
    NormalizedCorrelation,
    SumOfSquares,
    WhiteNoise,
    Window,
    ZeroMeanCorrelation,
    classify,
    find_peaks,
    fit_parabola,
    respond,
    score_map,
    search,
    threshold,
)
from jaxloc.images import Translation

SCORES = [SumOfSquares(), NormalizedCorrelation(), ZeroMeanCorrelation()]
METHODS = {
    SumOfSquares: cv2.TM_SQDIFF,
    NormalizedCorrelation: cv2.TM_CCORR_NORMED,
    ZeroMeanCorrelation: cv2.TM_CCOEFF_NORMED,
}
SHAPE, SIZE, CORNER = (44, 52), (17, 15), (19, 13)
TRUTH = np.array([19.3, 12.6])


def texture(rng, shape=SHAPE, sigma=1.6):
    fu, fv = np.meshgrid(np.fft.fftfreq(shape[1]), np.fft.fftfreq(shape[0]))
    blur = np.exp(-2 * (np.pi * sigma) ** 2 * (fu**2 + fv**2))
    image = np.fft.ifft2(np.fft.fft2(rng.normal(size=shape)) * blur).real
    return 120 + 35 * image / image.std()


def moved(image, right, down):
    fu, fv = np.meshgrid(np.fft.fftfreq(image.shape[1]), np.fft.fftfreq(image.shape[0]))
    return np.fft.ifft2(np.fft.fft2(image) * np.exp(-2j * np.pi * (fu * right + fv * down))).real


def cut(image):
    (u, v), (rows, columns) = CORNER, SIZE
    return image[v : v + rows, u : u + columns]


def case(rng, dtype=np.float32, gain=1.0, bias=0.0):
    """An image, and a template that lies at TRUTH."""
    scene = texture(rng)
    image = gain * moved(scene, *(TRUTH - CORNER)) + bias
    return jnp.asarray(image, dtype), jnp.asarray(cut(scene), dtype)


def brute_force(score, image, template, mask):
    rows, columns = (m - n + 1 for m, n in zip(image.shape, template.shape, strict=True))
    surface = np.zeros((rows, columns))
    for v in range(rows):
        for u in range(columns):
            patch = image[v : v + template.shape[0], u : u + template.shape[1]][mask]
            sought = template[mask]
            if isinstance(score, ZeroMeanCorrelation):
                patch, sought = patch - patch.mean(), sought - sought.mean()
            if isinstance(score, SumOfSquares):
                surface[v, u] = np.sum((patch - sought) ** 2)
            else:
                surface[v, u] = patch @ sought / np.sqrt(patch @ patch * (sought @ sought))
    return surface


@pytest.mark.parametrize("score", SCORES)
@pytest.mark.parametrize("by", [Direct(), Fourier()])
@pytest.mark.parametrize("masked", [False, True])
def test_surface_equals_brute_force(rng, score, by, masked):  # K-24
    image, template = texture(rng), cut(texture(rng))
    mask = rng.random(SIZE) < 0.7 if masked else np.ones(SIZE, bool)
    arrays = [jnp.asarray(x, jnp.float32) for x in (image, template)]
    got = score_map(*arrays, score=score, by=by, mask=jnp.asarray(mask) if masked else None)
    want = brute_force(score, image, template, mask)
    np.testing.assert_allclose(got, want, atol=2e-5 * np.abs(want).max())
    if not masked:
        peer = cv2.matchTemplate(*[np.float32(x) for x in (image, template)], METHODS[type(score)])
        np.testing.assert_allclose(got, peer, atol=1e-4 * np.abs(want).max())


def test_local_variance_survives_bright_images(rng):
    """A faint texture on a bright ground, beside a dark half: running sums in float32 would lose it."""
    image = np.concatenate([np.zeros((44, 20)), 60_000 + rng.normal(size=(44, 32))], axis=1).astype(np.float32)
    template = image[10:27, 30:45]
    bright = image[:, 20:].astype(float)
    want = brute_force(ZeroMeanCorrelation(), bright, template.astype(float), np.ones(SIZE, bool))
    got = score_map(jnp.asarray(image), jnp.asarray(template), by=Direct())
    np.testing.assert_allclose(got[:, 20:], want, atol=0.02)
    assert float(got[10, 30]) > 0.99


@pytest.mark.slow
@pytest.mark.parametrize("score", SCORES)
def test_search_finds_the_place(rng, dtype, score):  # K-23, K-26
    gain, bias = {SumOfSquares: (1.0, 0.0), NormalizedCorrelation: (0.7, 0.0), ZeroMeanCorrelation: (0.6, 30.0)}[
        type(score)
    ]
    found = search(*case(rng, dtype, gain, bias), score=score)
    assert bool(found.ok) and found.covariance.dtype == found.value.translation.dtype == dtype
    np.testing.assert_allclose(found.value.translation, TRUTH, atol=0.02)


def test_parabola_is_within_a_tenth(rng):  # K-26
    for right, down in rng.uniform(-0.5, 0.5, (6, 2)):
        scene = texture(rng, sigma=2.5)
        image, template = moved(scene, right, down), cut(scene)
        peaks = find_peaks(score_map(*[jnp.asarray(x, jnp.float32) for x in (image, template)]), count=1)
        np.testing.assert_allclose(peaks.uv[0], np.array(CORNER) + [right, down], atol=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("score", SCORES)
def test_covariance_is_calibrated(rng, score):
    image, template = case(rng, gain=0.8 if not isinstance(score, SumOfSquares) else 1.0)
    noisy = image[None] + 8 * rng.normal(size=(300, *SHAPE)).astype(np.float32)
    found = jax.vmap(lambda one: search(one, template, score=score))(noisy)
    ok = np.asarray(found.ok)
    assert ok.mean() > 0.95
    error = np.asarray(found.value.translation, float) - TRUTH
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(np.asarray(found.covariance, float)), error)[ok].mean()
    assert 1.5 < nees < 2.5
    assert np.abs(error[ok].mean(axis=0)).max() < 0.03


def test_window_and_whole_image_agree(rng):
    image, template = case(rng)
    whole = search(image, template)
    window = Window.around(Translation(jnp.array([17.6, 14.4])), SIZE, reach=4)
    near = search(image, template, window)
    np.testing.assert_allclose(near.value.translation, whole.value.translation, atol=1e-3)
    astray = search(image, template, Window(jnp.array([0.0, 0.0]), (24, 22)))
    assert not bool(astray.ok) and np.all(np.isfinite(astray.value.translation))


def test_bytes_are_taken(rng):
    image, template = (jnp.clip(jnp.round(x), 0, 255).astype(jnp.uint8) for x in case(rng))
    np.testing.assert_allclose(search(image, template).value.translation, TRUTH, atol=0.05)


def test_ambiguous_places_are_flagged(rng):  # K-26
    tile = texture(rng, (26, 26))
    image = jnp.asarray(np.tile(tile, (2, 2)), jnp.float32)
    found = search(image, image[3:20, 4:19])
    peaks = find_peaks(score_map(image, image[3:20, 4:19]), count=5, separation=4)
    assert not bool(found.ok) and float(peaks.ratio) > 0.99
    assert {tuple(uv) for uv in np.asarray(peaks.uv[:4]).round().tolist()} == {(4, 3), (30, 3), (4, 29), (30, 29)}


def test_peaks_of_bumps():
    v, u = np.mgrid[:30, :40]
    bump = lambda x, y, h: h * np.exp(-((u - x) ** 2 + (v - y) ** 2) / 8)  # noqa: E731
    surface = jnp.asarray(bump(8.3, 9.8, 2) + bump(30.6, 20.2, 1), jnp.float32)
    peaks = find_peaks(surface, count=3, separation=4)
    np.testing.assert_allclose(peaks.uv[:2], [[8.3, 9.8], [30.6, 20.2]], atol=0.05)
    np.testing.assert_allclose(peaks.ratio, 0.5, atol=0.02)
    assert peaks.sharp.tolist()[:2] == [True, True]


def test_flat_surfaces_have_no_sharp_peak():
    peaks = find_peaks(jnp.full((8, 9), 3.0), count=2)
    assert not bool(jnp.any(peaks.sharp)) and np.all(np.isfinite(peaks.uv))
    assert not bool(fit_parabola(jnp.full((3, 3), jnp.nan)).sharp)
    assert not bool(jnp.any(find_peaks(jnp.full((8, 9), jnp.nan), count=2).valid))


@pytest.mark.slow
@pytest.mark.parametrize("score", SCORES)
def test_derivatives(rng, x64, score):
    image, template = case(rng, np.float64)
    across = [jnp.asarray(rng.normal(size=x.shape)) for x in (image, template)]

    def place(t):
        return search(image + t * across[0], template + t * across[1], score=score).value.translation

    got = jax.jacfwd(place)(0.0)
    want = (place(1e-3) - place(-1e-3)) / 2e-3
    np.testing.assert_allclose(got, want, rtol=2e-3, atol=1e-6)


def broken(rng):
    image, template = (np.asarray(x) for x in case(rng))
    dotted = image.copy()
    dotted[20, 25] = np.nan
    return {
        "flat template": (image, np.full_like(template, 90.0)),
        "flat image": (np.full_like(image, 200.0), template),
        "nan pixel": (dotted, template),
        "nan image": (np.full_like(image, np.nan), template),
        "nan template": (image, np.full_like(template, np.nan)),
        "edge": (image, np.broadcast_to(np.arange(SIZE[1], dtype=np.float32), SIZE)),
    }


@pytest.mark.slow
@pytest.mark.parametrize("score", SCORES)
def test_degenerate_images(rng, score):
    gradient = eqx.filter_jit(
        jax.value_and_grad(lambda image, template: _sum(search(image, template, score=score)), (0, 1), has_aux=True)
    )
    for name, (image, template) in broken(rng).items():
        (total, found), slopes = gradient(jnp.asarray(image), jnp.asarray(template))
        assert not bool(found.ok), name
        for leaf in (total, *jax.tree.leaves(found), *slopes):
            assert np.all(np.isfinite(leaf)), name


def _sum(found):
    return jnp.sum(found.value.translation) + found.cost, found


def test_compiled_and_batched_agree(rng):
    image, template = case(rng)
    images = jnp.stack([image, jnp.roll(image, 2, 1)])
    batch = jax.vmap(lambda one: search(one, template).value.translation)(images)
    for one, got in zip(images, batch, strict=True):
        np.testing.assert_allclose(got, search(one, template).value.translation, atol=1e-4)


@pytest.mark.parametrize(
    "wrong",
    [
        lambda image, template: score_map(template, image),
        lambda image, template: search(template, image),
        lambda image, template: search(image, template, Window(jnp.zeros(2), (99, 99))),
        lambda image, template: search(image, template, Window(jnp.zeros(2), (9, 9))),
        lambda image, template: score_map(image, template, mask=jnp.ones((2, 2))),
        lambda image, template: find_peaks(image, count=0),
        lambda image, template: classify(image, template[None], score=SumOfSquares()),
        lambda image, template: respond(template, image, noise=WhiteNoise(1.0)),
        lambda image, template: respond(image, template, noise=ColoredNoise(jnp.ones((3, 3)))),
    ],
)
def test_wrong_shapes_are_refused(rng, wrong):
    with pytest.raises(ValueError):
        wrong(*case(rng))


def test_confusion_of_a_bank(rng):  # K-75
    bank = np.stack([cut(texture(rng)) for _ in range(4)])
    images = np.stack([60 + 10 * rng.normal(size=SHAPE) for _ in range(4)])
    images[:, 13:30, 19:34] = 0.5 * bank + 6 * rng.normal(size=bank.shape)
    seen = jax.vmap(lambda image: classify(image, jnp.asarray(bank, jnp.float32)))(jnp.asarray(images, jnp.float32))
    assert seen.label.tolist() == [0, 1, 2, 3] and bool(jnp.all(seen.ok))
    np.testing.assert_allclose(seen.translation.translation, np.tile([19, 13], (4, 1)), atol=0.3)


def test_matched_filter_has_the_best_ratio(rng):  # K-25
    pattern, sigma = rng.normal(size=SIZE), 3.0
    noise = sigma * rng.normal(size=(400, *SIZE))
    seen = respond(jnp.asarray(pattern, jnp.float32), jnp.asarray(pattern, jnp.float32), noise=WhiteNoise(sigma))
    np.testing.assert_allclose(seen.gain, np.sum(pattern**2) / sigma**2, rtol=1e-4)
    np.testing.assert_allclose(seen.statistic[0, 0], np.sqrt(seen.gain), rtol=1e-4)
    blurred = cv2.GaussianBlur(pattern, (0, 0), 1.0)
    for other in (blurred, np.sign(pattern), np.ones(SIZE), *rng.normal(size=(20, *SIZE))):
        assert np.sum(other * pattern) ** 2 / (sigma**2 * np.sum(other**2)) < float(seen.gain)
    response = lambda x: respond(x, jnp.asarray(pattern, jnp.float32), noise=WhiteNoise(sigma)).statistic[0, 0]  # noqa: E731
    assert abs(np.std(jax.vmap(response)(jnp.asarray(noise, jnp.float32))) - 1) < 0.12


def test_colored_noise_is_whitened(rng):  # K-25
    fu, fv = np.meshgrid(np.fft.fftfreq(SHAPE[1]), np.fft.fftfreq(SHAPE[0]))
    spectrum = 0.2 + 40 * np.exp(-(fu**2 + fv**2) / 0.01)
    pattern = jnp.asarray(rng.normal(size=SIZE), jnp.float32)
    noise = np.fft.ifft2(np.fft.fft2(rng.normal(size=(100, *SHAPE))) * np.sqrt(spectrum)).real
    padded = jnp.zeros(SHAPE).at[: SIZE[0], : SIZE[1]].set(pattern)

    def ratio(model):
        filtered = lambda x: respond(x, pattern, noise=model).statistic  # noqa: E731
        return float(filtered(padded)[0, 0]) / np.std(jax.vmap(filtered)(jnp.asarray(noise, jnp.float32)))

    colored = ColoredNoise(jnp.asarray(spectrum, jnp.float32))
    want = np.sqrt(respond(padded, pattern, noise=colored).gain)
    np.testing.assert_allclose(ratio(colored), want, rtol=0.05)
    assert ratio(colored) > 1.5 * ratio(WhiteNoise(1.0))


def test_threshold_keeps_the_false_alarm_rate(rng):  # K-25
    pattern = jnp.asarray(rng.normal(size=SIZE), jnp.float32)
    images = jnp.asarray(rng.normal(size=(200, *SHAPE)), jnp.float32)
    found = jax.vmap(lambda x: respond(x, pattern, noise=WhiteNoise(1.0)).statistic)(images)
    level = threshold(0.5, places=found[0].size)
    assert abs(float(jnp.mean(jnp.sum(found > level, axis=(1, 2)))) - 0.5) < 0.2
