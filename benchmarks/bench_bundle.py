"""A bundle of 77 stereo pairs and 15,638 points beside GTSAM: cost, time, memory, covariance; gradients, scaling."""

from collections.abc import Iterator
from pathlib import Path

import gtsam
import jax
import jax.numpy as jnp
import numpy as np

import jaxloc as jl
from benchmarks.metric import ACCURACY, RATIO, REPOSITORY, TIME, Metric, Timing, in_fresh_process, quickest, timed
from jaxloc.data.gtsam_stereo import StereoBundle, read_stereo_factors
from jaxloc.refinement.bundle import Bundle, Observations, Structure, adjust

RECORDING = REPOSITORY.parent / "shared" / "data" / "stereo_vo_factors_gtsam"


def metrics(smoke: bool) -> Iterator[Metric]:
    # Double precision for the whole process, and a peak of memory of its own.
    recorded = RECORDING.is_dir() and not smoke
    figures = in_fresh_process("benchmarks.bench_bundle", "compare", str(RECORDING) if recorded else "")
    yield Metric("bundle.time", 1e3 * figures["time"], "ms", "lower", TIME)
    yield Metric("bundle.compile", figures["compile"], "s")
    yield Metric("bundle.steps", figures["steps"], "steps", "lower", ACCURACY)
    yield Metric("bundle.memory", figures["memory"], "MiB", "lower", ACCURACY)
    yield Metric("bundle.gradient_over_forward", figures["gradient"] / figures["time"], "x", "lower", RATIO)
    yield Metric("bundle.gtsam", 1e3 * figures["gtsam_time"], "ms")
    yield Metric("bundle.vs_gtsam.wall", figures["gtsam_time"] / figures["time"], "x", "higher")
    yield Metric("bundle.vs_gtsam.cpu", figures["gtsam_cpu"] / figures["cpu"], "x", "higher", RATIO)
    yield Metric("bundle.cost_over_gtsam", figures["cost"] / figures["gtsam_cost"], "x", "lower", 1e-6)
    yield Metric("bundle.covariance_off_gtsam", figures["covariance_off"], "share", "lower", None)


def peak_memory() -> float:
    """Greatest resident memory of this process so far, MiB (Linux): `getrusage` counts that of its parent too."""
    status = Path("/proc/self/status").read_text(encoding="ascii")
    return float(status.split("VmHWM:")[1].split()[0]) / 1024


def compare(folder: str) -> dict[str, float]:
    """Both libraries on one bundle; run in a process of its own."""
    jax.config.update("jax_enable_x64", True)
    bundle = read_stereo_factors(Path(folder)) if folder else simulate()
    start, seen = bundle.start, bundle.observations
    size = {"num_cameras": start.poses.batch_shape[0], "num_points": start.points.shape[0]}
    structure = Structure.of(seen.camera, seen.point, **size)
    fit, first = timed(lambda: adjust(bundle.rig, start, seen, structure=structure))
    took = quickest(lambda: adjust(bundle.rig, start, seen, structure=structure), 5)
    covariance = np.asarray(fit.check().pose_covariance(jnp.arange(size["num_cameras"])))
    # Before the peer allocates its own.
    memory = peak_memory()

    @jax.jit
    @jax.grad
    def gradient(measured: jax.Array) -> jax.Array:
        moved = Observations.of(seen.camera, seen.point, measured)
        return jnp.sum(adjust(bundle.rig, start, moved, structure=structure).value.poses.translation[-1])

    figures = {"time": took.wall, "cpu": took.cpu, "compile": first.wall - took.wall, "memory": memory}
    figures |= {"steps": float(fit.num_steps), "cost": float(fit.cost)}
    figures["gradient"] = quickest(lambda: gradient(seen.measured), 3).wall
    return figures | _peer(bundle, covariance)


def _peer(bundle: StereoBundle, covariance: np.ndarray) -> dict[str, float]:
    """GTSAM's Levenberg-Marquardt from the same start with the first pose fixed, and its marginals."""
    graph, values = _graph(bundle)
    times, result = [], values
    for _ in range(3):
        result, took = timed(lambda: gtsam.LevenbergMarquardtOptimizer(graph, values).optimize())
        times.append(took)
    best = Timing(min(time.wall for time in times), min(time.cpu for time in times))
    marginals = gtsam.Marginals(graph, result)
    order = [3, 4, 5, 0, 1, 2]  # GTSAM has rotation before translation
    off = []
    for camera in range(1, len(covariance)):
        other = marginals.marginalCovariance(gtsam.symbol("x", camera))[np.ix_(order, order)]
        scale = np.sqrt(np.diag(other))
        off.append(np.abs((covariance[camera, :, camera] - other) / np.outer(scale, scale)).max())
    found = {"gtsam_time": best.wall, "gtsam_cpu": best.cpu, "gtsam_cost": graph.error(result)}
    return found | {"covariance_off": float(max(off))}


def _graph(bundle: StereoBundle) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    camera, start, seen = bundle.rig.camera, bundle.start, bundle.observations
    numbers = (camera.fx, camera.fy, camera.skew, camera.cx, camera.cy, bundle.rig.baseline)
    calibration = gtsam.Cal3_S2Stereo(*(float(number) for number in numbers))
    noise = gtsam.noiseModel.Isotropic.Sigma(3, 1.0)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for c, p, z in zip(np.asarray(seen.camera), np.asarray(seen.point), np.asarray(seen.measured), strict=True):
        keys = gtsam.symbol("x", int(c)), gtsam.symbol("l", int(p))
        graph.add(gtsam.GenericStereoFactor3D(gtsam.StereoPoint2(*z), noise, *keys, calibration))
    poses = [gtsam.Pose3(matrix) for matrix in np.asarray(jax.vmap(lambda pose: pose.matrix())(start.poses))]
    for number, pose in enumerate(poses):
        values.insert(gtsam.symbol("x", number), pose)
    for number, point in enumerate(np.asarray(start.points)):
        values.insert(gtsam.symbol("l", number), point)
    graph.add(gtsam.NonlinearEqualityPose3(gtsam.symbol("x", 0), poses[0]))
    return graph, values


def simulate(num_cameras: int = 8, num_points: int = 200) -> StereoBundle:
    """A short drive along a street: points ahead, a start that drifts."""
    rng = np.random.default_rng(0)
    rig = jl.sensors.StereoRig(jl.sensors.Pinhole(700.0, 700.0, 600.0, 180.0), 0.5)
    points = rng.uniform([-8.0, -3.0, 6.0], [8.0, 2.0, 30.0], (num_points, 3))
    twists = np.linspace(np.zeros(6), [0.2, 0.0, 5.0, 0.0, 0.05, 0.0], num_cameras)
    truth = Bundle(jax.vmap(jl.poses.SE3.exp)(jnp.asarray(twists)), jnp.asarray(points))
    frames = jax.vmap(lambda pose: pose.inverse().apply(truth.points))(truth.poses)
    pairs = [(c, p) for c in range(num_cameras) for p in range(num_points) if abs(c - p % num_cameras) < 4]
    camera, point = np.array(pairs).T
    measured = rig.project(frames[camera, point]) + jnp.asarray(rng.normal(size=(len(pairs), 3)))
    drift = np.cumsum(rng.normal(size=twists.shape) * [0.02, 0.02, 0.02, 0.002, 0.002, 0.002], axis=0)
    drift -= drift[0]
    start = truth.moved(jnp.asarray(drift), jnp.asarray(0.1 * rng.normal(size=points.shape)))
    return StereoBundle(
        rig, start, Observations.of(camera, point, measured), np.arange(num_cameras), np.arange(num_points)
    )
