"""Poses from features of every kind beside SciPy, pallets in images, and the camera's motion from flow."""

from collections.abc import Iterator

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import least_squares

from benchmarks.metric import ACCURACY, TIME, Metric, compiled, gradient_over_forward, quickest, versus
from jaxloc.data.simulate.pallet import make_camera, render_pallet
from jaxloc.poses import SE2
from jaxloc.refinement.correspondences import (
    Correspondences,
    LineLine,
    PointLine,
    PointPoint,
    PointSegment,
    SegmentSegment,
    refine,
)
from jaxloc.refinement.motion_from_flow import interaction_matrix, motion_from_flow, twist_from_flow
from jaxloc.refinement.pallet import block_narrow, detect_pallet, euro_long, euro_short, find_pallet
from jaxloc.solvers import Estimate

POSE, SIGMA, COUNT = np.array([0.4, -0.3, 0.25]), 0.02, 20
KINDS = ("point_point", "point_line", "point_segment", "segment_segment", "mixed")
CLASSES = {
    "point_point": PointPoint,
    "point_line": PointLine,
    "point_segment": PointSegment,
    "segment_segment": SegmentSegment,
    "line_line": LineLine,
}
TWIST, FLOW_SIGMA, POINTS = np.array([0.3, -0.1, 0.9, 0.05, 0.12, -0.08]), 1e-3, 100


def metrics(smoke: bool) -> Iterator[Metric]:
    batch, repeats = (16, 1) if smoke else (1000, 10)
    for kind in KINDS[-1:] if smoke else KINDS:
        yield from _kind(kind, batch, repeats)
    yield from _pallet(2 if smoke else 12, repeats)
    yield from _flow(batch, repeats)
    yield from _fields_of_view()


def scenes(batch: int, seed: int = 0) -> dict[str, list[np.ndarray]]:
    """What a source at the true pose measures of points, lines and segments, and what they are."""
    rng = np.random.default_rng(seed)
    cos, sin = np.cos(POSE[2]), np.sin(POSE[2])
    rotation = np.array([[cos, -sin], [sin, cos]])
    shape = (batch, COUNT, 2)
    first, second = rng.uniform(-4.0, 4.0, (2, *shape))
    inner, other = (first + rng.uniform(0.1, 0.9, (*shape[:2], 1)) * (second - first) for _ in range(2))
    seen = lambda x: (x - POSE[:2]) @ rotation + SIGMA * rng.normal(size=shape)  # noqa: E731
    angle = rng.uniform(-np.pi, np.pi, shape[:2])
    turned = angle - POSE[2] + SIGMA * rng.normal(size=shape[:2])
    directions = [np.stack([np.cos(a), np.sin(a)], axis=-1) for a in (turned, angle)]
    return {
        "point_point": [seen(first), first],
        "point_line": [seen(inner), first, second - first],
        "point_segment": [seen(inner), first, second],
        "segment_segment": [seen(inner), seen(other), first, second],
        "line_line": directions,
    }


def fit(arrays: dict[str, list[jax.Array]]) -> Estimate:
    """One problem, from a start 0.1 off."""
    pairs = Correspondences(**{kind: CLASSES[kind](*parts, sigma=SIGMA) for kind, parts in arrays.items()})
    return refine(pairs, SE2(*(float(x) + 0.1 for x in POSE)))


