import dataclasses

import cv2
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxloc as jl
from jaxloc.data.simulate.road.rendering import Road, Streak, render
from jaxloc.lanes import ralph
from jaxloc.lanes.ground_view import GroundGrid, GroundView, inverse_perspective

SHAPE = (240, 320)
GROUND = jl.sensors.GroundCamera(jl.sensors.Pinhole(300.0, 300.0, 159.5, 99.5), 1.3, 0.03)
ROAD = Road()
FOREIGN = Road(
    marks=(),
    streaks=(Streak(1.35, 0.15, 25.0), Streak(-0.2, 0.3, -20.0), Streak(-1.25, 0.2, 20.0)),
    seed=5,
    edges=(4.4, -3.6),
    grass=130.0,
)


def view_of(picture, wrong_pitch=0.0, grid=None):
    made = eqx.tree_at(lambda g: g.pitch, GROUND, GROUND.pitch - wrong_pitch)
    return inverse_perspective(made, jnp.asarray(picture), GroundGrid.for_speed(15.0) if grid is None else grid)


def picture_of(road, truth, **options):
    return render(road, jl.lanes.Lane(*truth), GROUND, shape=SHAPE, **options)


def capture_of(road):
    return ralph.capture(view_of(picture_of(road, (0.0, 0.0, 0.0), travelled=5.0)), ralph.LaneFit())


@pytest.fixture(scope="module")
def template():
    return capture_of(ROAD)


@pytest.fixture(scope="module")
def plain_template():
    return capture_of(ROAD.without_marks())


def truths(count, seed=3):
    rng = np.random.default_rng(seed)
    return rng.uniform(-1.0, 1.0, (count, 3)) * np.array([0.6, 0.03, 2e-3]), rng.uniform(50.0, 900.0, count)


def errors_of(road, template, wrong_pitch, count, seed=3):
    """Errors in the order of `LaneFit`, squared Mahalanobis distances of the lane, and what was believed."""
    found = []
    for truth, travelled in zip(*truths(count, seed), strict=True):
        state = ralph.estimate(view_of(picture_of(road, truth, travelled=travelled), wrong_pitch), template)
        value = state.estimate.value
        error = np.array([value.offset, value.heading, value.curvature, value.pitch]) - np.append(truth, wrong_pitch)
        covariance = np.array(state.estimate.covariance, np.float64)[:3, :3]
        found.append((error, error[:3] @ np.linalg.solve(covariance, error[:3]), bool(state.ok)))
    errors, nees, ok = zip(*found, strict=True)
    return np.array(errors), np.array(nees), np.array(ok)


@pytest.mark.slow
@pytest.mark.parametrize("wrong_pitch", [0.0, np.deg2rad(0.5)])
def test_road_with_marks(template, wrong_pitch):
    errors, nees, ok = errors_of(ROAD, template, wrong_pitch, 24)
    assert ok.mean() >= 0.9
    offset, heading, curvature, pitch = np.median(np.abs(errors), axis=0)
    assert offset < 0.02 and heading < 2e-3 and curvature < 1.5e-4 and pitch < 1e-3
    # The median of chi-square with 3 degrees of freedom is 2.37.
    assert 0.6 < np.median(nees) < 8.0


@pytest.mark.slow
def test_road_without_marks(plain_template):
    errors, _, ok = errors_of(ROAD.without_marks(), plain_template, 0.0, 16)
    assert ok.mean() >= 0.9
    # Half the pixels of the benchmark's images, and a template of one image: its tracks wander by 3 cm.
    offset, _, curvature, _ = np.median(np.abs(errors), axis=0)
    assert offset < 0.08 and curvature < 4e-4


def test_sharpest_is_straightest():
    """K-36, K-37: every measure is highest at the true lane, and the vmapped search finds what a loop finds."""
    truth = (0.2, 0.01, 1.2e-3)
    view = view_of(picture_of(ROAD, truth, travelled=100.0))
    for sharpness in (ralph.AbsoluteSteps(), ralph.SmoothSteps()):
        fits = jax.vmap(lambda c: ralph.LaneFit(0.0 * c, 0.01 + 0.0 * c, c, 0.0 * c))(
            1.2e-3 + jnp.linspace(-2e-3, 2e-3, 21)
        )
        scores = jax.vmap(lambda fit, s=sharpness: ralph.straightness(view, fit, sharpness=s))(fits)
        assert abs(int(jnp.argmax(scores)) - 10) <= 1
        alone = ralph.straightness(view, jax.tree.map(lambda leaf: leaf[3], fits), sharpness=sharpness)
        np.testing.assert_allclose(scores[3], alone, rtol=1e-4)
    tried = ralph.Hypotheses.around(
        ralph.LaneFit(0.0, 0.0, 1e-3), curvature=1e-3, heading=0.02, pitch=0.0, counts=(11, 9, 1)
    )
    found = ralph.find_straightest(view, tried)
    assert found.scores.shape == (1, 9, 11) and float(found.score) == float(jnp.max(found.scores))
    assert abs(float(found.fit.curvature) - 1.2e-3) < 5e-4 and abs(float(found.fit.heading) - 0.01) < 0.012


