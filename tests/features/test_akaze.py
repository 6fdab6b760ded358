"""A-KAZE: M-LDB from plain sums over samples; keypoints are tested with KAZE's."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxloc.features import Keypoints
from jaxloc.features.akaze import MLdb, akaze, akaze_options, describe_akaze


def samples(rng, side, dtype=np.float64):
    return rng.normal(size=(3, side * side, 3)).astype(dtype), rng.uniform(0, 6.28, 3).astype(dtype)


def rotated(values, angle):
    z = (values[..., 1] + 1j * values[..., 2]) * np.exp(-1j * angle)
    return z.real, z.imag


def test_mldb_has_486_bits_of_means(rng):  # T-50
    values, angle = samples(rng, 20)
    descriptor, plain = MLdb(), []
    bits = np.asarray(descriptor.bits(jnp.asarray(values, jnp.float32), jnp.asarray(angle, jnp.float32)))
    for k in range(3):
        # Every sample twelve times along both axes: cells of thirds and halves fall between.
        channels = [
            np.kron(x.reshape(20, 20), np.ones((3, 3))) for x in (values[k, :, 0], *rotated(values[k], angle[k]))
        ]
        row = []
        for cells in (2, 3, 4):
            for channel in channels:
                side = 60 // cells
                means = channel.reshape(cells, side, cells, side).mean(axis=(1, 3)).ravel()
                row += [means[a] > means[b] for a in range(cells**2) for b in range(a + 1, cells**2)]
        plain.append(row)
    assert bits.shape == (3, 486) == np.shape(plain) and np.mean(bits != plain) < 0.003
    packed = descriptor.describe(
        jnp.asarray(values, jnp.float32), jnp.ones((3, 400), bool), jnp.asarray(angle, jnp.float32)
    )
    assert packed.shape == (3, 61) and packed.dtype == jnp.uint8
    unpacked = np.unpackbits(np.asarray(packed), axis=1, bitorder="little")
    assert (unpacked[:, :486] == bits).all() and not unpacked[:, 486:].any()


def test_akaze_is_described_like_its_own_keypoints():
    """Blobs of noise: `describe_akaze` at the keypoints of `akaze` gives the same bits."""
    image = jax.image.resize(jax.random.uniform(jax.random.key(0), (12, 12), maxval=255.0), (72, 72), "cubic")
    options = akaze_options(octaves=1)
    keypoints, descriptors = akaze(image, options=options, capacity=8)
    assert keypoints.detector == "akaze" and int(keypoints.valid.sum()) >= 4
    again = describe_akaze(image, keypoints, options=options)
    assert (again.values == descriptors.values).all() and (again.valid == keypoints.valid).all()
    assert not describe_akaze(image, Keypoints.from_uv(keypoints.uv, jnp.zeros(8, bool)), options=options).valid.any()
