# %% [markdown]
# # 11. Mosaics of a floor
#
# A camera that looks straight down sees texture wherever there is a floor. Laid side by side, its images become a
# map; a later drive is localized in that map to a fraction of a millimeter. The images here are synthetic: concrete,
# a lens that bends lines, light that falls off to the corners, an exposure that changes, and odometry that drifts.

# %%
import os

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from jaxloc.data.simulate import floor
from jaxloc.evaluation import update_rate
from jaxloc.pipelines import floor_mosaic

FAST = "JAXLOC_FAST" in os.environ
plt.rcParams["figure.dpi"] = 70

# %%
camera = floor.make_camera((160, 208), height=0.045)
trip = floor.drive_loop(num_frames=20 if FAST else 40, step=0.008, camera=camera)
figure, axes = plt.subplots(1, 3, figsize=(11, 3))
for axis, frame in zip(axes, trip.frames, strict=False):
    axis.imshow(frame, cmap="gray"), axis.set_axis_off()
plt.show()

# %% [markdown]
# ## Making the map
#
# Each image is laid upon its neighbors by Lucas and Kanade's method, from where odometry says it is; where the path
# comes back, images are laid upon those taken there before. A pose graph makes all of it agree, and images are
# blended with little weight at their dark corners.

# %%
built = floor_mosaic.make_mosaic(
    trip.frames, trip.odometry, camera.ground, covariances=trip.covariances, initial=trip.poses[0]
)
pixel = float(built.mosaic.raster.resolution)


def distances(poses):
    return np.linalg.norm(np.asarray(poses)[:, :2] - trip.poses[:, :2], axis=1)


way = np.linalg.norm(np.diff(trip.poses[:, :2], axis=0), axis=1).sum()
print(f"one pixel is {1e3 * pixel:.2f} mm; the path is {way:.2f} m long; images left out: {built.left_out}")
off = [1e3 * error for error in (distances(trip.reckoned())[-1], distances(built.before_closure)[-1])]
print(f"end of the loop off by: odometry {off[0]:.2f} mm, images {off[1]:.4f} mm")
print(f"worst image after closing it: {1e3 * distances(built.poses).max():.4f} mm")
plt.figure(figsize=(6, 4))
plt.imshow(np.where(np.asarray(built.mosaic.known), np.asarray(built.mosaic.values), np.nan), cmap="gray")
plt.axis("off")
plt.show()

# %% [markdown]
# ## How often to look?
#
# Each update adds a random error, so that fewer are better; and one that grows with the square of the distance since
# the last, so that more are better. Between them lies the best spacing.

# %%
noise, slope, length = 1e-3, 2e-2, 20.0
spacing = jnp.geomspace(0.02, 2.0, 60)
total = jax.vmap(lambda d: update_rate.expected_error(d, sigma=noise, k=slope, way=length))(spacing)
best = update_rate.best_spacing(sigma=noise, k=slope, way=length)
plt.loglog(spacing, 1e3 * total), plt.axvline(float(best), color="gray", lw=0.8)
plt.xlabel("way between updates, m"), plt.ylabel("error at the end, mm")
plt.show()

# %% [markdown]
# ## Takeaways
#
# - Images of a floor are worth more than odometry by orders of magnitude, and each comes with its covariance.
# - The slide's Jacobian for features of a mosaic lacks the turn of the second image;
#   `jaxloc.slam.mosaic.feature_jacobian` has it.
# - An image that overlaps no other is left out and named; nothing is made up.
#
# ## Next steps
#
# `jaxloc mosaic FRAMES --odometry FILE --camera CAMERA.yaml` does this to a recording.
