"""KAZE and A-KAZE beside OpenCV's, and what turning, scaling and lighting do to them."""

from pathlib import Path

import cv2
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree

from jaxloc.features import Keypoints, kaze
from jaxloc.features.kaze import Kaze, describe_kaze
from jaxloc.features.kaze_words import MLdb
from jaxloc.features.match import match
from jaxloc.features.scale_space.nonlinear import DiffusedScaleSpace

OPTIONS = {"kaze": Kaze(), "akaze": Kaze.accelerated()}
SMALL = Kaze(DiffusedScaleSpace.accelerated(octaves=1), flat=True)
PEERS = {"kaze": cv2.KAZE_create, "akaze": cv2.AKAZE_create}


@eqx.filter_jit
def find(image, options):
    return kaze(image, options=options, capacity=700)


@pytest.fixture(scope="module")
def pictures():
    folder = Path(pytest.importorskip("skimage.data").__file__).parent
    read = lambda name: cv2.imread(str(folder / name), cv2.IMREAD_GRAYSCALE)  # noqa: E731
    return {"astronaut": read("astronaut.png")[:225, 100:325], "brick": read("brick.png")[:225, :225]}


@pytest.fixture(scope="module")
def found(pictures):
    every = [(p, o) for p in pictures for o in OPTIONS]
    return {(p, o): find(jnp.asarray(pictures[p], jnp.float32), OPTIONS[o]) for p, o in every}


def kept(found):
    keypoints, descriptors = found
    valid = np.asarray(keypoints.valid)
    return tuple(np.asarray(x)[valid] for x in (keypoints.uv, keypoints.size, keypoints.angle, descriptors.values))


@pytest.mark.parametrize(
    ("name", "kind", "least"),
    [("astronaut", "kaze", 0.75), ("astronaut", "akaze", 0.82), ("brick", "kaze", 0.68), ("brick", "akaze", 0.8)],
)
def test_finds_what_opencv_finds(pictures, found, name, kind, least):  # T-43, T-48, T-49
    """OpenCV differentiates each layer before its last diffusion and names it after: sizes are a quarter octave off."""
    # Directions are found with the descriptors.
    theirs, _ = PEERS[kind]().detectAndCompute(pictures[name], None)
    uv, size, angle, _ = kept(found[name, kind])
    distance, twin = cKDTree(uv).query([k.pt for k in theirs])
    near = distance < 2.0
    assert len(theirs) > 80 and near.mean() > least
    assert np.median(distance[near]) < 0.4
    apart = (np.rad2deg(angle[twin]) - [k.angle for k in theirs] + 180) % 360 - 180
    assert np.median(np.abs(apart[near])) < 5.0
    assert np.median(size[twin][near] / np.array([k.size for k in theirs])[near]) == pytest.approx(2**0.25, abs=0.06)


@pytest.mark.parametrize("kind", OPTIONS)
def test_keypoints_turn_with_the_picture(pictures, found, kind):
    """By a quarter, which nothing disturbs."""
    uv, size, angle, values = kept(found["astronaut", kind])
    turned = kept(find(jnp.asarray(np.rot90(pictures["astronaut"], -1).copy(), jnp.float32), OPTIONS[kind]))
    distance, twin = cKDTree(turned[0]).query(np.stack([224 - uv[:, 1], uv[:, 0]], axis=1))
    apart = np.abs((turned[2][twin] - angle - np.pi / 2 + np.pi) % (2 * np.pi) - np.pi)
    if kind == "kaze":
        alike = np.sum(values * turned[3][twin], axis=1) > 0.99
    else:
        alike = np.unpackbits(values ^ turned[3][twin], axis=1).sum(axis=1) < 30
    assert np.mean((distance < 0.05) & (apart < 0.02) & alike) > 0.9
    assert values.shape[1:] == ((64,) if kind == "kaze" else (61,))


@pytest.mark.parametrize(("kind", "degrees", "scale"), [("kaze", 30, 1.0), ("akaze", 45, 1.0), ("akaze", 0, 0.7)])
def test_matches_survive_turning_and_scaling(pictures, found, kind, degrees, scale):
    matrix = cv2.getRotationMatrix2D((112.0, 112.0), degrees, scale)
    image = cv2.warpAffine(pictures["astronaut"], matrix, (225, 225), flags=cv2.INTER_CUBIC)
    first, other = found["astronaut", kind], find(jnp.asarray(image, jnp.float32), OPTIONS[kind])
    pairs = match(first[1], other[1], ratio=0.8)
    valid = np.asarray(pairs.valid)
    true = np.asarray(first[0].uv) @ matrix[:, :2].T + matrix[:, 2]
    error = np.linalg.norm(true - np.asarray(other[0].uv)[np.asarray(pairs.index)], axis=1)[valid]
    assert valid.sum() > 20 and np.mean(error < 3.0) > 0.8


def test_descriptors_know_no_gain_and_bias(pictures):
    points = Keypoints.from_uv(jnp.array([[40.0, 20.0], [30.5, 41.2], [2.0, 2.0]]), size=6.0)
    image = jnp.asarray(pictures["astronaut"][60:124, 30:94], jnp.float32)
    plain, darker = (describe_kaze(x, points, options=SMALL) for x in (image, 0.5 * image + 30.0))
    np.testing.assert_allclose(plain.values, darker.values, atol=2e-3)
    np.testing.assert_allclose(jnp.linalg.norm(plain.values, axis=1), 1.0, atol=1e-5)


def test_gradients_are_finite(x64, pictures):
    """Through diffusion, extrema, directions and descriptors; the contrast is held."""
    image = jnp.asarray(pictures["astronaut"][60:124, 30:94], jnp.float64)

    @jax.jit
    def slope(image):
        features = lambda t: kaze(image * t, options=SMALL, capacity=3)  # noqa: E731
        return jax.jvp(lambda t: (features(t)[0].uv, features(t)[1].values), (1.0,), (1.0,))

    (_, values), slopes = slope(image)
    assert all(np.isfinite(s).all() for s in slopes) and np.abs(values).max() > 0


@pytest.mark.parametrize("value", [0.0, 120.0, np.nan])
@pytest.mark.parametrize("words", [SMALL.words, MLdb()])
def test_blank_pictures(value, words):
    keypoints, descriptors = kaze(jnp.full((64, 64), value, jnp.float32), options=Kaze(SMALL.scales, words), capacity=3)
    assert not keypoints.valid.any() and not descriptors.values.any() and np.isfinite(keypoints.uv).all()


def test_batch_is_a_loop(pictures):
    picture = pictures["astronaut"]
    images = jnp.asarray(np.stack([picture[:64, :64], picture[60:124, 30:94]]), jnp.float32)
    run = lambda image: kaze(image, options=SMALL, capacity=3)  # noqa: E731
    together = jax.jit(jax.vmap(run))(images)
    for i in range(2):
        keypoints, descriptors = run(images[i])
        np.testing.assert_allclose(together[0].uv[i], keypoints.uv, atol=1e-3)
        np.testing.assert_allclose(together[1].values[i], descriptors.values, atol=1e-3)
