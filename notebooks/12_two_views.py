# %% [markdown]
# # 12. Two views
#
# Two images of a scene that does not move tell how the camera moved: **rotation** and the **direction** of the
# translation, five numbers. Its length they cannot tell. Many of the matched points are wrong, so the answer has to be
# found **among false correspondences**; and sometimes there is none, which the estimate must say.

# %%
import os
from functools import partial

import cv2
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from skimage import data

import jaxloc as jl
from jaxloc.features import opencv
from jaxloc.features.match import match
from jaxloc.features.opencv.describe import describe
from jaxloc.features.opencv.detectors import SIFT
from jaxloc.multiview import ConsensusOptions, RelativePose, disparity, estimate_relative_pose
from jaxloc.multiview.epipolar import epipolar_gate, epipolar_lines, fundamental, sampson_distance
from jaxloc.multiview.rectification import rectifying_homographies
from jaxloc.multiview.triangulation import triangulate

FAST = "JAXLOC_FAST" in os.environ
plt.rcParams["figure.dpi"] = 50
np.set_printoptions(precision=3, suppress=True)

# %% [markdown]
# ## A motion among outliers
#
# Points 4 to 40 m away, half a pixel of noise, and a growing share of pairs that mean nothing. Samples of five points
# give essential matrices, all pairs vote, the best are refined on the manifold, where an essential matrix stays one.

# %%
focal, sigma, count = 700.0, 0.5, 300
camera = jl.sensors.Pinhole(focal, focal, 620.0, 188.0)
truth = jl.poses.SE3.exp(jnp.array([0.3, 0.05, 0.95, 0.02, 0.1, 0.01]))


def pictures(key, false, pose=truth):
    keys = jax.random.split(key, 5)
    u = jax.random.uniform(keys[0], (count, 2)) * jnp.array([1240.0, 376.0])
    depth = jax.random.uniform(keys[1], (count, 1), minval=4.0, maxval=40.0)
    ahead = jnp.concatenate([camera.normalize(u), jnp.ones((count, 1))], axis=1) * depth
    second = camera.project(pose.inverse().apply(ahead))
    wild = jax.random.uniform(keys[2], (count, 2)) * jnp.array([1240.0, 376.0])
    second = jnp.where(jnp.arange(count)[:, None] < false * count, wild, second)
    return u + sigma * jax.random.normal(keys[3], u.shape), second + sigma * jax.random.normal(keys[4], u.shape)


@partial(jax.jit, static_argnums=3)
def solve(first, second, keys, hypotheses=128):
    def one(first, second, key):
        rays = camera.normalize(first), camera.normalize(second)
        return estimate_relative_pose(
            *rays, sigma=sigma / focal, key=key, consensus=ConsensusOptions(hypotheses=hypotheses)
        )

    return jax.vmap(one)(first, second, keys)


trials = 10 if FAST else 40
keys = jax.random.split(jax.random.key(0), trials)
goal = RelativePose.of(truth)
for false, hypotheses in ((0.0, 128), (0.2, 128), (0.4, 128), (0.6, 128), (0.6, 512)):
    seen = jax.vmap(lambda key, false=false: pictures(key, false))(keys)
    found = solve(*seen, keys, hypotheses)
    cosine = found.value.direction.vector @ goal.direction.vector
    off = jnp.degrees(jnp.arccos(jnp.clip(cosine, -1.0, 1.0)))
    told = jnp.degrees(jnp.sqrt(jnp.trace(found.covariance[:, :2, :2], axis1=1, axis2=2)))
    print(
        f"{false:.0%} wrong: off by {jnp.median(off):.3f} deg, said {jnp.median(told):.3f}, ok {jnp.mean(found.ok):.0%}"
    )

# %% [markdown]
# With 60 % of the pairs wrong, one sample of five in a hundred is clean: 128 hypotheses are too few, and the estimate
# says so. With 512 it is found.
#
# A camera that only turns has no direction to tell. Its images fit any number of essential matrices, and a solver
# that returns one of them lies. Here the best rotation is tried as well: where it explains what the translation would,
# the answer is refused.

# %%
turn = jl.poses.SE3(truth.rotation, jnp.zeros(3))
still = solve(*jax.vmap(lambda key: pictures(key, 0.2, turn))(keys), keys)
print(f"a camera that turns: ok {jnp.mean(still.ok):.0%}")

# %% [markdown]
# ## A real pair
#
# The motorcycle of Middlebury: a camera was moved 193 mm sideways without turning, which we do not tell the solver.

