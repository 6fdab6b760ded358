import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.poses import SE3
from jaxloc.refinement.bundle import Bundle, Gauge, Observations, Structure, adjust
from jaxloc.refinement.bundle.problem import BundleProblem
from jaxloc.refinement.bundle.schur import Tangent, eliminate, normal_equations
from jaxloc.sensors import Pinhole, StereoRig
from jaxloc.solvers import Cauchy, Status

CAMERAS, POINTS = 3, 8
CAMERA, POINT = (part.ravel().astype(np.int32) for part in np.meshgrid(np.arange(CAMERAS), np.arange(POINTS)))


def camera_at():
    return Pinhole(jnp.asarray(500.0), jnp.asarray(490.0), jnp.asarray(320.0), jnp.asarray(240.0))


def rig_at():
    return StereoRig(camera_at(), jnp.asarray(0.5))


def bundle_and_sights(model, rng):
    points = np.concatenate([rng.uniform(-2.0, 2.0, (POINTS, 2)), rng.uniform(4.0, 9.0, (POINTS, 1))], axis=1)
    twists = jnp.asarray(np.linspace(np.zeros(6), [1.0, 0.2, 0.5, 0.05, -0.1, 0.05], CAMERAS))
    bundle = Bundle(jax.vmap(SE3.exp)(twists), jnp.asarray(points))
    frames = jax.vmap(lambda pose: pose.inverse().apply(bundle.points))(bundle.poses)
    seen = model.project(frames[CAMERA, POINT])
    return bundle, seen + jnp.asarray(0.5 * rng.normal(size=seen.shape))


def tables():
    return Structure.of(CAMERA, POINT, num_cameras=CAMERAS, num_points=POINTS)


def split(vector):
    return Tangent(vector[: 6 * CAMERAS].reshape(-1, 6), vector[6 * CAMERAS :].reshape(-1, 3))


def joined(tangent):
    return jnp.concatenate([tangent.cameras.ravel(), tangent.points.ravel()])