def test_columns_of_the_straightened_road_are_straight():
    """K-35: under the true lane a solid border stands in one column at every range."""
    truth = (0.2, 0.02, 1.5e-3)
    view = view_of(picture_of(dataclasses.replace(ROAD, shadows=None), truth, travelled=100.0))
    level = ralph.straighten(view, ralph.LaneFit(*truth), view.grid.left)
    border = np.argmax(np.where(level.weight > 0.0, level.values, -9.0)[:40, 64:], axis=1) + 64
    np.testing.assert_allclose(np.array(view.grid.left)[border], -1.8, atol=0.12)


def numpy_correlations(profile, template, span):
    """Pearson's coefficient of each overlap."""
    found = []
    for shift in range(-span, span + 1):
        here = slice(max(shift, 0), len(profile) + min(shift, 0))
        there = slice(max(-shift, 0), len(profile) + min(-shift, 0))
        found.append(np.corrcoef(profile[here], template[there])[0, 1])
    return np.array(found)


def bank_of(*values):
    left = jnp.linspace(4.0, -4.0, 81)
    return jax.vmap(lambda v: ralph.Template(v, jnp.ones(81, bool), left))(jnp.stack([jnp.asarray(v) for v in values]))


def test_match_is_pearsons_correlation():
    rng = np.random.default_rng(0)
    values = [np.convolve(rng.normal(size=89), np.ones(9) / 9, "valid") for _ in range(2)]
    profile = ralph.Profile(jnp.asarray(np.roll(values[1], 7), jnp.float32), jnp.ones(81, bool))
    bank = bank_of(*[v.astype(np.float32) for v in values])
    found = ralph.match_profile(profile, bank, reach=2.0)
    inside = np.abs(np.arange(-40, 41)) <= 20
    for row, value in zip(np.array(found.correlations), values, strict=True):
        expected = numpy_correlations(np.array(profile.values, np.float64), value, 40)
        np.testing.assert_allclose(row[inside], expected[inside], atol=1e-4)
    assert int(found.which) == 1, "K-41: the right road of the bank"
    assert float(found.offset) == pytest.approx(0.7, abs=0.06)


@pytest.mark.slow
def test_a_profile_that_repeats_itself_is_ambiguous():
    """K-40: the confidence of a periodic profile is none, that of a single mark is high."""
    left = np.linspace(4.0, -4.0, 81)
    periodic, single = np.cos(2 * np.pi * left / 1.0), np.exp(-20.0 * left**2)
    for values, low, high in ((periodic, 0.0, 0.1), (single, 0.5, 1.0)):
        profile = ralph.Profile(jnp.asarray(values, jnp.float32), jnp.ones(81, bool))
        confidence = float(ralph.match_profile(profile, bank_of(values.astype(np.float32))).confidence())
        assert low <= confidence <= high
    grid = GroundGrid.for_speed(15.0)
    stripes = 100.0 + 50.0 * jnp.cos(2 * jnp.pi * grid.left[None, :] / 0.8) * jnp.ones((64, 1))
    view = GroundView(stripes, jnp.ones((64, 128), bool), grid, jnp.array(1.3))
    state = ralph.estimate(view, ralph.capture(view, ralph.LaneFit()))
    assert bool(state.ambiguous) and not bool(state.ok)


@pytest.mark.slow
def test_a_bank_names_the_road(template):
    bank = jax.tree.map(lambda *leaves: jnp.stack(leaves), capture_of(FOREIGN), template)
    state = ralph.estimate(view_of(picture_of(ROAD, (0.3, 0.01, 5e-4), travelled=300.0)), bank)
    assert int(state.template) == 1 and bool(state.ok)


def test_a_saved_template_comes_back(template):
    """K-42: what was saved under a lane is found under that lane; units and marks are where they were painted."""
    left = np.array(template.left)
    brightest = left[np.argmax(np.where((left < 0) & (left > -2.5), np.array(template.values), -9.0))]
    assert brightest == pytest.approx(-1.8, abs=0.08)
    moved = ralph.capture(view_of(picture_of(ROAD, (0.4, 0.02, 1e-3), travelled=5.0)), ralph.LaneFit(0.4, 0.02, 1e-3))
    both = np.array(template.known & moved.known) & (np.abs(left) < 2.4)
    assert np.corrcoef(np.array(template.values)[both], np.array(moved.values)[both])[0, 1] > 0.95