# %%
*colors, true_disparity = data.stereo_motorcycle()
bytes_left, bytes_right = (cv2.cvtColor(color, cv2.COLOR_RGB2GRAY) for color in colors)
left, right = (jnp.asarray(gray, jnp.float32) for gray in (bytes_left, bytes_right))
cameras = [jl.sensors.Pinhole(994.978, 994.978, cx, 254.877) for cx in (311.193, 342.279)]
found = [opencv.detect(SIFT(), gray, 1500) for gray in (bytes_left, bytes_right)]
words = [describe(SIFT(), gray, keypoints) for gray, keypoints in zip((bytes_left, bytes_right), found, strict=True)]
pairs = match(*words, ratio=0.85)
first, second = found[0].uv, found[1].uv[pairs.index]
normalized = [lens.normalize(p) for lens, p in zip(cameras, (first, second), strict=True)]
fit = estimate_relative_pose(*normalized, sigma=0.7 / 995.0, key=jax.random.key(1), valid=pairs.valid)
matrix = fundamental(fit.value.essential(), *cameras)
inliers = pairs.valid & (jnp.abs(sampson_distance(matrix, first, second)) < 2.0)
print(f"{int(pairs.valid.sum())} matches, {int(inliers.sum())} agree, ok {bool(fit.ok)}")
print("direction", np.asarray(fit.value.direction.vector), "rotation", np.degrees(fit.value.rotation.log()), "deg")

# %%
fig, axes = plt.subplots(1, 2, figsize=(11, 4))
few = np.flatnonzero(inliers)[:: max(1, int(inliers.sum()) // 12)][:20]
for axis, image, points, partner, F in (
    (axes[0], left, first, second, matrix),
    (axes[1], right, second, first, matrix.T),
):
    axis.imshow(image, cmap="gray")
    lines = np.asarray(epipolar_lines(F, partner[few]))
    for (a, b, c), color in zip(lines, plt.cm.tab20.colors, strict=False):
        ends = np.array([0.0, image.shape[1] - 1.0])
        axis.plot(ends, -(a * ends + c) / b, color=color, lw=0.8)
    axis.scatter(*np.asarray(points[few]).T, c=plt.cm.tab20.colors[: len(few)], s=18)
    axis.set_xlim(0, image.shape[1] - 1), axis.set_ylim(image.shape[0] - 1, 0), axis.axis("off")
plt.tight_layout()
plt.show()

# %% [markdown]
# With known motion more matches are found: the ratio test ignores candidates off the epipolar line, and passes
# pairs that it refused before.

# %%
guided = match(*words, gate=epipolar_gate(matrix, found[0].uv, found[1].uv, band=2.0), ratio=0.85)
print(f"matched blindly {int(inliers.sum())}, along epipolar lines {int(guided.valid.sum())}")

# %% [markdown]
# ## Points
#
# Two rays meet in a point; its covariance is long in depth and short across. With the baseline known the scale is, too.

# %%
baseline = 0.193
stack = jax.tree.map(lambda *leaves: jnp.stack(leaves), jl.poses.SE3.identity(), fit.value.pose(baseline))
both = jnp.stack([cameras[0].normalize(first), cameras[1].normalize(second)], axis=1)
unit = jl.sensors.Pinhole(1.0, 1.0, 0.0, 0.0)
points = jax.jit(jax.vmap(lambda seen: triangulate(unit, stack, seen, sigma=0.7 / 995.0)))(both)
column, row = np.round(np.asarray(first)).astype(int).T
true = true_disparity[np.clip(row, 0, 499), np.clip(column, 0, 740)]
depth = 994.978 * baseline / (true + 31.086)
usable = np.asarray(inliers & points.ok) & np.isfinite(true) & (true > 0)
spread = np.sqrt(np.asarray(points.covariance)[:, 2, 2])
error = np.asarray(points.value)[:, 2] - depth
print(f"{usable.sum()} points, depth off by {100 * np.median(np.abs(error[usable])):.1f} cm in the median, ")
print(f"sigma of depth {100 * np.median(spread[usable]):.1f} cm; it knows the noise of pixels, not that of the pose")

# %% [markdown]
# ## Rows that match, and every pixel
#
# Any pair can be turned so that partners share a row; the motorcycle's nearly do. Then a search along the row gives a
# disparity for every pixel.

# %%
pair = rectifying_homographies(matrix, first, second, shape=left.shape, valid=inliers)
rows = [h.apply(p)[:, 1] for h, p in ((pair.first, first), (pair.second, second))]
print("rows differ by", float(jnp.median(jnp.abs(rows[0] - rows[1])[inliers])), "px, ok", bool(pair.ok))
dense = disparity.match(left, right, matcher=disparity.BlockMatching(disparity.Census(), num_disparities=80))
fine = disparity.refine(left, right, dense)
known = np.asarray(fine.valid) & np.isfinite(true_disparity) & (true_disparity > 0)
off = np.abs(np.asarray(fine.disparity) - true_disparity)[known]
print(f"{known.mean():.0%} of the pixels, {np.mean(off > 2):.1%} off by more than 2 px, median {np.median(off):.2f} px")
plt.figure(figsize=(6, 4))
plt.imshow(np.where(fine.valid, fine.disparity, np.nan), cmap="turbo")
plt.axis("off"), plt.colorbar(label="disparity, px")
plt.show()

# %% [markdown]
# ## Takeaways
#
# - Five numbers, not nine: the essential matrix stays on its manifold, with a covariance in the tangent of
#   (direction, rotation).
# - All hypotheses vote at once, so a batch of image pairs is one `vmap`.
# - Pure rotation, repeated and collinear points are refused by `ok`, not answered at random.
#
# ## Next steps
#
# - The scale comes from stereo, an odometer or known objects: notebooks 3 and 13.
# - Many views of many points: notebook 14.
