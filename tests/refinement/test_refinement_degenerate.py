"""Every estimator of the room with degenerate numbers in every input: finite values and gradients, `ok` shows it."""

import jax
import jax.numpy as jnp
import numpy as np

import degenerate_estimates as estimates
import jaxloc as jl
from degenerate_estimates import Case
from jaxloc.poses import SE2, SE3, SO2, SO3
from jaxloc.sensors import Pinhole, StereoRig

R = jl.refinement
pairs = R.correspondences

RNG = np.random.default_rng(0)
POINTS = jnp.asarray(RNG.uniform(-2.0, 2.0, (8, 3)) + [0.0, 0.0, 6.0], jnp.float32)
POSE = SE3.exp(jnp.array([0.2, 0.1, 0.3, 0.05, -0.1, 0.02]))
CAMERA = Pinhole(500.0, 500.0, 320.0, 240.0)
RIG = StereoRig(CAMERA, 0.5)
PLANAR = SE2(1.0, 0.5, 0.3)
BOARD = np.array([[0.1 * x, 0.1 * y, 0.0] for y in range(3) for x in range(4)])
ANGLES = jnp.array([[0.0, 0.3, 0.2], [0.2, -0.4, 0.1], [0.4, 0.1, -0.5], [0.1, -0.2, 0.4]])
RIGHT = SE3.exp(0.1 * jnp.eye(6)[0])


def noise(*shape, scale=0.1):
    return scale * RNG.normal(size=shape)


def camera(focal):
    return Pinhole(focal, focal, jnp.array(320.0), jnp.array(240.0))


def pose(translation):
    return SE3(SO3.identity(), translation)


def rig_motion(p):
    options = dict(covariance_previous=p["noise"], covariance_current=p["noise"], valid=p["valid"])
    return R.refine_motion(
        StereoRig(camera(p["focal"]), 0.5), p["previous"], p["current"], pose(p["initial"]), **options
    )


def points_and_lines(p):
    start = SE2.from_parts(SO2.from_angle(0.2), p["initial"])
    points = pairs.PointPoint(p["source"], p["target"], sigma=p["sigma"], valid=p["valid"])
    lines = pairs.PointLine(p["source"], p["target"], p["along"], sigma=p["sigma"], valid=p["valid"])
    return pairs.refine(pairs.Correspondences(points, lines), start)


def boards(of=SE3.identity()):
    def view(angles):
        placed = SE3.from_euler(jnp.array([-0.2, -0.1, 1.0]), angles[0], angles[1], angles[2])
        return CAMERA.project((of.inverse() @ placed).apply(jnp.asarray(BOARD, jnp.float32)))

    return np.asarray(jax.vmap(view)(ANGLES)) + noise(4, 12, 2, scale=0.05)


def board_mask(p):
    return jnp.broadcast_to(p["valid"][:, None], (4, 12))


def calibration(p):
    kind = R.calibration.Intrinsics(R.calibration.NoLens())
    return R.calibration.calibrate(p["board"], p["corners"], valid=board_mask(p), intrinsics=kind, sigma=p["sigma"])


def stereo_calibration(p):
    kind = R.calibration.Intrinsics(R.calibration.NoLens())
    sides = [R.calibration.Corners(p[name], board_mask(p)) for name in ("left", "right")]
    return R.calibration.calibrate_stereo(p["board"], *sides, intrinsics=kind, sigma=p["sigma"])


CAMERAS, NUMBERS = np.repeat(np.arange(2), 8), np.tile(np.arange(8), 2)
STRUCTURE = R.bundle.Structure.of(CAMERAS, NUMBERS, num_cameras=2, num_points=8)


def bundle(p):
    seen = R.bundle.Observations.of(CAMERAS, NUMBERS, p["measured"], sigma=p["sigma"], valid=p["valid"])
    start = R.bundle.Bundle(jax.vmap(pose)(p["poses"]), p["points"])
    return R.bundle.adjust(StereoRig(camera(p["focal"]), 0.5), start, seen, structure=STRUCTURE)


def both_views():
    views = [RIG.project(place.inverse().apply(POINTS)) for place in (SE3.identity(), POSE)]
    return np.concatenate([np.asarray(view) for view in views]) + noise(16, 3)


def pallet_photo():
    from jaxloc.data.simulate.pallet import PalletScene, render_pallet

    ground = jl.sensors.GroundCamera(Pinhole(300.0, 300.0, 159.5, 79.5), 0.35)
    where = np.array([1.6, 0.1, 0.1])
    return render_pallet(R.pallet.euro_long(), where, ground, shape=(160, 320), scene=PalletScene(), seed=0)


def pallet(p):
    ground = jl.sensors.GroundCamera(Pinhole(p["focal"], p["focal"], jnp.array(159.5), jnp.array(79.5)), p["height"])
    return R.pallet.detect_pallet(p["image"], ground, (R.pallet.euro_long(),), search=R.pallet.PalletSearch(ranges=8))


FLOW_POINTS, DEPTH = RNG.uniform(-0.7, 0.7, (12, 2)), RNG.uniform(2.0, 9.0, 12)


def flow(*twist):
    model = R.interaction_matrix.interaction_matrix(
        jnp.asarray(FLOW_POINTS, jnp.float32), jnp.asarray(DEPTH, jnp.float32)
    )
    return np.asarray(model @ jnp.array(twist)) + noise(12, 2, scale=1e-3)


