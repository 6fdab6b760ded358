"""Robust kernels with 30 % outliers: steps, share of lanes that converge, accuracy; gradients against differences."""

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import jaxloc as jl
from benchmarks.metric import ACCURACY, TIME, Metric, compiled, in_fresh_process, quickest
from benchmarks.pnp import SIGMA, simulate
from jaxloc.refinement import refine_pose
from jaxloc.solvers import (
    Barron,
    Cauchy,
    Dogleg,
    GaussNewton,
    GemanMcClure,
    Huber,
    LevenbergMarquardt,
    Quadratic,
    Tukey,
)

_OUTLIERS = 0.3


def kernels() -> dict[str, Any]:
    """The kernels by name."""
    return {
        "huber": Huber(),
        "cauchy": Cauchy(),
        "geman_mcclure": GemanMcClure(),
        "tukey": Tukey(),
        "barron": Barron(-2.0, 2.0),
    }


def metrics(smoke: bool) -> Iterator[Metric]:
    yield from _outliers(8 if smoke else 200, 1 if smoke else 5)
    yield from _strategies(8 if smoke else 500, 1 if smoke else 5)
    yield from _gradients(("huber",) if smoke else ("quadratic", "huber", "geman_mcclure"))


def _fit(loss: Any, solver: Any, camera: Any, points: Any, pixels: Any, start: Any) -> jl.solvers.Estimate:
    return refine_pose(camera, points, pixels, start, loss=loss, sigma=SIGMA, solver=solver)


def _outliers(count: int, repeats: int) -> Iterator[Metric]:
    """Every kernel from a start that plain least squares finds good, in float32."""
    problems = simulate(count, outliers=_OUTLIERS, seed=1)
    # As after a consensus search: some 1 cm and 0.1 degrees off.
    rng = np.random.default_rng(2)
    nudge = jnp.asarray(rng.normal(size=(count, 6)) * np.array([0.01] * 3 + [0.0015] * 3), jnp.float32)
    points, pixels, _ = problems.arrays()
    start = jax.vmap(jl.poses.retract)(problems.truths(), nudge)
    arguments = (problems.camera, points, pixels, start)
    for name, kernel in kernels().items():
        function = jax.vmap(partial(_fit, kernel, LevenbergMarquardt()), in_axes=(None, 0, 0, 0))
        run, _ = compiled(function, *arguments)
        fits = run(*arguments)
        error = np.linalg.norm(np.asarray(fits.value.translation) - problems.truth[:, :3, 3], axis=1)
        key = f"solvers.outliers.{name}"
        yield Metric(f"{key}.steps", float(jnp.mean(fits.num_steps)), "steps", "lower", ACCURACY)
        yield Metric(f"{key}.ok", float(jnp.mean(fits.ok)), "share", "higher", 0.02)
        yield Metric(f"{key}.error", 1000 * float(np.median(error)), "mm", "lower", ACCURACY)
        yield Metric(f"{key}.time", 1e6 * quickest(lambda: run(*arguments), repeats).wall / count, "us", "lower", TIME)  # noqa: B023


def _strategies(count: int, repeats: int) -> Iterator[Metric]:
    """Each strategy on clean data from starts a decimeter and some degrees off."""
    problems = simulate(count, seed=3)
    arguments = (problems.camera, *problems.arrays())
    strategies = {"gauss_newton": GaussNewton(), "levenberg_marquardt": LevenbergMarquardt(), "dogleg": Dogleg()}
    for name, solver in strategies.items():
        run, took = compiled(jax.vmap(partial(_fit, Quadratic(), solver), in_axes=(None, 0, 0, 0)), *arguments)
        fits, key = run(*arguments), f"solvers.{name}"
        yield Metric(f"{key}.steps", float(jnp.mean(fits.num_steps)), "steps", "lower", ACCURACY)
        yield Metric(f"{key}.ok", float(jnp.mean(fits.ok)), "share", "higher", 0.01)
        yield Metric(f"{key}.time", 1e6 * quickest(lambda: run(*arguments), repeats).wall / count, "us", "lower", TIME)  # noqa: B023
        yield Metric(f"{key}.compile", took.cpu, "CPU s", "lower", TIME)


def _gradients(names: tuple[str, ...]) -> Iterator[Metric]:
    for name in names:
        error = in_fresh_process(__name__, "gradient_error", name, environment={"JAX_ENABLE_X64": "true"})
        yield Metric(f"solvers.gradient_error.{name}", error, "relative", "lower", 10.0)


def gradient_error(name: str) -> float:
    """Largest deviation of implicit gradients from central differences, in float64, as a part of the gradient."""
    kernel = {"quadratic": Quadratic(), **kernels()}[name]
    problems = simulate(1, outliers=0.0 if name == "quadratic" else _OUTLIERS, seed=4)
    points, pixels, _ = jax.tree.map(lambda leaf: leaf[0], problems.arrays())
    truth = jax.tree.map(lambda leaf: leaf[0], problems.truths())

    @jax.jit
    def position(pixels, focal):
        camera = jl.sensors.Pinhole(focal, focal, problems.camera.cx, problems.camera.cy)
        fit = _fit(kernel, LevenbergMarquardt(rtol=1e-15), camera, points, pixels, truth)
        return jnp.sum(fit.value.translation * jnp.array([1.0, -2.0, 3.0]))

    by_pixels, by_focal = jax.jit(jax.grad(position, argnums=(0, 1)))(pixels, problems.camera.fx)
    numeric = []
    for item in range(5):
        nudge = jnp.zeros_like(pixels).at[item, 0].set(1.0)
        numeric.append(_slope(lambda h, nudge=nudge: position(pixels + h * nudge, problems.camera.fx)))
    focal = _slope(lambda h: position(pixels, problems.camera.fx + h))
    pairs = [(np.asarray(by_pixels[:5, 0]), np.array(numeric)), (np.asarray(by_focal), focal)]
    return max(float(np.abs(ours - theirs).max() / np.abs(theirs).max()) for ours, theirs in pairs)


def _slope(function: Callable[[float], Array], step: float = 1e-3) -> float:
    """Central difference of fourth order."""
    near, far = (float(function(h) - function(-h)) for h in (step, 2.0 * step))
    return (8.0 * near - far) / (12.0 * step)
