"""Every estimator of the room with degenerate numbers in every input: finite values and gradients, `ok` shows it."""

import jax
import jax.numpy as jnp
import numpy as np

import degenerate_estimates as estimates
import jaxloc as jl
from degenerate_estimates import Case
from jaxloc.poses import SE3, SO3
from jaxloc.sensors import Pinhole

M = jl.multiview

RNG = np.random.default_rng(0)
POINTS = jnp.asarray(RNG.uniform(-2.0, 2.0, (16, 3)) + [0.0, 0.0, 6.0], jnp.float32)
POSE = SE3.exp(jnp.array([0.6, 0.1, 0.3, 0.05, -0.1, 0.02]))
CAMERA = Pinhole(500.0, 500.0, 320.0, 240.0)
NOISE = 0.1 * RNG.normal(size=(16, 2))
PAIRS = {
    "first": np.asarray(CAMERA.project(POINTS)),
    "second": np.asarray(CAMERA.project(POSE.inverse().apply(POINTS))) + NOISE,
}
RAYS = {name: (value - [320.0, 240.0]) / 500.0 for name, value in PAIRS.items()}
PLANE = {"first": PAIRS["first"], "second": 1.1 * PAIRS["first"] + [20.0, -5.0] + NOISE}
CENTERS = np.array([[0.0, 0.0, 0.0], [1.0, 0.1, 0.0], [2.0, -0.1, 0.2], [1.0, 1.0, 0.1]])
POINT = np.array([1.0, 0.2, 5.0])


def seen(centers):
    return np.stack([np.asarray(CAMERA.project(jnp.asarray(POINT - c, jnp.float32)[None])[0]) for c in centers])


def stack(translations):
    return jax.vmap(lambda place: SE3(SO3.identity(), place))(translations)


def camera(focal):
    return Pinhole(focal, focal, jnp.array(320.0), jnp.array(240.0))


def relative(p):
    light = M.ConsensusOptions(hypotheses=16, pretest=16, finalists=2, refined=1)
    options = dict(sigma=p["sigma"], valid=p["valid"], key=jax.random.key(0), consensus=light)
    return M.estimate_relative_pose(p["first"], p["second"], **options)


def homography(p):
    options = dict(sigma=p["sigma"], valid=p["valid"], key=jax.random.key(0), hypotheses=16)
    return M.estimate_homography(p["first"], p["second"], **options)


def fundamental():
    return np.asarray(M.epipolar.fundamental(M.RelativePose.of(POSE).essential(), CAMERA, CAMERA))


CASES = {
    "triangulation.triangulate": Case(
        lambda p: M.triangulation.triangulate(
            camera(p["focal"]), stack(p["centers"]), p["pixels"], sigma=p["sigma"], valid=p["valid"]
        ),
        sets={"centers": CENTERS, "pixels": seen(CENTERS)},
        sigmas={"sigma": 0.5},
        numbers={"focal": 500.0},
    ),
    "two_view.estimate_relative_pose": Case(
        relative, sets=RAYS, sigmas={"sigma": 0.001}, refused={"first on a line", "second on a line"}
    ),
    "homography.estimate_homography": Case(
        homography,
        sets=PLANE,
        sigmas={"sigma": 0.5},
        refused={"first on a line", "second on a line"},
        left_out={
            r"second\[1\]=1e30": "the gradient overflows",
            "sigma=-1": "a sigma that is not positive is not refused",
        },
    ),
    "fundamental_matrix.eight_point": Case(
        lambda p: M.fundamental_matrix.eight_point(p["first"], p["second"], weights=p["weights"], valid=p["valid"]),
        sets={**PAIRS, "weights": np.ones(16)},
        refused={"first on a line", "second on a line"},
        # Weights are relative.
        free={"weights=largest", "weights=1e30", "weights=1e-30", "weights equal"},
    ),
    "rectification.rectify": Case(
        lambda p: M.rectification.rectify(
            camera(p["focal"]), camera(jnp.array(480.0)), SE3(POSE.rotation, p["baseline"]), shape=(480, 640)
        ),
        numbers={"baseline": np.array([0.6, 0.1, 0.1]), "focal": 500.0},
        masked=False,
    ),
    "rectification.rectifying_homographies": Case(
        lambda p: M.rectification.rectifying_homographies(
            p["matrix"], p["first"], p["second"], shape=(480, 640), valid=p["valid"]
        ),
        sets=PAIRS,
        numbers={"matrix": fundamental()},
        # The points of the first image choose no more than a shear.
        free={f"{name}{what}" for name in PAIRS for what in ("=0", "=1e-30", " equal")},
    ),
}
QUICK = {"clean", "all masked", "[1] masked", "pixels=nan", "pixels[1]=nan", "sigma=0", "centers equal", "clean again"}

test_every_estimator_is_here, test_some_lanes, test_estimators = estimates.make_tests(
    "multiview", CASES, quick="triangulation.triangulate", lanes=QUICK
)
