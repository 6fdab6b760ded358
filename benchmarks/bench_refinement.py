"""Camera poses from 50 points: a batch beside OpenCV and PoseLib, gradients, latency, compiling, consistency."""

import tempfile
from collections.abc import Callable, Iterator

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import poselib

import jaxloc as jl
from benchmarks.metric import ACCURACY, RATIO, TIME, Metric, Timing, compiled, in_fresh_process, quickest, timed, versus
from benchmarks.pnp import SIGMA, Problems, simulate
from jaxloc.refinement import refine_pose


def metrics(smoke: bool) -> Iterator[Metric]:
    batch, repeats = (16, 1) if smoke else (1000, 10)
    problems = simulate(batch)
    forward = yield from _batch(problems, repeats)
    yield from _gradient(problems, forward, repeats)
    yield from _peers(problems, forward, 1 if smoke else 3)
    yield from _scaling((1, 16) if smoke else (1, 16, 256, 4096), repeats)
    yield from _latency(problems, 1 if smoke else 100)
    yield from _compiling()


def fit(camera: jl.sensors.Pinhole, points: jax.Array, pixels: jax.Array, start: jl.poses.SE3) -> jl.solvers.Estimate:
    """One problem."""
    return refine_pose(camera, points, pixels, start, sigma=SIGMA)


fit_batch = jax.vmap(fit, in_axes=(None, 0, 0, 0))


def total(camera: jl.sensors.Pinhole, points: jax.Array, pixels: jax.Array, start: jl.poses.SE3) -> jax.Array:
    """A number that depends on every pose of a batch."""
    return jnp.sum(fit_batch(camera, points, pixels, start).value.translation)


def _batch(problems: Problems, repeats: int) -> Iterator[Metric]:
    """Time, steps and consistency of the batch; returns the time of one call."""
    arguments = (problems.camera, *problems.arrays())
    run, _ = compiled(fit_batch, *arguments)
    count = len(problems.points)
    took = quickest(lambda: run(*arguments), repeats)
    yield Metric("refinement.batch", 1e6 * took.wall / count, "us", "lower", TIME)
    yield Metric("refinement.batch.cpu", 1e6 * took.cpu / count, "us", "lower", TIME)
    fits = run(*arguments)
    yield Metric("refinement.batch.ok", float(jnp.mean(fits.ok)), "share", "higher", 0.01)
    yield Metric("refinement.batch.steps", float(jnp.mean(fits.num_steps)), "steps", "lower", ACCURACY)
    squared = jax.jit(jax.vmap(lambda f, t: f.gaussian().mahalanobis_squared(t)))(fits, problems.truths())
    # Six degrees of freedom: the mean is 6 and its own standard deviation sqrt(12 / count).
    yield Metric("refinement.batch.nees", float(jnp.mean(squared)), "of 6", "equal", ACCURACY)
    return took


def _gradient(problems: Problems, forward: Timing, repeats: int) -> Iterator[Metric]:
    arguments = (problems.camera, *problems.arrays())
    run, _ = compiled(jax.value_and_grad(total, argnums=(0, 1, 2)), *arguments)
    took = quickest(lambda: run(*arguments), repeats)
    yield Metric("refinement.gradient", 1e6 * took.wall / len(problems.points), "us", "lower", TIME)
    yield Metric("refinement.gradient_over_forward", took.cpu / forward.cpu, "x", "lower", RATIO)


def _peers(problems: Problems, forward: Timing, repeats: int) -> Iterator[Metric]:
    """The same problems from the same starts, one after the other, as these libraries work."""
    count = len(problems.points)
    for name, solve in _peer_solvers(problems).items():
        took = quickest(lambda solve=solve: [solve(index) for index in range(count)] and None, repeats)
        yield Metric(f"refinement.batch.{name}", 1e6 * took.wall / count, "us")
        yield from versus(f"refinement.batch.vs_{name}", forward, took)


