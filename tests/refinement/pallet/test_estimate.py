"""From image to pallet [K-14, K-74, K-75]: rendered images with exact truth, and images that hold no pallet."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import chi2

from jaxloc.data.simulate.pallet import PalletScene, render_pallet
from jaxloc.poses import SE2
from jaxloc.refinement.pallet import (
    block_narrow,
    correlate_types,
    detect_pallet,
    euro_long,
    euro_short,
    face_template,
    find_pallet,
    hole_ratio,
    level_view,
    stack_types,
)
from jaxloc.refinement.pallet.edges import strongest_edges
from jaxloc.sensors import BrownConrady, GroundCamera, Pinhole

SHAPE, FOCAL = (240, 480), 450.0
TYPES = (euro_long(), euro_short(), block_narrow())


def camera_at(height=0.35, pitch=0.0, lens=None):
    pinhole = Pinhole(FOCAL, FOCAL, 239.5, 119.5, lens=lens)
    return GroundCamera(pinhole, height, pitch=pitch)


def photo(kind, pose, camera=None, seed=0, **scene):
    camera = camera_at() if camera is None else camera
    return jnp.asarray(
        render_pallet(kind, np.asarray(pose), camera, shape=SHAPE, scene=PalletScene(**scene), seed=seed)
    )


@eqx.filter_jit
def detect(image, camera):
    return detect_pallet(image, camera, TYPES)


def errors(found, pose):
    value = found.estimate.value
    return np.hypot(float(value.x) - pose[0], float(value.y) - pose[1]), np.degrees(abs(float(value.theta) - pose[2]))


@pytest.mark.slow
@pytest.mark.parametrize("index", range(3))
def test_pose_and_kind_at_two_meters(index):  # K-14, K-75
    rng = np.random.default_rng(index)
    for seed in range(8):
        pose = np.array([2.0, rng.uniform(-0.2, 0.2), rng.uniform(-0.35, 0.35)])
        found = detect(photo(TYPES[index], pose, seed=seed), camera_at())
        away, turned = errors(found, pose)
        assert bool(found.estimate.ok) and int(found.kind) == index
        assert away < 0.01 and turned < 0.5


@pytest.mark.slow
def test_lens_pitch_and_shading(rng):
    camera = camera_at(0.6, np.radians(12.0), BrownConrady((-0.2, 0.05, 0.0, 0.0)))
    pose = np.array([2.0, -0.1, 0.2])
    found = detect(photo(TYPES[0], pose, camera, shading=0.6, blur=1.3), camera)
    away, turned = errors(found, pose)
    assert bool(found.estimate.ok) and away < 0.01 and turned < 0.5


@pytest.mark.slow
def test_ratio_of_found_edges_is_constant_over_range():  # K-74
    ratios = []
    for x in (1.3, 2.0, 3.0, 3.8):
        found = detect(photo(TYPES[0], (x, 0.05, 0.0)), camera_at())
        ratios.append(float(hole_ratio(239.5 - found.columns)))
    np.testing.assert_allclose(ratios, float(TYPES[0].ratio()), rtol=0.01)


@pytest.mark.slow
def test_covariance_is_consistent():
    squared = []
    for seed in range(24):
        rng = np.random.default_rng(seed)
        pose = (rng.uniform(1.5, 3.5), rng.uniform(-0.2, 0.2), rng.uniform(-0.3, 0.3))
        found = detect(photo(TYPES[seed % 3], pose, seed=seed), camera_at())
        assert bool(found.estimate.ok)
        squared.append(float(found.estimate.gaussian().mahalanobis_squared(SE2(*pose))))
    low, high = chi2.ppf([0.005, 0.995], 3 * 24) / 24
    assert low < np.mean(squared) < high, np.mean(squared)


def test_confusion_of_the_bank():  # K-75
    view = eqx.filter_jit(lambda image: level_view(image, camera_at()))
    pose = SE2(2.0, 0.0, 0.1)
    rows = [np.asarray(correlate_types(view(photo(kind, (2.0, 0.0, 0.1))), stack_types(TYPES), pose)) for kind in TYPES]
    matrix = np.stack(rows)
    assert np.all(np.argmax(matrix, axis=1) == np.arange(3))
    assert np.all(np.diag(matrix) > 0.8) and np.all(matrix - np.diag(np.diag(matrix)) < 0.8)


@pytest.mark.slow
def test_wrong_kinds_and_empty_floors_are_rejected():
    only = eqx.filter_jit(lambda image, kind: find_pallet(image, camera_at(), (kind,)))
    for index, kind in enumerate(TYPES):
        image = photo(kind, (2.0, 0.1, -0.15))
        assert [bool(only(image, other).ok) for other in TYPES] == [i == index for i in range(3)]
    for image in (photo(None, np.zeros(3)), jnp.zeros(SHAPE, jnp.uint8), jnp.full(SHAPE, jnp.nan)):
        found = only(image.astype(jnp.float32), TYPES[0])
        assert not bool(found.ok) and np.all(np.isfinite(found.covariance)) and np.isfinite(found.value.x)


@pytest.mark.slow
def test_gradient_by_the_picture(x64):
    """Along a change of blur and light, in double precision; an empty image has none."""
    camera = jax.tree.map(lambda leaf: leaf.astype(jnp.float64), camera_at())
    kinds = jax.tree.map(lambda leaf: leaf.astype(jnp.float64), (TYPES[0],))
    image = photo(TYPES[0], (2.0, 0.1, 0.2)).astype(jnp.float64)
    direction = photo(TYPES[0], (2.0, 0.13, 0.21), blur=1.2).astype(jnp.float64) - image

    @jax.jit
    def value(image):
        pose = find_pallet(image, camera, kinds).value
        return pose.x + 0.5 * pose.y + 0.3 * pose.theta

    gradient = jax.jit(jax.grad(value))
    high, low = (float(value(image + s * direction)) for s in (1e-4, -1e-4))
    expected = float(jnp.sum(gradient(image) * direction))
    assert abs((high - low) / 2e-4 - expected) <= 1e-4 * abs(expected)
    assert np.all(np.asarray(gradient(jnp.zeros_like(image))) == 0)


def test_peaks_lie_where_the_blurred_steps_are(dtype):
    places, steps = np.array([30.3, 61.75, 90.5]), np.array([20.0, 35.0, 10.0])
    columns = np.arange(120.0)
    profile = sum(s * np.exp(-0.5 * ((columns - p) / 1.4) ** 2) for p, s in zip(places, steps, strict=True))
    peaks = strongest_edges(jnp.asarray(profile, dtype), 4)
    np.testing.assert_allclose(np.sort(peaks.columns)[1:], places, atol=1e-3)
    assert float(peaks.strength[3]) == 0.0 and peaks.columns.dtype == dtype


def test_template_has_wood_where_the_measures_say():
    template = np.asarray(face_template(euro_long()))
    kind = euro_long()
    holes = 2.0 * float(kind.hole_width * kind.hole_height)
    wood = float(kind.face_width * kind.face_height) - holes
    assert abs(template.mean() * 1.08 * float(kind.face_width * kind.face_height) / wood - 1.0) < 0.03
    np.testing.assert_array_equal(template, template[:, ::-1])
