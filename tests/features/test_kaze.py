"""KAZE and A-KAZE against OpenCV, and their invariance to rotation, scale and illumination."""

from pathlib import Path

import cv2
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree

from jaxloc.features import Keypoints
from jaxloc.features.akaze import MLdb, akaze_options
from jaxloc.features.kaze import Kaze, MSurf, describe_kaze, kaze
from jaxloc.features.match import match
from jaxloc.features.scale_space.nonlinear import NonlinearScaleSpace

OPTIONS = {"kaze": Kaze(), "akaze": akaze_options()}
SMALL = Kaze(NonlinearScaleSpace.akaze(octaves=1), within_layer=True)
PEERS = {"kaze": cv2.KAZE_create, "akaze": cv2.AKAZE_create}


def samples(rng, side, dtype=np.float64):
    return rng.normal(size=(3, side * side, 3)).astype(dtype), rng.uniform(0, 6.28, 3).astype(dtype)


def rotated(values, angle):
    z = (values[..., 1] + 1j * values[..., 2]) * np.exp(-1j * angle)
    return z.real, z.imag


@eqx.filter_jit
def find(image, options):
    return kaze(image, options=options, capacity=700)


@pytest.fixture(scope="module")
def images():
    folder = Path(pytest.importorskip("skimage.data").__file__).parent
    read = lambda name: cv2.imread(str(folder / name), cv2.IMREAD_GRAYSCALE)  # noqa: E731
    return {"astronaut": read("astronaut.png")[:225, 100:325], "brick": read("brick.png")[:225, :225]}


@pytest.fixture(scope="module")
def found(images):
    every = [(p, o) for p in images for o in OPTIONS]
    return {(p, o): find(jnp.asarray(images[p], jnp.float32), OPTIONS[o]) for p, o in every}


def kept(found):
    keypoints, descriptors = found
    valid = np.asarray(keypoints.valid)
    return tuple(np.asarray(x)[valid] for x in (keypoints.uv, keypoints.size, keypoints.angle, descriptors.values))


@pytest.mark.parametrize(
    ("name", "kind", "least"),
    [("astronaut", "kaze", 0.75), ("astronaut", "akaze", 0.82), ("brick", "kaze", 0.68), ("brick", "akaze", 0.8)],
)
def test_finds_what_opencv_finds(images, found, name, kind, least):  # T-43, T-48, T-49
    """Sizes differ by a quarter octave: OpenCV differentiates each layer before its last diffusion step."""
    # OpenCV computes orientations with the descriptors.
    theirs, _ = PEERS[kind]().detectAndCompute(images[name], None)
    uv, size, angle, _ = kept(found[name, kind])
    distance, index = cKDTree(uv).query([k.pt for k in theirs])
    near = distance < 2.0
    assert len(theirs) > 80 and near.mean() > least
    assert np.median(distance[near]) < 0.4
    apart = (np.rad2deg(angle[index]) - [k.angle for k in theirs] + 180) % 360 - 180
    assert np.median(np.abs(apart[near])) < 5.0
    assert np.median(size[index][near] / np.array([k.size for k in theirs])[near]) == pytest.approx(2**0.25, abs=0.06)


@pytest.mark.parametrize("kind", OPTIONS)
def test_keypoints_rotate_with_the_image(images, found, kind):
    """By 90 degrees, without interpolation."""
    uv, size, angle, values = kept(found["astronaut", kind])
    turned = kept(find(jnp.asarray(np.rot90(images["astronaut"], -1).copy(), jnp.float32), OPTIONS[kind]))
    distance, index = cKDTree(turned[0]).query(np.stack([224 - uv[:, 1], uv[:, 0]], axis=1))
    apart = np.abs((turned[2][index] - angle - np.pi / 2 + np.pi) % (2 * np.pi) - np.pi)
    if kind == "kaze":
        alike = np.sum(values * turned[3][index], axis=1) > 0.99
    else:
        alike = np.unpackbits(values ^ turned[3][index], axis=1).sum(axis=1) < 30
    assert np.mean((distance < 0.05) & (apart < 0.02) & alike) > 0.9
    assert values.shape[1:] == ((64,) if kind == "kaze" else (61,))