def _peer_solvers(problems: Problems) -> dict[str, Callable[[int], object]]:
    """Refinements of OpenCV and PoseLib by index of the problem."""
    points, pixels, matrix = problems.points, problems.pixels, problems.intrinsics()
    inverse = np.linalg.inv(problems.start)
    rotations = [cv2.Rodrigues(pose[:3, :3])[0] for pose in inverse]
    translations = [pose[:3, 3:].copy() for pose in inverse]
    camera = {"model": "PINHOLE", "width": 1200, "height": 400}
    camera["params"] = [matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]]
    starts = []
    for pose in inverse:
        starts.append(poselib.CameraPose())
        starts[-1].R, starts[-1].t = pose[:3, :3], pose[:3, 3]

    def iterative(i: int) -> object:
        start = rotations[i].copy(), translations[i].copy()
        return cv2.solvePnP(points[i], pixels[i], matrix, None, *start, True, cv2.SOLVEPNP_ITERATIVE)

    def refine_lm(i: int) -> object:
        return cv2.solvePnPRefineLM(points[i], pixels[i], matrix, None, rotations[i].copy(), translations[i].copy())

    def refine_absolute(i: int) -> object:
        return poselib.refine_absolute_pose(pixels[i], points[i], starts[i], camera, {})

    return {"cv2_iterative": iterative, "cv2_lm": refine_lm, "poselib": refine_absolute}


def _scaling(sizes: tuple[int, ...], repeats: int) -> Iterator[Metric]:
    for size in sizes:
        problems = simulate(size, seed=size)
        arguments = (problems.camera, *problems.arrays())
        run, _ = compiled(fit_batch, *arguments)
        took = quickest(lambda run=run, arguments=arguments: run(*arguments), repeats)
        yield Metric(f"refinement.scaling.{size}", 1e6 * took.wall / size, "us")


def _latency(problems: Problems, repeats: int) -> Iterator[Metric]:
    """One problem: the function as it is called, and compiled ahead."""
    one = jax.tree.map(lambda leaf: leaf[0], problems.arrays())
    run, _ = compiled(fit, problems.camera, *one)
    yield Metric("refinement.single.called", 1e6 * quickest(lambda: fit(problems.camera, *one), repeats).wall, "us")
    yield Metric("refinement.single.compiled", 1e6 * quickest(lambda: run(problems.camera, *one), repeats).wall, "us")


def _compiling() -> Iterator[Metric]:
    """Processor time of the first call in a fresh process: without a cache, and with a persistent one that is warm."""
    for kind in ("forward", "gradient"):
        off = {"JAX_ENABLE_COMPILATION_CACHE": "false"}
        cold = in_fresh_process(__name__, "first_call_seconds", kind, environment=off)
        with tempfile.TemporaryDirectory() as folder:
            on = {"JAX_COMPILATION_CACHE_DIR": folder, "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
            on["JAX_ENABLE_COMPILATION_CACHE"] = "true"
            warm = [in_fresh_process(__name__, "first_call_seconds", kind, environment=on) for _ in range(2)][1]
        yield Metric(f"refinement.first_call.{kind}", cold, "CPU s", "lower", TIME)
        yield Metric(f"refinement.first_call.{kind}.cached", warm, "CPU s", "lower", TIME)


def first_call_seconds(kind: str) -> float:
    """Processor time of tracing, compiling and running one problem."""
    problems = simulate(1)
    one = jax.tree.map(lambda leaf: leaf[0], problems.arrays())
    function = fit if kind == "forward" else jax.value_and_grad(_depth, argnums=(0, 1, 2))
    jax.block_until_ready(jnp.zeros(()) + 1)  # the backend itself is up
    return timed(lambda: jax.jit(function)(problems.camera, *one))[1].cpu


def _depth(camera: jl.sensors.Pinhole, points: jax.Array, pixels: jax.Array, start: jl.poses.SE3) -> jax.Array:
    return fit(camera, points, pixels, start).value.translation[2]
