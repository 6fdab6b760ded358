"""Mutual information against plain histograms, and alignment of images whose gray levels differ by more than gain."""

from pathlib import Path

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from jaxloc.alignment.mutual_information import MutualInformation, align, mutual_information
from jaxloc.images import Affine, Translation

ROWS, COLUMNS = 70, 80
START = np.array([24.6, 17.4])
MAPS = {
    "inverted": lambda x: 255 - x,
    "gamma": lambda x: 255 * (np.clip(x, 0, 255) / 255) ** 2.2,
    "both": lambda x: 255 - 255 * (np.clip(x, 0, 255) / 255) ** 2.2,
}
WARPS = {
    Translation: np.array([[1, 0, 21.3], [0, 1, 20.6], [0, 0, 1]]),
    Affine: np.array([[1.03, -0.02, 21.3], [0.025, 0.97, 20.6], [0, 0, 1]]),
}


def real_scene(name):
    skimage_data = pytest.importorskip("skimage.data")
    image = cv2.imread(str(Path(skimage_data.__file__).with_name(f"{name}.png")), cv2.IMREAD_GRAYSCALE)
    return cv2.GaussianBlur(image.astype(float), (0, 0), 1.0)[100:225, 120:250]


def seen(scene, matrix):
    v, u = np.mgrid[:ROWS, :COLUMNS]
    at = matrix[:2, :2] @ np.stack([u.ravel(), v.ravel()]) + matrix[:2, 2:]
    return map_coordinates(scene, at[::-1], order=5).reshape(ROWS, COLUMNS)


def corner_error(found, matrix):
    corners = np.array([[0, 0, 1], [COLUMNS - 1, 0, 1], [0, ROWS - 1, 1], [COLUMNS - 1, ROWS - 1, 1]]).T
    return np.sqrt(np.mean(np.sum(((found - matrix)[:2] @ corners) ** 2, axis=0)))


def opencv(image, template, warp):
    """What ECC and the least sum of squares make of the same start."""
    model = cv2.MOTION_TRANSLATION if warp is Translation else cv2.MOTION_AFFINE
    start = np.float32([[1, 0, START[0]], [0, 1, START[1]]])
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-6)
    try:
        found = cv2.findTransformECC(np.float32(template), np.float32(image), start, model, criteria, None, 5)[1]
        ecc = corner_error(np.vstack([found, [0, 0, 1]]), WARPS[warp])
    except cv2.error:
        ecc = np.inf
    squares = cv2.matchTemplate(np.float32(image), np.float32(template), cv2.TM_SQDIFF)
    v, u = np.unravel_index(np.argmin(squares), squares.shape)
    return ecc, np.hypot(u - WARPS[warp][0, 2], v - WARPS[warp][1, 2])


@pytest.mark.slow
@pytest.mark.parametrize("warp", WARPS)
@pytest.mark.parametrize("name", ["astronaut", "gravel"])
def test_aligns_where_squares_and_ecc_fail(rng, warp, name):  # K-22, R-36
    scene = real_scene(name)
    template = seen(scene, WARPS[warp]) + 2 * rng.normal(size=(ROWS, COLUMNS))
    for kind, changed in MAPS.items():
        image = changed(scene) + 2 * rng.normal(size=scene.shape)
        start = Translation(jnp.asarray(START, jnp.float32))
        found = align(jnp.asarray(image, jnp.float32), jnp.asarray(template, jnp.float32), warp, start)
        error = corner_error(np.asarray(found.value.matrix()), WARPS[warp])
        ecc, squares = opencv(image, template, warp)
        assert bool(found.ok), kind
        assert error < 0.1, kind
        assert ecc > 1.5 * error, kind
        if kind != "gamma":
            assert ecc > 1.0 and squares > 2.0


@pytest.mark.slow
def test_covariance_is_cautious(rng):
    start, truth = Translation(jnp.asarray(START, jnp.float32)), Affine.from_matrix(jnp.float32(WARPS[Affine]))
    many = jax.jit(jax.vmap(lambda *pair: align(*pair, Affine, start)))
    for name in ("astronaut", "gravel"):
        scene, count = real_scene(name), 10
        image = 255 - scene + 6 * rng.normal(size=(count, *scene.shape))
        template = seen(scene, WARPS[Affine]) + 6 * rng.normal(size=(count, ROWS, COLUMNS))
        found = many(jnp.asarray(image, jnp.float32), jnp.asarray(template, jnp.float32))
        error = np.asarray(jax.vmap(lambda value: (value.inverse() @ truth).log())(found.value))
        nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(np.asarray(found.covariance)), error) / truth.dof
        ok = np.asarray(found.ok)
        assert ok.mean() > 0.7 and 0.1 < nees[ok].mean() < 1.7


def test_equals_a_fine_histogram(rng):
    a = rng.integers(0, 6, (200, 200)).astype(float)
    b = (a + rng.integers(0, 2, a.shape)) % 6
    joint = np.histogram2d(a.ravel(), b.ravel(), bins=6)[0] / a.size
    outer = joint.sum(1)[:, None] * joint.sum(0)[None]
    want = np.sum(joint[joint > 0] * np.log(joint[joint > 0] / outer[joint > 0]))
    # Five bins from one gray level to the next: splines of neighbors do not touch. Each spreads over three bins of
    # itself, independently in both images, which adds no information.
    got = mutual_information(jnp.asarray(a, jnp.float32), jnp.asarray(b, jnp.float32), bins=28)
    np.testing.assert_allclose(got, want, rtol=1e-3)