def _kind(kind: str, batch: int, repeats: int) -> Iterator[Metric]:
    """Time, consistency and accuracy of one kind, or of all; the same cost in SciPy from the same start."""
    host = scenes(batch)
    host = host if kind == "mixed" else {kind: host[kind]}
    arrays = jax.tree.map(lambda a: jnp.asarray(a, jnp.float32), host)
    run, _ = compiled(jax.vmap(fit), arrays)
    took = quickest(lambda: run(arrays), repeats)
    found = run(arrays)
    truth = SE2(*(float(x) for x in POSE))
    squared = jax.jit(jax.vmap(lambda f: f.gaussian().mahalanobis_squared(truth)))(found)
    key = f"features_to_pose.{kind}"
    yield Metric(key, 1e6 * took.wall / batch, "us", "lower", TIME)
    total = lambda arrays: jnp.sum(jax.vmap(fit)(arrays).value.translation)  # noqa: E731
    yield gradient_over_forward(key, total, (arrays,), took, repeats)
    yield Metric(f"{key}.ok", float(jnp.mean(found.ok)), "share", "higher", 0.01)
    yield Metric(f"{key}.nees", float(jnp.mean(squared)), "of 3", "equal", ACCURACY)
    away = jnp.linalg.norm(found.value.translation - jnp.asarray(POSE[:2], jnp.float32)[None, :], axis=1)
    yield Metric(f"{key}.error", 1e3 * float(jnp.median(away)), "mm", "lower", ACCURACY)
    few = min(batch, 40)
    peer = quickest(lambda: [_scipy(host, index) for index in range(few)] and None, 1)
    per = peer._replace(wall=peer.wall * batch / few, cpu=peer.cpu * batch / few)
    yield Metric(f"{key}.scipy", 1e6 * peer.wall / few, "us")
    yield from versus(f"{key}.vs_scipy", took, per)


def _scipy(host: dict[str, list[np.ndarray]], index: int) -> object:
    """The same residuals by normals, differentiated numerically."""
    arrays = {kind: [part[index] for part in parts] for kind, parts in host.items()}
    normals = {}
    for kind, (base, tip) in {"point_line": (None, 2), "point_segment": (1, 2), "segment_segment": (2, 3)}.items():
        if kind in arrays:
            along = arrays[kind][tip] - (0.0 if base is None else arrays[kind][base])
            normals[kind] = np.stack([-along[:, 1], along[:, 0]], 1) / np.linalg.norm(along, axis=1, keepdims=True)

    def residual(p: np.ndarray) -> np.ndarray:
        rotation = np.array([[np.cos(p[2]), -np.sin(p[2])], [np.sin(p[2]), np.cos(p[2])]])
        out = []
        for kind, a in arrays.items():
            if kind == "point_point":
                out.append((a[0] @ rotation.T + p[:2] - a[1]).ravel())
            elif kind == "line_line":
                turned = a[0] @ rotation.T
                out.append(a[1][:, 0] * turned[:, 1] - a[1][:, 1] * turned[:, 0])
            else:
                ends, anchor = (a[:2], a[2]) if kind == "segment_segment" else (a[:1], a[1])
                out += [np.sum(normals[kind] * (e @ rotation.T + p[:2] - anchor), axis=1) for e in ends]
        return np.concatenate(out) / SIGMA

    return least_squares(residual, POSE + 0.1)


def _pallet(count: int, repeats: int) -> Iterator[Metric]:
    """Error of poses of pallets in images, kinds told, and time an image of 640 x 480."""
    camera, kinds = make_camera(height=0.35), (euro_long(), euro_short(), block_narrow())
    detect = eqx.filter_jit(lambda image: detect_pallet(image, camera, kinds))
    for x in (2.0,) if count < 4 else (1.2, 2.0, 3.0, 4.0):
        rng = np.random.default_rng(int(10 * x))
        away, turned, right = [], [], []
        for index in range(count):
            pose = np.array([x, rng.uniform(-0.1, 0.1) * x, rng.uniform(-0.35, 0.35)])
            image = jnp.asarray(render_pallet(kinds[index % 3], pose, camera, seed=index))
            found = detect(image)
            value = found.estimate.value
            away.append(np.hypot(float(value.x) - pose[0], float(value.y) - pose[1]))
            turned.append(np.degrees(abs(float(value.theta) - pose[2])))
            right.append(bool(found.estimate.ok) and int(found.kind) == index % 3)
        yield Metric(
            f"features_to_pose.pallet.{x:g}m.error", 1e3 * float(np.max(away)), "mm (worst)", "lower", ACCURACY
        )
        yield Metric(f"features_to_pose.pallet.{x:g}m.turn", float(np.max(turned)), "deg (worst)", "lower", ACCURACY)
        yield Metric(f"features_to_pose.pallet.{x:g}m.right", float(np.mean(right)), "share", "higher", 0.01)
    took = quickest(lambda: detect(image), repeats)
    yield Metric("features_to_pose.pallet.three_kinds", 1e3 * took.wall, "ms", "lower", TIME)
    total = lambda image: jnp.sum(detect_pallet(image, camera, kinds).estimate.value.translation)  # noqa: E731
    yield gradient_over_forward("features_to_pose.pallet", total, (image.astype(jnp.float32),), took, repeats)
    if repeats > 1:
        alone = eqx.filter_jit(lambda image: find_pallet(image, camera, kinds[:1]))
        took = quickest(lambda: alone(image), repeats)
        yield Metric("features_to_pose.pallet.one_kind", 1e3 * took.wall, "ms", "lower", TIME)


