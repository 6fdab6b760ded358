"""Every SLAM filter and the pose graph with degenerate numbers: states and gradients are finite, `ok` shows it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import degenerate_lanes as lanes
import jaxloc as jl
from jaxloc import _tree as tree
from jaxloc.slam import fast_slam, pose_graph

SE2, SO2 = jl.poses.SE2, jl.poses.SO2


def motion(p):
    return jl.sensors.IncrementMotion(turn_drive=p["noise"])


def particles(p, proposal):
    return jl.slam.FastSlam(motion(p), *p["deviations"], num_particles=8, capacity=3, proposal=proposal)


SLAM = {
    "EkfSlam": lambda p: jl.slam.EkfSlam(motion(p), *p["deviations"], capacity=3),
    "FastSlam": lambda p: particles(p, fast_slam.MotionProposal()),
    "FastSlam, version 2": lambda p: particles(p, fast_slam.MeasurementProposal()),
    "FastSlam, blocks": lambda p: particles(p, fast_slam.BlockProposal(1)),
    "DescriptorFastSlam": lambda p: jl.slam.DescriptorFastSlam(
        particles(p, fast_slam.MotionProposal()), fast_slam.Appearance(0.1), length=2
    ),
}
BASE = {
    "mean": jnp.array([1.0, 2.0]),
    "cov": 0.01 * jnp.eye(3),
    "noise": jnp.array(0.02),
    "deviations": jnp.array([0.1, 0.03]),
    "dt": jnp.array(1.0),
    "moved": jnp.array([0.1, 0.0]),
    "z": jnp.array([3.0, 0.995, 0.1]),
    "valid": jnp.array(True),
}


def test_every_filter_is_here():
    assert set(lanes.concrete(jl.slam, jl.filters.Filter)) == {name.split(",")[0] for name in SLAM}


@pytest.mark.slow
@pytest.mark.parametrize("name", SLAM)
def test_steps(name):
    def reading(z):
        found = jl.sensors.RangeBearing(z[0], SO2(z[1], z[2]), jnp.array(0))
        return jl.sensors.DescribedReading(found, jnp.array([0.0, 1.0])) if "Descriptor" in name else found

    def step(p):
        slam, keys = SLAM[name](p), jax.random.split(jax.random.key(0), 3)
        state = slam.init(jl.beliefs.Gaussian(SE2.from_parts(SO2.identity(), p["mean"]), p["cov"]))
        state, _ = slam.update(state, reading(BASE["z"]), jnp.array(True), key=keys[0])
        increment = jl.sensors.Increment(p["dt"], SE2.from_parts(SO2.from_angle(0.05), p["moved"]))
        state = slam.predict(state, increment, key=keys[1])
        state, info = slam.update(state, reading(p["z"]), p["valid"], key=keys[2])
        found = state.gaussian()
        return (state, info, found.mean, found.covariance), info.ok

    bad = lanes.unusable("mean", "cov", "deviations") | {"cov=-1", "cov indefinite"}
    lanes.check_lanes(step, BASE, unsupported=bad, matrices=("cov",))


@pytest.mark.parametrize("name", ["EkfSlam", "FastSlam"])
def test_numbers_that_are_none_are_no_motion_and_no_reading(name):
    slam, keys = SLAM[name](BASE), jax.random.split(jax.random.key(0), 2)
    state = slam.init(jl.beliefs.Gaussian(SE2(1.0, 2.0, 0.3), 1e-4 * jnp.eye(3)))
    broken = jl.sensors.Increment(jnp.array(1.0), SE2(0.1, jnp.nan, 0.05))
    reading = jl.sensors.RangeBearing(jnp.array(jnp.nan), SO2.identity(), jnp.array(0))
    after, info = slam.update(slam.predict(state, broken, key=keys[0]), reading, jnp.array(False), key=keys[1])
    assert bool(info.ok) and bool(tree.all_finite((after, info)))
    np.testing.assert_allclose(after.gaussian().mean.matrix(), state.gaussian().mean.matrix(), atol=1e-6)


def graph_lanes():
    """A loop of four poses with a diagonal; one edge, or the initial value of one pose, is degenerate."""
    motions = jax.vmap(SE2)(jnp.ones(4), jnp.zeros(4), jnp.full(4, 1.6))
    measured = jax.tree.map(lambda a, b: jnp.concatenate([a, b[None]]), motions, SE2(1.0, 1.0, 3.2))
    initial = jl.poses.trajectory.chain(SE2(0.0, 0.0, 0.0), jax.tree.map(lambda leaf: leaf[:3], motions))
    clean = initial, measured, 0.01 * jnp.eye(3)[None].repeat(5, axis=0), jnp.ones(5, bool)
    found = [("clean", clean)]
    for number in lanes.VALUES:
        for where in (0, 2):
            broken = jax.tree.map(lambda leaf, where=where, number=number: leaf.at[where].set(number), initial)
            found.append((f"initial {where} {number:g}", (broken, *clean[1:])))
        for valid in (True, False):
            there = clean[3].at[4].set(valid)
            broken = jax.tree.map(lambda leaf, number=number: leaf.at[4].set(number), measured)
            found.append((f"measured {number:g} {valid}", (initial, broken, clean[2], there)))
            found.append(
                (f"covariance {number:g} {valid}", (initial, measured, clean[2].at[4].multiply(number), there))
            )
            found.append((f"all {number:g} {valid}", (initial, measured, clean[2].at[4].set(number), there)))
    return [*found, ("masked", (*clean[:3], jnp.zeros(5, bool))), ("clean", clean)]


@pytest.mark.slow
def test_pose_graph():
    first, second = jnp.array([0, 1, 2, 3, 0]), jnp.array([1, 2, 3, 0, 2])

    def one(initial, measured, covariance, valid):
        def total(initial, measured, covariance):
            fit = pose_graph.optimize(initial, pose_graph.Edges(first, second, measured, covariance, valid))
            found = (fit.value, fit.covariance, fit.cost, fit.information)
            return sum(jnp.sum(leaf) for leaf in jax.tree.leaves(found)), (found, fit.ok)

        return jax.value_and_grad(total, argnums=(0, 1, 2), has_aux=True)(initial, measured, covariance)

    given = graph_lanes()
    (_, (values, ok)), gradients = jax.jit(jax.vmap(one))(*lanes.stacked([lane for _, lane in given]))
    names = [name for name, _ in given]
    for found in jax.tree.leaves((values, gradients)):
        assert np.isfinite(found).all(), [
            name for name, row in zip(names, found, strict=True) if not np.isfinite(row).all()
        ]
    for name, fine in zip(names, ok, strict=True):
        # A degenerate edge is masked: the loop ties all poses without it.
        assert bool(fine) == (name != "masked" and not name.startswith("initial")), name
    for found in jax.tree.leaves((values, gradients)):
        np.testing.assert_allclose(found[0], found[-1], rtol=1e-5, atol=1e-5)
