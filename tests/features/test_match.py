"""Matching against loops and OpenCV; filters raise precision."""

import cv2
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.features import match as matching
from jaxloc.features.keypoints import Descriptors
from jaxloc.features.match import (
    euclidean_distances,
    hamming_distances,
    is_distinct,
    is_mutual,
    is_similar,
    match,
    nearest,
    row_gate,
    window_gate,
)


def every(n):
    return jnp.ones(n, dtype=bool)


def noisy_pair(rng, n=60, extra=30, flips=0.12):
    """Bits of `n` points seen twice, with flipped bits, and of `extra` points seen once."""
    bits = rng.uniform(size=(n, 256)) < 0.5
    seen = bits ^ (rng.uniform(size=bits.shape) < flips)
    # Some points look alike.
    seen[: n // 3] = bits[n // 3 : 2 * (n // 3)] ^ (rng.uniform(size=(n // 3, 256)) < 0.05)
    others = rng.uniform(size=(2, extra, 256)) < 0.5
    packed = [np.packbits(np.concatenate(x), axis=1) for x in ((bits, others[0]), (seen, others[1]))]
    return [Descriptors(jnp.asarray(x), every(n + extra)) for x in packed]


@pytest.mark.parametrize("width", [32, 61])
def test_hamming_equals_numpy(rng, width):
    a, b = (rng.integers(0, 256, (n, width), dtype=np.uint8) for n in (20, 31))
    want = [[np.unpackbits(x ^ y).sum() for y in b] for x in a]
    np.testing.assert_array_equal(hamming_distances(jnp.asarray(a), jnp.asarray(b)), want)


def test_euclidean_equals_numpy(rng, dtype):
    a, b = (rng.normal(size=(n, 64)).astype(dtype) for n in (20, 31))
    got = euclidean_distances(jnp.asarray(a), jnp.asarray(b))
    assert got.dtype == dtype
    np.testing.assert_allclose(got, np.linalg.norm(a[:, None] - b[None], axis=-1), rtol=1e-5)


def test_euclidean_gradient(rng, x64):
    a, b = rng.normal(size=(5, 8)), rng.normal(size=(6, 8))
    a[0] = b[0]

    def value(a):
        return euclidean_distances(jnp.asarray(a), jnp.asarray(b))[1:].sum()

    gradient = jax.grad(lambda x: euclidean_distances(x, jnp.asarray(b)).sum())(jnp.asarray(a))
    assert bool(jnp.isfinite(gradient).all())
    step = 1e-6 * rng.normal(size=a.shape)
    slope = (value(a + step) - value(a - step)) / 2
    np.testing.assert_allclose((jax.grad(value)(jnp.asarray(a)) * step).sum(), slope, rtol=1e-6)


@pytest.mark.parametrize("binary", [True, False])
def test_equals_opencv(rng, binary):
    if binary:
        first, second = noisy_pair(rng)
    else:
        values = rng.normal(size=(2, 50, 32)).astype(np.float32)
        first, second = (Descriptors(jnp.asarray(x), every(50)) for x in (values[0], values[0] + 0.4 * values[1]))
    a, b = np.asarray(first.values), np.asarray(second.values)
    norm = cv2.NORM_HAMMING if binary else cv2.NORM_L2
    want = {m.queryIdx: m for m in cv2.BFMatcher(norm, crossCheck=True).match(a, b)}
    got = match(first, second)
    ties = hamming_distances(first.values, second.values) if binary else None
    for i, ok in enumerate(got.valid.tolist()):
        # OpenCV and we may choose differently among equal distances, and only there.
        if ties is None or (ties[i] == ties[i].min()).sum() == 1:
            assert ok == (i in want)
        if ok and i in want:
            np.testing.assert_allclose(got.distance[i], want[i].distance, rtol=1e-5)
            assert ties is not None or int(got.index[i]) == want[i].trainIdx
    pairs = cv2.BFMatcher(norm).knnMatch(a, b, k=2)
    ratio = match(first, second, ratio=0.8, mutual=False)
    assert ratio.valid.tolist() == [x.distance < 0.8 * y.distance for x, y in pairs]


def test_each_filter_raises_precision(rng):  # T-11
    first, second = noisy_pair(rng, n=90, extra=60, flips=0.2)
    truth = np.arange(150)
    # Points that look alike lie in other rows.
    uv = np.stack([rng.uniform(0, 500, 150), rng.permutation(150) * 2.0], axis=1).astype(np.float32)
    gate = row_gate(jnp.asarray(uv), jnp.asarray(uv - [3.0, 0.3], jnp.float32), disparity=(0.0, 50.0))

    def precision(**filters):
        got = match(first, second, **{"mutual": False, **filters})
        valid = np.asarray(got.valid)
        return ((np.asarray(got.index) == truth) & (truth < 90))[valid].mean()

    plain = precision()
    filters = [{"max_distance": 70.0}, {"mutual": True}, {"ratio": 0.8}, {"gate": gate}]
    for option in filters:
        assert precision(**option) > plain
    everything = {key: value for option in filters for key, value in option.items()}
    assert precision(**everything) >= max(precision(**option) for option in filters)


def test_filters_compose_by_hand(rng):
    first, second = noisy_pair(rng)
    distances = hamming_distances(first.values, second.values)
    found = nearest(distances, jnp.ones_like(distances, dtype=bool))
    back = nearest(distances.T, jnp.ones_like(distances.T, dtype=bool))
    passed = is_similar(found, 80.0) & is_distinct(found, 0.9) & is_mutual(found, back)
    got = match(first, second, max_distance=80.0, ratio=0.9)
    along_columns = nearest(distances, jnp.ones_like(distances, dtype=bool), axis=0)
    assert all((x == y).all() for x, y in zip(jax.tree.leaves(back), jax.tree.leaves(along_columns), strict=True))
    assert got.valid.tolist() == passed.tolist() and 0 < int(passed.sum()) < len(passed)


def test_row_gate_equals_a_loop(rng, dtype):  # T-71
    left, right = (rng.uniform(0, 20, (n, 2)).astype(dtype) for n in (15, 18))
    got = row_gate(jnp.asarray(left), jnp.asarray(right), tolerance=2.0, disparity=(0.0, 8.0))
    want = [[abs(a[1] - b[1]) <= 2 and 0 < a[0] - b[0] <= 8 for b in right] for a in left]
    assert got.tolist() == want
    got = window_gate(jnp.asarray(left), jnp.asarray(right), radius=3.0)
    assert got.tolist() == [[bool(np.abs(a - b).max() <= 3) for b in right] for a in left]


@pytest.mark.parametrize("binary", [True, False])
def test_masked_equals_absent(rng, binary):
    first, second = noisy_pair(rng)
    if not binary:
        first, second = (Descriptors(x.values.astype(jnp.float32), x.valid) for x in (first, second))
    keep_first, keep_second = rng.uniform(size=90) < 0.7, rng.uniform(size=90) < 0.7
    got = match(
        Descriptors(first.values, jnp.asarray(keep_first)), Descriptors(second.values, jnp.asarray(keep_second))
    )
    short = match(
        Descriptors(first.values[keep_first], every(int(keep_first.sum()))),
        Descriptors(second.values[keep_second], every(int(keep_second.sum()))),
    )
    assert not np.asarray(got.valid)[~keep_first].any()
    assert np.asarray(got.valid)[keep_first].tolist() == short.valid.tolist()
    index = np.flatnonzero(keep_second)[np.asarray(short.index)]
    np.testing.assert_array_equal(np.asarray(got.index)[keep_first], np.where(short.valid, index, 0))
    none = match(Descriptors(first.values, jnp.zeros(90, dtype=bool)), second, ratio=0.8)
    assert not bool(none.valid.any()) and not bool(none.distance.any())


def test_kinds_must_agree(rng):
    first, second = noisy_pair(rng)
    with pytest.raises(ValueError, match="cannot compare"):
        match(first, Descriptors(second.values.astype(jnp.float32), second.valid))


def test_new_numbers_do_not_retrace(rng, monkeypatch):
    first, second = noisy_pair(rng)
    traces = []
    original = matching._match.__wrapped__
    counted = eqx.filter_jit(lambda *args: (traces.append(1), original(*args))[1])
    monkeypatch.setattr(matching, "_match", counted)
    for ratio in (0.7, 0.8, 0.9):
        match(first, second, ratio=ratio, max_distance=100 * ratio)
    assert len(traces) == 1


def test_jit_vmap_and_eager_agree(rng):
    first, second = noisy_pair(rng, n=20, extra=10)
    want = match(first, second, ratio=0.9)
    stack = jax.tree.map(lambda *x: jnp.stack(x), first, second)
    got = jax.vmap(lambda one: match(one, second, ratio=0.9))(stack)
    assert got.index[0].tolist() == want.index.tolist()
    with jax.disable_jit():
        assert match(first, second, ratio=0.9).valid.tolist() == want.valid.tolist()