def test_blending_is_a_mean_of_what_is_known():
    """K-43, against the sum written out."""
    old, new = (
        jax.tree.map(lambda leaf, i=i: leaf[i], bank_of(np.sin(np.arange(81.0)), np.cos(np.arange(81.0))))
        for i in (0, 1)
    )
    new = eqx.tree_at(lambda t: t.known, new, jnp.arange(81) < 60)
    mixed = np.where(
        np.arange(81) < 60, 0.75 * np.array(old.values) + 0.25 * np.array(new.values), np.array(old.values)
    )
    expected = (mixed - mixed.mean()) / mixed.std()
    np.testing.assert_allclose(ralph.blend(old, new, jnp.array(0.25)).values, expected, atol=1e-5)


@pytest.mark.slow
def test_batch_is_a_loop_and_jit_is_eager(template):
    views = [view_of(picture_of(ROAD, t, travelled=s)) for t, s in zip(*truths(3), strict=True)]
    together = jax.vmap(ralph.estimate, in_axes=(0, None))(jax.tree.map(lambda *v: jnp.stack(v), *views), template)
    for index, view in enumerate(views):
        alone = ralph.estimate(view, template)
        np.testing.assert_allclose(together.offset[index], alone.offset, atol=2e-4)
        np.testing.assert_allclose(together.curvature[index], alone.curvature, atol=2e-6)


@pytest.mark.slow
def test_gradient_by_picture_and_pitch(x64, template):
    """The derivative of a minimum: against a second solution of a changed problem, solved as far as float64 goes."""
    # Between pixels interpolation has kinks: steps of pitch above 1e-6 rad cross some of them.
    picture = cv2.GaussianBlur(picture_of(ROAD, (0.2, 0.01, 8e-4), travelled=100.0), (0, 0), 1.5)
    picture = jnp.asarray(picture, jnp.float64)
    wide = jax.tree.map(lambda leaf: leaf.astype(jnp.float64) if eqx.is_inexact_array(leaf) else leaf, template)
    made = jax.tree.map(lambda leaf: leaf.astype(jnp.float64), GROUND)
    change = jnp.asarray(np.random.default_rng(2).normal(size=SHAPE))
    exact, grid = jl.solvers.LevenbergMarquardt(rtol=1e-14), GroundGrid.for_speed(jnp.array(15.0))
    start = ralph.LaneFit(*(jnp.asarray(v, jnp.float64) for v in (0.2, 0.01, 8e-4, 0.0)))

    def lane(change_and_pitch):
        amount, pitch = change_and_pitch
        view = inverse_perspective(eqx.tree_at(lambda g: g.pitch, made, pitch), picture + amount * change, grid)
        kernels = (jl.solvers.Huber(20.0), jl.solvers.Quadratic(), jl.solvers.Quadratic())
        problem = ralph.TemplateResidual(view, wide, jnp.array(0.5), jnp.array(0.01), kernels)
        found = jl.solvers.solve(problem, start, solver=exact)
        return jnp.stack([found.value.offset, found.value.heading, found.value.curvature]), found.ok

    at = jnp.array([0.0, 0.03])
    slopes, ok = jax.jit(jax.jacfwd(lane, has_aux=True))(at)
    assert bool(ok)
    solved = jax.jit(lane)
    for argument, step in ((0, 1e-5), (1, 1e-7)):
        slope = (solved(at.at[argument].add(step))[0] - solved(at.at[argument].add(-step))[0]) / (2 * step)
        np.testing.assert_allclose(slopes[:, argument], slope, rtol=2e-4)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["blank", "night", "noise", "nan", "unseen"])
def test_what_shows_no_road_is_not_believed(template, kind):
    rng = np.random.default_rng(0)
    picture = {
        "blank": np.full(SHAPE, 80.0),
        "night": np.abs(rng.normal(size=SHAPE)),
        "noise": rng.uniform(0, 255, SHAPE),
        "nan": np.full(SHAPE, np.nan),
        "unseen": np.full(SHAPE, 80.0),
    }[kind].astype(np.float32)
    made = eqx.tree_at(lambda g: g.pitch, GROUND, jnp.array(-1.0)) if kind == "unseen" else GROUND

    def offset(picture):
        state = ralph.estimate(inverse_perspective(made, picture, GroundGrid.for_speed(15.0)), template)
        return state.offset, state

    slope, state = jax.grad(offset, has_aux=True)(jnp.asarray(picture))
    assert not bool(state.ok)
    assert all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in jax.tree.leaves(state))
    assert bool(jnp.all(jnp.isfinite(slope)))
