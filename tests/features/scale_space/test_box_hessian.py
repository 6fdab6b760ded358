"""Box filters against explicit kernels of SciPy, scikit-image and the Gaussians they stand for."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage
from skimage.feature import hessian_matrix_det

from jaxloc.features.scale_space.box_hessian import box_hessian, filter_scale, filter_sizes, max_octaves


def kernels(size):
    """Lobes as Bay's figure shows them, painted into arrays."""
    lobe, middle = size // 3, size // 2
    uu, uv = np.zeros((size, size)), np.zeros((size, size))
    rows = slice(middle - lobe + 1, middle + lobe)
    for k, weight in enumerate((1, -2, 1)):
        uu[rows, k * lobe : (k + 1) * lobe] = weight
    before, after = slice(middle - lobe, middle), slice(middle + 1, middle + 1 + lobe)
    uv[before, before] = uv[after, after] = 1
    uv[before, after] = uv[after, before] = -1
    return uu / size**2, uv / size**2


@pytest.fixture(scope="module")
def photo():
    return ndimage.gaussian_filter(np.random.default_rng(0).uniform(0, 2000, (80, 97)), 2.0)


@pytest.mark.parametrize("octave", [0, 1])
def test_equal_plain_kernels(photo, dtype, octave):  # T-37
    found, step = box_hessian(jnp.asarray(photo, dtype), octave=octave), 2**octave
    assert found.determinant.dtype == dtype and found.step == step
    for layer, size in enumerate(filter_sizes(octave)):
        uu, uv = kernels(size)
        duu, dvv, duv = (ndimage.correlate(photo, k, mode="nearest")[::step, ::step] for k in (uu, uu.T, uv))
        for ours, theirs in (
            (found.determinant[layer], duu * dvv - (0.9 * duv) ** 2),
            (found.trace[layer], duu + dvv),
        ):
            np.testing.assert_allclose(ours, theirs, atol=2e-4 * np.abs(theirs).max())


def test_equal_scikit_image(photo, x64):
    ours = box_hessian(jnp.asarray(photo)).determinant
    for layer, size in enumerate((9, 15, 21, 27)):
        # Its squares lie one pixel to the upper left.
        theirs = np.roll(hessian_matrix_det(photo, size / 3), (1, 1), (0, 1))
        inside = (slice(20, -20), slice(20, -20))
        np.testing.assert_allclose(ours[layer][inside], theirs[inside], atol=1e-6 * np.abs(theirs).max())


def test_sizes_of_the_paper():
    sizes = [list(filter_sizes(octave)) for octave in range(4)]
    assert sizes == [[9, 15, 21, 27], [15, 27, 39, 51], [27, 51, 75, 99], [51, 99, 147, 195]]
    assert [max_octaves((n, 2 * n), 4) for n in (30, 60, 120, 250, 999)] == [1, 2, 3, 4, 4]


def test_weight_makes_up_for_the_boxes():
    """Bay's ratio of Frobenius norms, from Gaussians sampled here."""
    sigma, (v, u) = 1.2, np.mgrid[-4:5, -4:5]
    gauss = np.exp(-(u**2 + v**2) / (2 * sigma**2)) / (2 * np.pi * sigma**2)
    guu, guv = gauss * (u**2 / sigma**4 - 1 / sigma**2), gauss * u * v / sigma**4
    uu, uv = kernels(9)
    weight = np.linalg.norm(guv) * np.linalg.norm(uu) / (np.linalg.norm(guu) * np.linalg.norm(uv))
    assert weight == pytest.approx(0.9, abs=0.03)


@pytest.mark.parametrize(("layer", "least"), [(0, 0.99), (1, 0.97), (2, 0.93)])
def test_near_the_true_determinant(photo, x64, layer, least):  # T-37
    """Boxes a third of the side wide, as far apart, blur by a sixth of the side: more than the paper says."""
    size = filter_sizes(0)[layer]
    ours = np.asarray(box_hessian(jnp.asarray(photo)).determinant[layer])

    def likeness(sigma):
        uu, vv, uv = (ndimage.gaussian_filter(photo, sigma, order=order) for order in ((0, 2), (2, 0), (1, 1)))
        truth, found = (x[20:-20, 20:-20].ravel() for x in (uu * vv - uv**2, ours))
        return np.corrcoef(truth, found)[0, 1]

    assert likeness(size / 6) > least
    assert likeness(float(filter_scale(jnp.asarray([float(size)]))[0])) < likeness(size / 6)


def test_derivatives_equal_differences(photo, x64):
    image, change = jnp.asarray(photo[:50, :50]), jnp.asarray(np.random.default_rng(1).normal(size=(50, 50)))
    run = jax.jit(lambda t: box_hessian(image + t * change).determinant)
    np.testing.assert_allclose(jax.jvp(run, (0.0,), (1.0,))[1], (run(1e-4) - run(-1e-4)) / 2e-4, rtol=1e-6, atol=1e-5)
