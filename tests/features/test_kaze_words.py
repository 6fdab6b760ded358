"""Descriptors of KAZE and A-KAZE from plain sums over samples."""

import jax.numpy as jnp
import numpy as np

from jaxloc.features.kaze_words import MLdb, MSurf


def samples(rng, side, dtype=np.float64):
    return rng.normal(size=(3, side * side, 3)).astype(dtype), rng.uniform(0, 6.28, 3).astype(dtype)


def turned(values, angle):
    z = (values[..., 1] + 1j * values[..., 2]) * np.exp(-1j * angle)
    return z.real, z.imag


def test_msurf_equals_a_loop(dtype, rng):
    values, angle = samples(rng, 24, dtype)
    ours = MSurf().of(jnp.asarray(values), jnp.ones(values.shape[:2], bool), jnp.asarray(angle))
    assert ours.shape == (3, 64) and ours.dtype == dtype
    for k in range(3):
        along, aside = (x.reshape(24, 24) for x in turned(values[k].astype(float), angle[k]))
        numbers = []
        for i in range(4):
            for j in range(4):
                total = np.zeros(4)
                for v in range(5 * i, 5 * i + 9):
                    for u in range(5 * j, 5 * j + 9):
                        away = (v - 5 * i - 4) ** 2 + (u - 5 * j - 4) ** 2
                        du, dv = along[v, u], aside[v, u]
                        total += np.exp(-away / (2 * 2.5**2)) * np.array([du, dv, abs(du), abs(dv)])
                numbers.extend(total * np.exp(-((i - 1.5) ** 2 + (j - 1.5) ** 2) / (2 * 1.5**2)))
        np.testing.assert_allclose(ours[k], np.array(numbers) / np.linalg.norm(numbers), atol=1e-5)


def test_mldb_has_486_bits_of_means(rng):  # T-50
    values, angle = samples(rng, 20)
    words, plain = MLdb(), []
    bits = np.asarray(words.bits(jnp.asarray(values, jnp.float32), jnp.asarray(angle, jnp.float32)))
    for k in range(3):
        # Every sample twelve times along both axes: cells of thirds and halves fall between.
        channels = [
            np.kron(x.reshape(20, 20), np.ones((3, 3))) for x in (values[k, :, 0], *turned(values[k], angle[k]))
        ]
        row = []
        for cells in (2, 3, 4):
            for channel in channels:
                side = 60 // cells
                means = channel.reshape(cells, side, cells, side).mean(axis=(1, 3)).ravel()
                row += [means[a] > means[b] for a in range(cells**2) for b in range(a + 1, cells**2)]
        plain.append(row)
    assert bits.shape == (3, 486) == np.shape(plain) and np.mean(bits != plain) < 0.003
    packed = words.of(jnp.asarray(values, jnp.float32), jnp.ones((3, 400), bool), jnp.asarray(angle, jnp.float32))
    assert packed.shape == (3, 61) and packed.dtype == jnp.uint8
    unpacked = np.unpackbits(np.asarray(packed), axis=1, bitorder="little")
    assert (unpacked[:, :486] == bits).all() and not unpacked[:, 486:].any()


def test_samples_outside_do_not_count(rng):
    values, angle = samples(rng, 24, np.float32)
    inside = jnp.asarray(rng.uniform(size=values.shape[:2]) < 0.7)
    changed = np.where(np.asarray(inside)[:, :, None], values, 99.0).astype(np.float32)
    ours = [MSurf().of(jnp.asarray(x), inside, jnp.asarray(angle)) for x in (values, changed)]
    np.testing.assert_array_equal(*ours)