MOVING, TURNING = flow(0.0, 0.6, 0.8, 0.0, 0.1, 0.0), flow(0.0, 0.0, 0.0, 0.1, 0.2, 0.3)
STEREO = {"previous": np.asarray(RIG.project(POINTS)), "current": np.asarray(RIG.project(POSE.inverse().apply(POINTS)))}
FLAT = RNG.uniform(-2.0, 2.0, (8, 2))
SOURCE = {
    "source": FLAT,
    "target": np.asarray(PLANAR.apply(jnp.asarray(FLAT, jnp.float32))) + noise(8, 2, scale=0.01),
    "along": RNG.normal(size=(8, 2)),
}
BEARINGS = np.asarray(R.pallet.edge_bearings(SE2(2.0, 0.3, 0.2), R.pallet.euro_long().edges(), 800.0))
# A camera at rest, and one that turns.
STILL = {"flow=0", "flow=1e-30", "flow equal"}
CASES = {
    "pnp.refine_pose": Case(
        lambda p: R.refine_pose(
            camera(p["focal"]), p["points"], p["pixels"], pose(p["initial"]), valid=p["valid"], sigma=p["sigma"]
        ),
        sets={"points": POINTS, "pixels": np.asarray(CAMERA.project(POSE.inverse().apply(POINTS))) + noise(8, 2)},
        sigmas={"sigma": 0.5},
        numbers={"initial": np.zeros(3), "focal": 500.0},
        refused={"points on a line"},
        left_out={
            "initial=(largest|1e30)": "the covariance overflows in the shift to the camera",
            r"points\[1\]=1e30": "the gradient overflows",
        },
    ),
    "stereo_motion.refine_motion": Case(
        rig_motion,
        sets={name: value + noise(8, 3) for name, value in STEREO.items()}
        | {"noise": np.tile(0.1 * np.eye(3), (8, 1, 1))},
        numbers={"initial": np.zeros(3), "focal": 500.0},
        refused={"previous on a line"},
        # The points are known from the previous frame.
        free={"current equal", "noise equal"},
    ),
    "correspondences.refine": Case(
        points_and_lines,
        sets=SOURCE,
        sigmas={"sigma": 0.01},
        numbers={"initial": np.zeros(2)},
        # Lines alone are ignored; the points of the source determine the pose.
        partly={"along"},
        free={f"along{what}" for what in ("=nan", "=inf", "=-inf", "=largest", "=1e30", "=1e-30", "=0", " equal")}
        | {"target=1e-30", "target=0", "target equal"},
    ),
    "motion_from_flow.twist_from_flow": Case(
        lambda p: R.motion_from_flow.twist_from_flow(
            p["points"], p["flow"], p["depth"], sigma=p["sigma"], valid=p["valid"]
        ),
        sets={"points": FLOW_POINTS, "flow": MOVING, "depth": DEPTH},
        sigmas={"sigma": 1e-3},
        free={*STILL, "depth equal"},
    ),
    "motion_from_flow.rotation_from_flow": Case(
        lambda p: R.motion_from_flow.rotation_from_flow(p["points"], p["flow"], sigma=p["sigma"], valid=p["valid"]),
        sets={"points": FLOW_POINTS, "flow": TURNING},
        sigmas={"sigma": 1e-3},
        free=STILL,
    ),
    "motion_from_flow.motion_from_flow": Case(
        lambda p: R.motion_from_flow.motion_from_flow(p["points"], p["flow"], sigma=p["sigma"], valid=p["valid"]),
        sets={"points": FLOW_POINTS, "flow": MOVING},
        sigmas={"sigma": 1e-3},
        free={"flow equal"},
    ),
    "pallet.model.pose_from_edges": Case(
        lambda p: R.pallet.pose_from_edges(
            R.pallet.euro_long(), p["bearings"], p["focal"], sigma=p["sigma"], valid=p["valid"]
        ),
        sets={"bearings": BEARINGS},
        sigmas={"sigma": 0.1},
        numbers={"focal": 800.0},
    ),
    "pallet.estimate.detect_pallet": Case(
        pallet, images={"image": pallet_photo()}, numbers={"focal": 300.0, "height": 0.35}, masked=False
    ),
    "calibration.camera.calibrate": Case(
        calibration,
        sets={"board": BOARD, "corners": boards()},
        unmasked={"board"},
        partly={"corners"},
        sigmas={"sigma": 0.05},
        refused={"board on a line"},
    ),
    "calibration.stereo.calibrate_stereo": Case(
        stereo_calibration,
        sets={"board": BOARD, "left": boards(), "right": boards(RIGHT)},
        unmasked={"board"},
        partly={"left", "right"},
        sigmas={"sigma": 0.05},
    ),
    "bundle.adjust.adjust": Case(
        bundle,
        sets={"measured": both_views()},
        sigmas={"sigma": 0.1},
        numbers={"poses": np.stack([np.zeros(3), np.array([0.2, 0.1, 0.3])]), "points": POINTS + 0.1, "focal": 500.0},
    ),
}
# By programs of others: the estimate of `detect_pallet` alone.
OTHERS = {"pallet.estimate.find_pallet"}
QUICK = {"clean", "all masked", "[1] masked", "points equal", "points[1]=nan", "sigma=0", "clean again"}

test_every_estimator_is_here, test_some_lanes, test_estimators = estimates.make_tests(
    "refinement", CASES, quick="motion_from_flow.rotation_from_flow", lanes=QUICK, others=OTHERS
)
