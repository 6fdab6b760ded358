"""Even selection against a plain loop, peaks against SciPy."""

import jax
import jax.numpy as jnp
import numpy as np
from scipy import ndimage

from jaxloc.features.select import coverage, local_peaks, spread

SHAPE, GRID, N = (60, 80), (3, 4), 50


def make(rng, dtype=np.float32):
    uv = np.stack([rng.uniform(0, 80, N) ** 2 / 80, rng.uniform(0, 60, N)], axis=1)
    return uv.astype(dtype), rng.permutation(N).astype(dtype), rng.uniform(size=N) < 0.8


def turns(uv, score, valid, capacity, per_cell=None):
    """Cells take turns, written as lists."""
    cells = {}
    for i in np.argsort(-score):
        if valid[i]:
            cells.setdefault((int(uv[i, 1] // 20), int(uv[i, 0] // 20)), []).append(i)
    chosen, turn = [], 0
    while any(len(cell) > turn for cell in cells.values()) and (per_cell is None or turn < per_cell):
        chosen += sorted((cell[turn] for cell in cells.values() if len(cell) > turn), key=lambda i: -score[i])
        turn += 1
    return chosen[:capacity]


def test_spread_equals_taking_turns(rng, dtype):  # T-70
    uv, score, valid = make(rng, dtype)
    for capacity, per_cell in ((20, None), (70, None), (70, 2)):
        got = spread(
            *map(jnp.asarray, (uv, score, valid)), shape=SHAPE, grid=GRID, capacity=capacity, per_cell=per_cell
        )
        want = turns(uv, score, valid, capacity, per_cell)
        assert got.index.shape == (capacity,)
        assert got.valid.tolist() == [True] * len(want) + [False] * (capacity - len(want))
        assert got.index[: len(want)].tolist() == [int(i) for i in want]


def test_detector_selects_alike(rng):
    uv, score, valid = make(rng)
    order = detect._take_turns(uv[valid], score[valid], SHAPE, GRID)
    want = np.flatnonzero(valid)[order]
    assert [int(i) for i in turns(uv, score, valid, N)] == want.tolist()


def test_the_grid_evens_out(rng):  # T-70: coverage entropy goes up
    uv, score, valid = make(rng)
    score = (score - uv[:, 0]).astype(np.float32)
    uv, score, valid = map(jnp.asarray, (uv, score, valid))
    figures = []
    for grid in ((1, 1), GRID):
        chosen = spread(uv, score, valid, shape=SHAPE, grid=grid, capacity=12)
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
    a = spread(jnp.asarray(uv), jnp.asarray(score), jnp.asarray(valid), **options)
    b = spread(jnp.asarray(bad), jnp.asarray(score), jnp.asarray(valid), **options)
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
    one = spread(uv, score, valid, shape=SHAPE, grid=GRID, capacity=9)
    many = jax.vmap(lambda s: spread(uv, s, valid, shape=SHAPE, grid=GRID, capacity=9).index)(
        jnp.stack([score, -score])
    )
    assert many[0].tolist() == one.index.tolist()
