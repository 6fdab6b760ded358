"""Every estimator of the room with degenerate numbers in every input: finite values and gradients, `ok` shows it."""

import jax
import jax.numpy as jnp
import numpy as np

import degenerate_estimates as estimates
import jaxloc as jl
from degenerate_estimates import Case
from jaxloc.poses import SE2

RNG = np.random.default_rng(0)
POINTS = RNG.uniform(-2.0, 2.0, (8, 3))
TRUTH = jl.poses.SE3.exp(jnp.array([1.0, 0.5, -0.3, 0.2, -0.1, 0.4]))
NOISE = 0.01 * RNG.normal(size=(8, 3))
PLANAR = SE2(1.0, 0.5, 0.3)


def landmarks(pose, data):
    world, body, sigma = data
    return (pose.inverse().apply(world) - body).T / sigma


def problem(p, loss):
    return jl.solvers.FunctionProblem(landmarks, (p["world"], p["body"], p["sigma"]), loss)


def start(p):
    return SE2.from_parts(jl.poses.SO2.from_angle(0.2), p["initial"])


def line(sample):
    run = sample[1, 0] - sample[0, 0]
    slope = (sample[1, 1] - sample[0, 1]) / jnp.where(run == 0.0, 1.0, run)
    return slope, sample[0, 1] - slope * sample[0, 0]


def height(model, points):
    return jnp.abs(model[0] * points[:, 0] + model[1] - points[:, 1])


def consensus(p):
    options = dict(sample_size=2, threshold=p["threshold"], hypotheses=16, key=jax.random.key(0), valid=p["valid"])
    return jl.solvers.ransac(p["points"], line, height, **options)


PAIRS = {"source": POINTS, "target": np.asarray(TRUTH.apply(jnp.asarray(POINTS, jnp.float32))) + NOISE}
SEEN = {
    "world": POINTS[:, :2],
    "body": np.asarray(PLANAR.inverse().apply(jnp.asarray(POINTS[:, :2], jnp.float32))) + NOISE[:, :2],
}
# A residual of the user's: its sign is not seen by the solver, nor what it means.
SOLVE = dict(sets=SEEN, sigmas={"sigma": 0.01}, numbers={"initial": np.zeros(2)}, masked=False)
# The covariance does not depend on what is measured.
FREE = {"sigma=-1", "body=1e-30", "body=0", "body equal"}
CASES = {
    "least_squares.solve": Case(
        lambda p: jl.solvers.solve(problem(p, jl.solvers.Quadratic()), start(p)), free=FREE, **SOLVE
    ),
    "graduated_nonconvexity.solve_graduated": Case(
        lambda p: jl.solvers.solve_graduated(problem(p, jl.solvers.GemanMcClure(3.0)), start(p)),
        free=FREE,
        **SOLVE,
    ),
    "point_alignment.align_points": Case(
        lambda p: jl.solvers.align_points(
            p["source"], p["target"], weights=p["weights"], valid=p["valid"], sigma=p["sigma"]
        ),
        sets={**PAIRS, "weights": np.ones(8)},
        sigmas={"sigma": 0.01},
        refused={"source on a line", "target on a line"},
        free={"weights=largest", "weights=1e30", "weights=1e-30", "weights equal"},
        left_out={r"weights[=*]1e-30": "the gradient by sigma overflows"},
    ),
    "point_alignment.align_scaled_points": Case(
        lambda p: jl.solvers.align_scaled_points(p["source"], p["target"], valid=p["valid"], sigma=p["sigma"]),
        sets={name: value[:, :2] for name, value in PAIRS.items()},
        sigmas={"sigma": 0.01},
    ),
    "ransac.ransac": Case(
        consensus,
        sets={"points": np.stack([np.arange(8.0), 2.0 * np.arange(8.0) + 1.0 + NOISE[:, 0]], axis=1)},
        sigmas={"threshold": 0.1},
        left_out={
            r"all masked|points( |=|\*).*|points\[1\]=(largest|1e30)": "the model of an arbitrary sample",
            "threshold=1e-30": "the gradient of the score overflows",
        },
    ),
}
# Some lanes of some estimators in the quick part of the suite.
QUICK = {"clean", "all masked", "[1] masked", "source equal", "source[1]=nan", "clean again"}

test_every_estimator_is_here, test_some_lanes, test_estimators = estimates.make_tests(
    "solvers", CASES, quick="point_alignment.align_points", lanes=QUICK
)