@pytest.mark.slow
def test_exact_hessian_and_its_solution(x64, rng):
    model = rig_at()
    state, measured = bundle_and_sights(model, rng)
    gauge = Gauge.prior(state.poses, 0.01 * jnp.eye(6)[None].repeat(CAMERAS, axis=0), jnp.ones(CAMERAS, bool))
    problem = BundleProblem.of(model, state, Observations.of(CAMERA, POINT, measured), gauge, Cauchy(3.0))
    # Off the anchors, so that their curvature counts.
    state = state.moved(jnp.asarray(0.02 * rng.normal(size=(CAMERAS, 6))), jnp.zeros((POINTS, 3)))

    @jax.jit
    def everything(state, right):
        def along(vector):
            delta = split(vector)
            return problem.cost(state.moved(delta.cameras, delta.points))

        zero = jnp.zeros_like(right)
        expected = jax.value_and_grad(along)(zero), jax.jvp(jax.grad(along), (zero,), (right,))[1]
        cost, gradient, arrow = normal_equations(problem, state, tables(), exact=True)
        _, _, bound = normal_equations(problem, state, tables())
        solved = bound.product(eliminate(bound, tables()).solve(split(right)))
        slope = Tangent(*problem.gradient(state, tables()))
        return expected, (cost, joined(gradient), joined(slope), joined(arrow.product(split(right)))), joined(solved)

    right = jnp.asarray(rng.normal(size=6 * CAMERAS + 3 * POINTS))
    ((cost, gradient), product), found, solved = everything(state, right)
    np.testing.assert_allclose(found[0], cost, rtol=1e-12)
    np.testing.assert_allclose(found[1], gradient, rtol=1e-8, atol=1e-7 * np.abs(gradient).max())
    np.testing.assert_allclose(found[2], found[1], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(found[3], product, rtol=1e-7, atol=1e-9 * np.abs(product).max())
    np.testing.assert_allclose(solved, right, rtol=1e-6, atol=1e-6)


def test_sums_over_ragged_groups(rng):
    point = np.array([2, 0, 2, 2, 2, 2, 0, 2, 2, 2], np.int32)  # more in a group than a row holds, and an empty one
    structure = Structure.of(np.arange(10), point, num_cameras=10, num_points=4)
    rows = rng.normal(size=(10, 3)).astype(np.float32)
    expected = np.zeros((4, 3), np.float32)
    np.add.at(expected, point, rows)
    np.testing.assert_allclose(structure.by_point.sum(jnp.asarray(rows)), expected, atol=1e-5)
    pairs = {(int(a), int(b)) for a, b in zip(structure.first.ravel(), structure.second.ravel(), strict=True) if a < 10}
    assert pairs == {(a, b) for a in range(10) for b in range(a + 1) if point[a] == point[b]}


@pytest.mark.parametrize(
    "camera, point, message",
    [([0, 1], [0], "as many"), ([], [], "at least one"), ([0.0], [0], "integers"), ([0, 9], [0, 1], "are from 0 to 9")],
)
def test_wrong_tables_are_refused(camera, point, message):
    with pytest.raises(ValueError, match=message):
        Structure.of(np.array(camera), np.array(point), num_cameras=3, num_points=3)


def test_wrong_shapes_are_refused(rng):
    state, _ = bundle_and_sights(rig_at(), rng)
    seen = Observations.of(CAMERA, POINT, jnp.zeros((len(CAMERA), 2)))
    with pytest.raises(ValueError, match="2 components, but a StereoRig gives 3"):
        adjust(rig_at(), state, seen)
    with pytest.raises(ValueError, match="gauge is of 5 cameras"):
        adjust(camera_at(), state, seen, gauge=Gauge.fix(5, 0))
    with pytest.raises(ValueError, match="before jit"):
        jax.jit(lambda index: adjust(camera_at(), state, Observations.of(index, POINT, seen.measured)))(CAMERA)


BAD = {
    "clean": ([0, 1], Status.CONVERGED),
    "free gauge": ([], Status.RANK_DEFICIENT),
    "free scale": ([0], Status.RANK_DEFICIENT),
    "camera without sights": ([0, 1], Status.RANK_DEFICIENT),
    "point seen once": ([0, 1], Status.CONVERGED),
    "point seen never": ([0, 1], Status.CONVERGED),
    "nan in a measurement": ([0, 1], Status.CONVERGED),
    "nan in all": ([0, 1], Status.RANK_DEFICIENT),
    "point behind": ([0, 1], Status.INADMISSIBLE),
    "nan in a point": ([0, 1], Status.CONVERGED),
    "nan in a pose": ([0, 1], Status.NONFINITE),
    "no sigma": ([0, 1], Status.CONVERGED),
}


def spoiled(case, state, measured):
    """A bundle of a single camera with one thing wrong."""
    valid, sigma = np.ones(len(CAMERA), bool), np.ones(measured.shape)
    points, places = np.array(state.points), np.array(state.poses.translation)
    measured = np.array(measured)
    if case == "camera without sights":
        valid = CAMERA != 2
    elif case in ("point seen once", "point seen never"):
        valid = (POINT != 3) | ((CAMERA == 1) & (case == "point seen once"))
    elif case == "nan in a measurement":
        measured[5] = np.nan
    elif case == "nan in all":
        measured[:] = np.nan
    elif case == "point behind":
        points[4, 2] = -3.0
    elif case == "nan in a point":
        points[4, 1] = np.nan
    elif case == "nan in a pose":
        places[2, 0] = np.nan
    elif case == "no sigma":
        sigma[7] = 0.0
    return points, places, measured, sigma, valid


@pytest.mark.slow
def test_bad_bundles_are_flagged_and_finite(x64, rng):
    camera = camera_at()
    state, measured = bundle_and_sights(camera, rng)
    structure = tables()

    def answer(places, points, measured, sigma, valid, fixed):
        start = Bundle(jax.vmap(SE3)(state.poses.rotation, places), points)
        seen = Observations.of(CAMERA, POINT, measured, sigma=sigma, valid=valid)
        fit = adjust(camera, start, seen, gauge=Gauge(fixed), structure=structure)
        spread = fit.pose_covariance(jnp.arange(3)), fit.point_covariance(jnp.array([3, 4]))
        finite = jnp.array([jnp.all(jnp.isfinite(leaf)) for leaf in (*jax.tree.leaves(fit.value), fit.cost, *spread)])
        return jnp.sum(fit.value.points) + jnp.sum(fit.value.poses.translation), (fit.status, fit.point_ok, finite)

    run = jax.jit(jax.value_and_grad(answer, argnums=(2, 3), has_aux=True))
    for case, (held, status) in BAD.items():
        points, places, *rest = spoiled(case, state, measured)
        fixed = np.isin(np.arange(CAMERAS), held)
        (_, (came, point_ok, finite)), slopes = run(places, points, *rest, fixed)
        assert Status(int(came)) is status, (case, Status(int(came)))
        assert bool(jnp.all(finite)), case
        assert all(bool(jnp.all(jnp.isfinite(slope))) for slope in slopes), case
        if case.startswith("point seen"):
            assert point_ok.tolist() == [point != 3 for point in range(POINTS)]
        if status is not Status.CONVERGED:
            assert not any(np.any(slope) for slope in slopes), case