@pytest.mark.parametrize(("kind", "degrees", "scale"), [("kaze", 30, 1.0), ("akaze", 45, 1.0), ("akaze", 0, 0.7)])
def test_matches_survive_turning_and_scaling(images, found, kind, degrees, scale):
    matrix = cv2.getRotationMatrix2D((112.0, 112.0), degrees, scale)
    image = cv2.warpAffine(images["astronaut"], matrix, (225, 225), flags=cv2.INTER_CUBIC)
    first, other = found["astronaut", kind], find(jnp.asarray(image, jnp.float32), OPTIONS[kind])
    pairs = match(first[1], other[1], ratio=0.8)
    valid = np.asarray(pairs.valid)
    true = np.asarray(first[0].uv) @ matrix[:, :2].T + matrix[:, 2]
    error = np.linalg.norm(true - np.asarray(other[0].uv)[np.asarray(pairs.index)], axis=1)[valid]
    assert valid.sum() > 20 and np.mean(error < 3.0) > 0.8


def test_descriptors_are_invariant_to_gain_and_bias(images):
    points = Keypoints.from_uv(jnp.array([[40.0, 20.0], [30.5, 41.2], [2.0, 2.0]]), size=6.0)
    image = jnp.asarray(images["astronaut"][60:124, 30:94], jnp.float32)
    plain, darker = (describe_kaze(x, points, options=SMALL) for x in (image, 0.5 * image + 30.0))
    np.testing.assert_allclose(plain.values, darker.values, atol=2e-3)
    np.testing.assert_allclose(jnp.linalg.norm(plain.values, axis=1), 1.0, atol=1e-5)


def test_gradients_are_finite(x64, images):
    """Through diffusion, extrema, orientations and descriptors; the contrast parameter is constant."""
    image = jnp.asarray(images["astronaut"][60:124, 30:94], jnp.float64)

    @jax.jit
    def slope(image):
        features = lambda t: kaze(image * t, options=SMALL, capacity=3)  # noqa: E731
        return jax.jvp(lambda t: (features(t)[0].uv, features(t)[1].values), (1.0,), (1.0,))

    (_, values), slopes = slope(image)
    assert all(np.isfinite(s).all() for s in slopes) and np.abs(values).max() > 0


@pytest.mark.parametrize("value", [0.0, 120.0, np.nan])
@pytest.mark.parametrize("descriptor", [SMALL.descriptor, MLdb()])
def test_blank_images(value, descriptor):
    options = Kaze(SMALL.scales, descriptor)
    keypoints, descriptors = kaze(jnp.full((64, 64), value, jnp.float32), options=options, capacity=3)
    assert not keypoints.valid.any() and not descriptors.values.any() and np.isfinite(keypoints.uv).all()


def test_batch_is_a_loop(images):
    astronaut = images["astronaut"]
    images = jnp.asarray(np.stack([astronaut[:64, :64], astronaut[60:124, 30:94]]), jnp.float32)
    run = lambda image: kaze(image, options=SMALL, capacity=3)  # noqa: E731
    together = jax.jit(jax.vmap(run))(images)
    for i in range(2):
        keypoints, descriptors = run(images[i])
        np.testing.assert_allclose(together[0].uv[i], keypoints.uv, atol=1e-3)
        np.testing.assert_allclose(together[1].values[i], descriptors.values, atol=1e-3)


def test_msurf_equals_a_loop(dtype, rng):
    values, angle = samples(rng, 24, dtype)
    ours = MSurf().describe(jnp.asarray(values), jnp.ones(values.shape[:2], bool), jnp.asarray(angle))
    assert ours.shape == (3, 64) and ours.dtype == dtype
    for k in range(3):
        along, across = (x.reshape(24, 24) for x in rotated(values[k].astype(float), angle[k]))
        numbers = []
        for i in range(4):
            for j in range(4):
                total = np.zeros(4)
                for v in range(5 * i, 5 * i + 9):
                    for u in range(5 * j, 5 * j + 9):
                        away = (v - 5 * i - 4) ** 2 + (u - 5 * j - 4) ** 2
                        du, dv = along[v, u], across[v, u]
                        total += np.exp(-away / (2 * 2.5**2)) * np.array([du, dv, abs(du), abs(dv)])
                numbers.extend(total * np.exp(-((i - 1.5) ** 2 + (j - 1.5) ** 2) / (2 * 1.5**2)))
        np.testing.assert_allclose(ours[k], np.array(numbers) / np.linalg.norm(numbers), atol=1e-5)


def test_samples_outside_do_not_count(rng):
    values, angle = samples(rng, 24, np.float32)
    inside = jnp.asarray(rng.uniform(size=values.shape[:2]) < 0.7)
    changed = np.where(np.asarray(inside)[:, :, None], values, 99.0).astype(np.float32)
    ours = [MSurf().describe(jnp.asarray(x), inside, jnp.asarray(angle)) for x in (values, changed)]
    np.testing.assert_array_equal(*ours)
