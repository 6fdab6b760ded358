"""Square covering beside a plain loop, and how evenly it spreads."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.features.select import cover_squares, coverage

SHAPE = (120, 160)


def crowd(rng, n=150):
    """Two thirds in a corner, and the best of them."""
    uv = rng.uniform(0, 1, (n, 2)) * [160, 120]
    uv[: 2 * n // 3] *= 0.3
    score = rng.uniform(0, 1, n)
    score[: 2 * n // 3] += 1
    return uv.astype(np.float32), score.astype(np.float32)


def plain(uv, score, valid, side):
    kept = []
    for k in sorted(np.flatnonzero(valid), key=lambda k: -score[k]):
        if all(np.abs(uv[k] - uv[other]).max() >= side / 2 for other in kept):
            kept.append(k)
    return kept


def choose(uv, score, valid, capacity=30):
    return cover_squares(*(jnp.asarray(x) for x in (uv, score, valid)), shape=SHAPE, capacity=capacity)


def test_equals_a_plain_search_over_sides(rng):
    uv, score = crowd(rng)
    valid = rng.uniform(size=150) < 0.9
    low, high, best = 0.0, 160.0, []
    for _ in range(12):
        side = 0.5 * (low + high)
        kept = plain(uv, score, valid, side)
        low, high, best = (side, high, kept) if len(kept) >= 30 else (low, side, best)
    found = choose(uv, score, valid)
    assert found.valid.all() and found.index.tolist() == best[:30]


def test_it_spreads_and_keeps_the_best(rng):  # T-70
    uv, score = crowd(rng)
    found = choose(uv, score, np.ones(150, bool))
    strongest = np.argsort(-score)[:30]
    even, raw = (
        coverage(jnp.asarray(uv[i]), jnp.ones(30, bool), shape=SHAPE, grid=(6, 8)) for i in (found.index, strongest)
    )
    assert float(even.filled) > 2 * float(raw.filled) and int(found.index[0]) == strongest[0]


@pytest.mark.parametrize("count", [0, 5])
def test_fewer_points_than_slots(rng, count):
    uv, score = crowd(rng)
    valid = np.arange(150) < count
    found = choose(uv, score, valid)
    assert int(found.valid.sum()) == count and set(found.index[found.valid].tolist()) == set(range(count))
    assert choose(uv[:5], score[:5], np.ones(5, bool)).valid.tolist() == [True] * 5 + [False] * 25


def test_points_at_one_place_do_not_fill_the_slots():
    uv, score = np.full((9, 2), 7.0, np.float32), np.arange(9, dtype=np.float32)
    assert choose(uv, score, np.ones(9, bool), capacity=3).index[0] == 8


def test_batch_is_a_loop(rng):
    sets = [crowd(rng) for _ in range(2)]
    uv, score = (jnp.asarray(np.stack(x)) for x in zip(*sets, strict=True))
    run = lambda u, s: cover_squares(u, s, jnp.ones(150, bool), shape=SHAPE, capacity=30).index  # noqa: E731
    together = jax.vmap(run)(uv, score)
    for i in range(2):
        assert together[i].tolist() == run(uv[i], score[i]).tolist()
