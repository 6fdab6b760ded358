"""Problems without items, by every solver, kernel and linear solver: not ok, finite, and without gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.poses import SE2
from jaxloc.solvers import (
    Dogleg,
    FunctionProblem,
    GaussNewton,
    GemanMcClure,
    Huber,
    LevenbergMarquardt,
    Quadratic,
    solve,
)
from jaxloc.solvers.qr import QR


def residual(pose, data):
    return (pose.apply(data["points"]) - data["seen"]).T / 0.1


def without_items():
    return {"points": jnp.zeros((0, 2)), "seen": jnp.zeros((0, 2))}


@pytest.mark.parametrize("loss", [Quadratic(), Huber(1.5), GemanMcClure(2.0)], ids=lambda loss: type(loss).__name__)
@pytest.mark.parametrize(
    "solver",
    [GaussNewton(), GaussNewton(linear_solver=QR()), LevenbergMarquardt(), Dogleg()],
    ids=lambda s: str(type(s).__name__),
)
def test_nothing_is_not_ok(solver, loss):
    fit = solve(FunctionProblem(residual, without_items(), loss), SE2(1.0, 2.0, 0.5), solver=solver)
    assert not bool(fit.ok) and "unobservable" in fit.describe()
    np.testing.assert_allclose([fit.value.x, fit.value.y, fit.value.theta], [1.0, 2.0, 0.5], rtol=1e-6)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(fit))


def test_no_items_in_one_of_two_blocks():
    """What is there determines the state alone, with the same covariance."""

    def both(pose, data):
        return residual(pose, data), residual(pose, without_items())

    truth, points = SE2(1.0, 2.0, 0.5), jnp.array([[0.0, 1.0], [2.0, 1.0], [1.0, 3.0]])
    data = {"points": points, "seen": truth.apply(points)}
    alone, beside = (solve(FunctionProblem(f, data), SE2(0.0, 0.0, 0.0)) for f in (residual, both))
    assert bool(beside.ok)
    np.testing.assert_allclose(beside.covariance, alone.covariance, rtol=1e-5)
