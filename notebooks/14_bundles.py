# %% [markdown]
# # 14. Bundles
#
# Stereo odometry knows each motion well, and its errors add up. Points that are seen from many places tie those places
# together: a bundle moves all cameras and all points until every ray agrees as well as it can. Here a short drive is
# simulated, once with odometry from pair to pair, once as a bundle.

# %%
import os

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import jaxloc as jl
from jaxloc.refinement import refine_motion
from jaxloc.refinement.bundle import Bundle, Gauge, Observations, Structure, adjust

jax.config.update("jax_enable_x64", True)
FAST = "JAXLOC_FAST" in os.environ
plt.rcParams["figure.dpi"] = 70

# %% [markdown]
# ## A drive, and what the rig saw

# %%
rng = np.random.default_rng(1)
cameras, count = (8, 120) if FAST else (14, 300)
sigma = 0.5
rig = jl.sensors.StereoRig(jl.sensors.Pinhole(700.0, 700.0, 600.0, 180.0), 0.5)
step = jl.poses.SE3.exp(jnp.array([0.0, 0.0, 0.8, 0.0, 0.03, 0.0]))
path = [jl.poses.SE3.identity()]
for _ in range(cameras - 1):
    path.append(path[-1] @ step)
truth = jax.tree.map(lambda *leaves: jnp.stack(leaves), *path)
points = jnp.asarray(rng.uniform([-8.0, -3.0, 5.0], [10.0, 2.0, 30.0], (count, 3)))
frames = jax.vmap(lambda pose: pose.inverse().apply(points))(truth)
shown = jax.vmap(rig.project)(frames)
measured = np.asarray(shown) + sigma * rng.normal(size=shown.shape)
inside = (frames[..., 2] > 2.0) & (abs(shown[..., 0] - 600.0) < 600.0) & (abs(shown[..., 2] - 180.0) < 180.0)
inside = np.asarray(inside) & (rng.random(inside.shape) < 0.7)
camera, point = np.nonzero(inside)
print(f"{cameras} stereo pairs, {count} points, {len(camera)} observations")

# %% [markdown]
# ## Odometry: pair after pair

# %%
chain = [jl.poses.SE3.identity()]
for k in range(cameras - 1):
    both = jnp.asarray(inside[k] & inside[k + 1])
    pair = jnp.asarray(measured[k]), jnp.asarray(measured[k + 1])
    chain.append(chain[-1] @ refine_motion(rig, *pair, step, valid=both).value)
odometry = jax.tree.map(lambda *leaves: jnp.stack(leaves), *chain)

# %% [markdown]
# ## The bundle
#
# It starts from odometry, and points from where each was seen first. Index tables are made once; the solver
# eliminates the points, so that what is left is six rows a camera.

# %%
first = np.array([np.argmax(inside[:, p]) for p in range(count)])
local = jax.vmap(rig.triangulate)(jnp.asarray(measured))[first, np.arange(count)]
begin = jnp.einsum("nij,nj->ni", odometry.rotation.rotation_matrix[first], local) + odometry.translation[first]
seen = Observations.of(camera, point, measured[camera, point], sigma=sigma)
structure = Structure.of(camera, point, num_cameras=cameras, num_points=count)
fit = adjust(rig, Bundle(odometry, begin), seen, structure=structure)
print(fit.describe())
for name, poses in (("odometry", odometry), ("bundle", fit.value.poses)):
    off = np.linalg.norm(np.asarray(poses.translation - truth.translation), axis=1)
    print(f"{name}: end of the path off by {100 * off[-1]:.1f} cm, mean {100 * off.mean():.1f} cm")

# %% [markdown]
# ## How sure?
#
# The covariance of a pose has all points and all other poses marginalized. It grows with the distance from the camera
# that is held fixed.

# %%
spread = np.asarray(fit.pose_covariance(jnp.arange(cameras)))
turns = np.asarray(fit.value.poses.rotation.rotation_matrix)
circle = np.stack([np.cos(np.linspace(0, 2 * np.pi, 40)), np.sin(np.linspace(0, 2 * np.pi, 40))])
figure, axis = plt.subplots(figsize=(6, 5))
for name, poses in (("truth", truth), ("odometry", odometry), ("bundle", fit.value.poses)):
    axis.plot(poses.translation[:, 0], poses.translation[:, 2], ".-", lw=0.8, label=name)
for k in range(1, cameras):
    world = turns[k] @ spread[k, :3, k, :3] @ turns[k].T
    root = np.linalg.cholesky(world[np.ix_([0, 2], [0, 2])])
    ring = np.asarray(fit.value.poses.translation)[k, [0, 2], None] + 2.0 * root @ circle
    axis.plot(*ring, color="gray", lw=0.7)
axis.set(xlabel="x, m", ylabel="z, m", title="two sigmas of each pose"), axis.legend()
plt.show()

# %% [markdown]
# ## Freedom of gauge
#
# Rays say how cameras and points lie to each other, not where the whole is. Without anything held the estimate says so.
# Holding another camera moves the uncertainty, not the shape: distances between cameras stay.

# %%
free = adjust(rig, fit.value, seen, gauge=Gauge(jnp.zeros(cameras, bool)), structure=structure)
print("nothing held:", jl.solvers.Status(int(free.status)).name)
last = adjust(rig, fit.value, seen, gauge=Gauge.fix(cameras, cameras - 1), structure=structure)
for name, other in (("first held", fit), ("last held", last)):
    spread = np.asarray(other.pose_covariance(jnp.array([0, cameras - 1])))
    sizes = [100 * np.sqrt(np.trace(spread[k, :3, k, :3])) for k in range(2)]
    ends = other.value.poses.translation
    length = float(jnp.linalg.norm(ends[-1] - ends[0]))
    print(f"{name}: sigma of the first {sizes[0]:.2f} cm, of the last {sizes[1]:.2f} cm, between them {length:.6f} m")

# %% [markdown]
# ## What moves the end of the path?
#
# The answer is differentiable: the derivative of the last position by every pixel costs about as much as the bundle.

# %%


@jax.jit
@jax.grad
def pull(pixels):
    moved = Observations.of(camera, point, pixels, sigma=sigma)
    return adjust(rig, Bundle(odometry, begin), moved, structure=structure).value.poses.translation[-1, 2]


strength = np.linalg.norm(np.asarray(pull(seen.measured)), axis=1)
depth = np.asarray(frames)[camera, point, 2]
plt.figure(figsize=(6, 3))
plt.scatter(depth, 1e3 * strength, c=camera, s=4), plt.colorbar(label="camera")
plt.xlabel("depth of the point, m"), plt.ylabel("mm at the end for a pixel"), plt.yscale("log")
plt.show()

# %% [markdown]
# ## Takeaways
#
# - A bundle uses every sight of a point, odometry only neighboring ones: less drift from the same images.
# - Points are eliminated, so thousands of them cost little more than the cameras alone.
# - Poses are known up to a gauge. A covariance means something only together with what is held.
#
# ## Next steps
#
# `jaxloc.data.gtsam_stereo.read_stereo_factors` reads a recorded bundle; `jaxloc.slam.pose_graph` closes loops where
# points are gone.