def test_known_values(rng, dtype):
    a = jnp.asarray(rng.uniform(0, 255, (64, 64)), dtype)
    same, other = mutual_information(a, a), mutual_information(a, jnp.asarray(rng.uniform(0, 255, (64, 64)), dtype))
    assert same.dtype == dtype and float(same) > 1.5 > 0.3 > float(other) >= 0
    np.testing.assert_allclose(mutual_information(a, 255 - a), same, rtol=1e-3)
    np.testing.assert_allclose(mutual_information(a, jnp.zeros_like(a)), 0, atol=1e-5)


def test_symmetric_and_masked(rng):
    a, b = (jnp.asarray(rng.uniform(0, 9, (64, 64)), jnp.float32) for _ in range(2))
    np.testing.assert_allclose(mutual_information(a, b), mutual_information(b, a), rtol=1e-4)
    mask = jnp.arange(64)[:, None] < 40
    mask = jnp.broadcast_to(mask, a.shape)
    want = mutual_information(a[:40], b[:40])
    np.testing.assert_allclose(mutual_information(a, b, mask=mask), want, rtol=1e-4)
    np.testing.assert_allclose(mutual_information(a, jnp.where(mask, b, jnp.nan)), want, rtol=1e-4)


def test_gradient_of_the_measure(rng, x64):
    a, b, across = (jnp.asarray(rng.uniform(10, 240, (64, 64))) for _ in range(3))
    # Least and greatest level stay.
    a = a.at[0, :2].set(jnp.array([0.0, 255.0]))
    across = across.at[0, :2].set(0.0)
    value = lambda t: mutual_information(a + t * across, b)  # noqa: E731
    np.testing.assert_allclose(jax.grad(value)(0.0), (value(1e-5) - value(-1e-5)) / 2e-5, rtol=1e-4)


SMALL = MutualInformation(blurs=(2.0, 0.5), max_steps=60, tolerance=1e-4)


@pytest.mark.slow
def test_gradient_of_the_warp(rng, x64):
    scene = real_scene("astronaut")[:80, :90]
    image, template = (jnp.asarray(x) for x in (255 - scene, scene[12:52, 20:64]))
    bump = jnp.asarray(np.exp(-((np.mgrid[:40, :44][0] - 18) ** 2 + (np.mgrid[:40, :44][1] - 25) ** 2) / 30.0))
    start = Translation(jnp.array([20.4, 11.7]))
    place = jax.jit(lambda t: align(image, template + t * bump, Translation, start, method=SMALL).value.translation)
    want = (place(1e-2) - place(-1e-2)) / 2e-2
    np.testing.assert_allclose(jax.jacfwd(place)(0.0), want, rtol=0.02, atol=1e-5)


@pytest.mark.slow
def test_degenerate_images(rng):
    scene = real_scene("astronaut")[:80, :90].astype(np.float32)
    template = scene[12:52, 20:64].copy()
    dotted = template.copy()
    dotted[5, 6] = np.nan
    unusable = {
        "flat template": (scene, np.full_like(template, 9.0), 20.0),
        "flat image": (np.full_like(scene, 200.0), template, 20.0),
        "nan image": (np.full_like(scene, np.nan), template, 20.0),
        "nan template": (scene, np.full_like(template, np.nan), 20.0),
        "off the image": (scene, template, 500.0),
        "nan start": (scene, template, np.nan),
    }

    @jax.jit
    def both(image, template, right):
        def total(image):
            found = align(image, template, Translation, Translation(jnp.stack([right, 12.0 + 0 * right])), method=SMALL)
            return jnp.sum(found.value.translation) + found.cost, found

        return jax.value_and_grad(total, has_aux=True)(image)

    for name, (image, sought, right) in unusable.items():
        (_, found), slope = both(jnp.asarray(image), jnp.asarray(sought), jnp.asarray(right, jnp.float32))
        assert not bool(found.ok), name
        assert all(np.all(np.isfinite(leaf)) for leaf in (slope, *jax.tree.leaves(found))), name
    (_, found), _ = both(jnp.asarray(255 - scene), jnp.asarray(dotted), jnp.asarray(21.5, jnp.float32))
    assert bool(found.ok)
    np.testing.assert_allclose(found.value.translation, [20, 12], atol=0.05)


@pytest.mark.slow
def test_batch_and_bytes(rng):
    scene = real_scene("astronaut")[:80, :90]
    image, template = (jnp.asarray(np.round(x), jnp.uint8) for x in (255 - scene, scene[12:52, 20:64]))
    starts = jnp.array([[21.0, 11.0], [18.5, 13.5]])
    find = lambda start: align(image, template, Translation, Translation(start), method=SMALL).value.translation  # noqa: E731
    for start, got in zip(starts, jax.vmap(find)(starts), strict=True):
        np.testing.assert_allclose(got, find(start), atol=2e-3)
        np.testing.assert_allclose(got, [20, 12], atol=0.05)


def test_wrong_shapes_are_refused():
    image = jnp.ones((20, 20))
    for wrong in (
        lambda: mutual_information(image, image[1:]),
        lambda: mutual_information(image, image, bins=4),
        lambda: mutual_information(image, image, mask=image[1:]),
        lambda: align(image, image, Translation, mask=image[1:]),
        lambda: align(image, image, Translation, method=MutualInformation(bins=3)),
        lambda: align(image[0], image, Translation),
    ):
        with pytest.raises(ValueError):
            wrong()
