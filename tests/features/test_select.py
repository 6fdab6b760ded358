"""Selection per grid cell and by square covering against plain loops, peaks against SciPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage

from jaxloc.features.opencv.detect import _order_by_cell_rank
from jaxloc.features.select import cover_squares, coverage, local_peaks, select_by_grid

SHAPE, GRID, N = (60, 80), (3, 4), 50
LARGE = (120, 160)


def make(rng, dtype=np.float32):
    uv = np.stack([rng.uniform(0, 80, N) ** 2 / 80, rng.uniform(0, 60, N)], axis=1)
    return uv.astype(dtype), rng.permutation(N).astype(dtype), rng.uniform(size=N) < 0.8


def by_turns(uv, score, valid, capacity, per_cell=None):
    """Round-robin selection over cells, with lists."""
    cells = {}
    for i in np.argsort(-score):
        if valid[i]:
            cells.setdefault((int(uv[i, 1] // 20), int(uv[i, 0] // 20)), []).append(i)
    chosen, turn = [], 0
    while any(len(cell) > turn for cell in cells.values()) and (per_cell is None or turn < per_cell):
        chosen += sorted((cell[turn] for cell in cells.values() if len(cell) > turn), key=lambda i: -score[i])
        turn += 1
    return chosen[:capacity]


def test_select_by_grid_equals_lists(rng, dtype):  # T-70
    uv, score, valid = make(rng, dtype)
    for capacity, per_cell in ((20, None), (70, None), (70, 2)):
        got = select_by_grid(
            *map(jnp.asarray, (uv, score, valid)), shape=SHAPE, grid=GRID, capacity=capacity, per_cell=per_cell
        )
        want = by_turns(uv, score, valid, capacity, per_cell)
        assert got.index.shape == (capacity,)
        assert got.valid.tolist() == [True] * len(want) + [False] * (capacity - len(want))
        assert got.index[: len(want)].tolist() == [int(i) for i in want]


def test_opencv_detection_selects_in_the_same_order(rng):
    uv, score, valid = make(rng)
    order = _order_by_cell_rank(uv[valid], score[valid], SHAPE, GRID)
    want = np.flatnonzero(valid)[order]
    assert [int(i) for i in by_turns(uv, score, valid, N)] == want.tolist()


def test_the_grid_raises_the_entropy_of_coverage(rng):  # T-70
    uv, score, valid = make(rng)
    score = (score - uv[:, 0]).astype(np.float32)
    uv, score, valid = map(jnp.asarray, (uv, score, valid))
    figures = []
    for grid in ((1, 1), GRID):
        chosen = select_by_grid(uv, score, valid, shape=SHAPE, grid=grid, capacity=12)
        figures.append(coverage(uv[chosen.index], chosen.valid, shape=SHAPE, grid=GRID))
    assert float(figures[1].entropy) > float(figures[0].entropy) + 0.1
    assert float(figures[1].filled) > float(figures[0].filled)


def test_coverage_of_known_sets():
    uv = jnp.array([[10.0, 10.0], [30.0, 10.0], [50.0, 10.0], [70.0, 10.0]])
    every, none = jnp.ones(4, dtype=bool), jnp.zeros(4, dtype=bool)
    even = coverage(uv, every, shape=SHAPE, grid=(1, 4))
    assert round(float(even.entropy), 5) == 1.0 and float(even.filled) == 1.0
    assert even.counts.tolist() == [[1, 1, 1, 1]]
    assert float(coverage(uv, every, shape=SHAPE, grid=(1, 1)).entropy) == 0.0
    empty = coverage(uv, none, shape=SHAPE, grid=(1, 4))
    assert float(empty.entropy) == 0.0 and float(empty.filled) == 0.0


def test_masked_points_do_not_count(rng):
    uv, score, valid = make(rng)
    bad = np.where(valid[:, None], uv, np.nan).astype(np.float32)
    options = {"shape": SHAPE, "grid": GRID, "capacity": 20}
    a = select_by_grid(jnp.asarray(uv), jnp.asarray(score), jnp.asarray(valid), **options)
    b = select_by_grid(jnp.asarray(bad), jnp.asarray(score), jnp.asarray(valid), **options)
    assert a.index.tolist() == b.index.tolist()


def test_local_peaks_equal_scipy(rng, dtype):
    response = rng.normal(size=(47, 61)).astype(dtype)
    got = local_peaks(jnp.asarray(response), grid=(3, 4), per_cell=5, radius=2, threshold=0.5)
    peak = (response == ndimage.maximum_filter(response, 5, mode="constant", cval=-np.inf)) & (response > 0.5)
    assert got.response.dtype == dtype
    want = set()
    for top in range(0, 48, 16):
        for left in range(0, 64, 16):
            rows, columns = np.nonzero(peak[top : top + 16, left : left + 16])
            values = response[rows + top, columns + left]
            best = np.argsort(-values)[:5]
            want |= {(float(columns[i] + left), float(rows[i] + top)) for i in best}
    assert {tuple(uv) for uv, ok in zip(got.uv.tolist(), got.valid.tolist(), strict=True) if ok} == want
    assert float(jnp.abs(got.uv[~got.valid]).sum()) == 0.0


def test_jit_and_vmap(rng):
    uv, score, valid = map(jnp.asarray, make(rng))
    one = select_by_grid(uv, score, valid, shape=SHAPE, grid=GRID, capacity=9)
    many = jax.vmap(lambda s: select_by_grid(uv, s, valid, shape=SHAPE, grid=GRID, capacity=9).index)(
        jnp.stack([score, -score])
    )
    assert many[0].tolist() == one.index.tolist()


def crowd(rng, n=150):
    """Two thirds of the points lie in a corner and have the highest scores."""
    uv = rng.uniform(0, 1, (n, 2)) * [160, 120]
    uv[: 2 * n // 3] *= 0.3
    score = rng.uniform(0, 1, n)
    score[: 2 * n // 3] += 1
    return uv.astype(np.float32), score.astype(np.float32)


def covered(uv, score, valid, side):
    kept = []
    for k in sorted(np.flatnonzero(valid), key=lambda k: -score[k]):
        if all(np.abs(uv[k] - uv[other]).max() >= side / 2 for other in kept):
            kept.append(k)
    return kept


def choose_squares(uv, score, valid, capacity=30):
    return cover_squares(*(jnp.asarray(x) for x in (uv, score, valid)), shape=LARGE, capacity=capacity)


def test_square_covering_equals_a_plain_search_over_sides(rng):
    uv, score = crowd(rng)
    valid = rng.uniform(size=150) < 0.9
    low, high, best = 0.0, 160.0, []
    for _ in range(12):
        side = 0.5 * (low + high)
        kept = covered(uv, score, valid, side)
        low, high, best = (side, high, kept) if len(kept) >= 30 else (low, side, best)
    found = choose_squares(uv, score, valid)
    assert found.valid.all() and found.index.tolist() == best[:30]


def test_square_covering_is_even_and_keeps_the_best(rng):  # T-70
    uv, score = crowd(rng)
    found = choose_squares(uv, score, np.ones(150, bool))
    strongest = np.argsort(-score)[:30]
    even, raw = (
        coverage(jnp.asarray(uv[i]), jnp.ones(30, bool), shape=LARGE, grid=(6, 8)) for i in (found.index, strongest)
    )
    assert float(even.filled) > 2 * float(raw.filled) and int(found.index[0]) == strongest[0]


@pytest.mark.parametrize("count", [0, 5])
def test_square_covering_of_fewer_points_than_slots(rng, count):
    uv, score = crowd(rng)
    valid = np.arange(150) < count
    found = choose_squares(uv, score, valid)
    assert int(found.valid.sum()) == count and set(found.index[found.valid].tolist()) == set(range(count))
    assert choose_squares(uv[:5], score[:5], np.ones(5, bool)).valid.tolist() == [True] * 5 + [False] * 25


def test_square_covering_of_coincident_points():
    uv, score = np.full((9, 2), 7.0, np.float32), np.arange(9, dtype=np.float32)
    assert choose_squares(uv, score, np.ones(9, bool), capacity=3).index[0] == 8


def test_square_covering_of_a_batch_is_a_loop(rng):
    sets = [crowd(rng) for _ in range(2)]
    uv, score = (jnp.asarray(np.stack(x)) for x in zip(*sets, strict=True))
    run = lambda u, s: cover_squares(u, s, jnp.ones(150, bool), shape=LARGE, capacity=30).index  # noqa: E731
    together = jax.vmap(run)(uv, score)
    for i in range(2):
        assert together[i].tolist() == run(uv[i], score[i]).tolist()