def _views(batch: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    points, depth = rng.uniform(-0.7, 0.7, (batch, POINTS, 2)), rng.uniform(2.0, 10.0, (batch, POINTS))
    flow = [
        np.asarray(interaction_matrix(jnp.asarray(p), jnp.asarray(d))) @ TWIST
        for p, d in zip(points, depth, strict=True)
    ]
    return points, np.stack(flow) + FLOW_SIGMA * rng.normal(size=points.shape), depth


def _flow(batch: int, repeats: int) -> Iterator[Metric]:
    """Twists with depth beside NumPy's least squares, and motions without."""
    host = _views(batch)
    arrays = [jnp.asarray(a, jnp.float32) for a in host]
    run, _ = compiled(jax.vmap(lambda p, f, d: twist_from_flow(p, f, d, sigma=FLOW_SIGMA)), *arrays)
    took = quickest(lambda: run(*arrays), repeats)
    truth = jnp.asarray(TWIST, jnp.float32)
    squared = jax.vmap(lambda f: f.gaussian().mahalanobis_squared(truth))(run(*arrays))
    yield Metric("features_to_pose.flow.twist", 1e6 * took.wall / batch, "us", "lower", TIME)
    yield Metric("features_to_pose.flow.twist.nees", float(jnp.mean(squared)), "of 6", "equal", ACCURACY)
    matrices = [
        np.asarray(interaction_matrix(*(jnp.asarray(a) for a in pair))) for pair in zip(host[0], host[2], strict=True)
    ]
    rows = [(m.reshape(-1, 6).astype(float), f.reshape(-1)) for m, f in zip(matrices, host[1], strict=True)]
    peer = quickest(lambda: [np.linalg.lstsq(m, f, rcond=None)[0] for m, f in rows] and None, repeats)
    yield Metric("features_to_pose.flow.twist.numpy", 1e6 * peer.wall / batch, "us")
    yield from versus("features_to_pose.flow.twist.vs_numpy", took, peer)
    each = jax.vmap(lambda f, p: motion_from_flow(p, f, sigma=FLOW_SIGMA))
    seen = (arrays[1], arrays[0])
    free, _ = compiled(each, *seen)
    took = quickest(lambda: free(*seen), repeats)
    total = lambda f, p: jnp.sum(each(f, p).value.direction.vector)  # noqa: E731
    yield gradient_over_forward("features_to_pose.flow.motion", total, seen, took, repeats)
    found = free(*seen)
    cosine = found.value.direction.vector @ jnp.asarray(TWIST[:3] / np.linalg.norm(TWIST[:3]), jnp.float32)
    yield Metric("features_to_pose.flow.motion", 1e6 * took.wall / batch, "us", "lower", TIME)
    yield Metric("features_to_pose.flow.motion.ok", float(jnp.mean(found.ok)), "share", "higher", 0.01)
    angle = np.degrees(np.arccos(np.clip(np.asarray(cosine, float), -1.0, 1.0)))
    yield Metric("features_to_pose.flow.motion.direction", float(np.median(angle)), "deg", "lower", ACCURACY)


def _fields_of_view() -> Iterator[Metric]:
    """Condition of the twist before a wall: narrow views take rotation for translation."""
    for degrees in (20, 60, 120):
        rng = np.random.default_rng(1)
        half = np.tan(np.radians(degrees / 2))
        points, depth = jnp.asarray(rng.uniform(-half, half, (200, 2))), jnp.asarray(rng.uniform(4.9, 5.1, 200))
        found = twist_from_flow(points, jnp.zeros_like(points), depth)
        yield Metric(
            f"features_to_pose.flow.condition.{degrees}deg",
            float(found.observability().condition),
            "x",
            "equal",
            ACCURACY,
        )
