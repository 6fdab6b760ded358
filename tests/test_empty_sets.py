"""No points at all, as in a frame in which a detector found nothing: every public function that takes a set of things.

Functions are found by the annotations of their arguments, so that new ones enter by themselves: each array with a free
axis (named as in `SETS`) gets no items, and each record of such arrays too. Right is ``ok`` False with finite values
or a ValueError that says what is needed.
"""

import dataclasses
import importlib
import inspect
import types
import typing

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxloc as jl

ROOMS = ("poses", "sensors", "solvers", "multiview", "refinement", "alignment", "odometry", "evaluation")
SETS = {"n", "m", "k", "t", "b", "starts", "lengths", "boards", "corners"}
PIXELS = {"h": 24, "w": 24, "h_right": 24, "w_right": 24, "rows": 24, "columns": 24, "p": 3, "q": 3}
# Whose free axis is no set, as the size of a matrix, or whose arguments are made in the tests of their room.
NO_SETS = {
    "poses.matrix_exponential.exponential_less_identity",
    "poses.matrix_exponential.logarithm",
    "sensors.landmarks.row",
    "sensors.laser_scan.scan_like",
    "refinement.pallet.estimate.detect_pallet",
    "refinement.pallet.estimate.find_pallet",
}


def is_array(annotation):
    return hasattr(annotation, "dim_str") and hasattr(annotation, "array_type")


def free_axes(annotation):
    return [name for name in annotation.dim_str.split() if name in SETS]


def hints_of(thing):
    try:
        return typing.get_type_hints(thing)
    except NameError:  # figures, whose library is loaded late
        return {}


def takes_a_set(annotation):
    """Whether an array or a record has an axis without a fixed size."""
    if is_array(annotation):
        return bool(free_axes(annotation))
    if typing.get_args(annotation):
        return any(takes_a_set(option) for option in typing.get_args(annotation))
    if dataclasses.is_dataclass(annotation) and annotation.__module__.startswith("jaxloc"):
        hints = hints_of(annotation)
        return any(takes_a_set(hints.get(field.name)) for field in dataclasses.fields(annotation))
    return annotation in (jl.poses.Trajectory, jl.refinement.correspondences.Correspondences)


def public_functions():
    found = {}
    for room in ROOMS:
        modules = [importlib.import_module(f"jaxloc.{room}")]
        while modules:
            module = modules.pop()
            names = getattr(module, "__all__", None) or [name for name in vars(module) if not name.startswith("_")]
            for name in names:
                thing = getattr(module, name)
                if inspect.ismodule(thing) and thing.__name__.startswith(f"jaxloc.{room}."):
                    modules.append(thing)
                home = getattr(thing, "__module__", None) or ""
                home = home if hasattr(module, "__all__") or home == module.__name__ else ""
                if callable(thing) and not inspect.isclass(thing) and home.startswith(f"jaxloc.{room}"):
                    found[f"{home.removeprefix('jaxloc.')}.{thing.__name__}"] = thing
    return found


FUNCTIONS = {
    name: function
    for name, function in sorted(public_functions().items())
    if any(takes_a_set(hint) for argument, hint in hints_of(function).items() if argument != "return")
    if name not in NO_SETS
}


def identity(kind=None):
    return (kind or jl.poses.SE3).identity()


def no_poses(kind=None):
    return jax.tree.map(lambda leaf: jnp.zeros((0, *leaf.shape), leaf.dtype), identity(kind))


def camera():
    return jl.sensors.Pinhole(500.0, 500.0, 320.0, 240.0)


def points(size=2):
    return jnp.zeros((0, size))


def features():
    return jl.refinement.association.Features(points(2))


def pairs():
    kinds = jl.refinement.correspondences
    return kinds.Correspondences(kinds.PointPoint(points(3), points(3)))


def no_landmarks():
    return jl.sensors.landmarks.RangeBearingSensor(points(2), 0.1, 0.1)


# What annotations cannot say: arguments by function and name, or by name.
SPECIAL = {
    "sensors.landmarks.confusion": dict(sensor=no_landmarks, poses=lambda: no_poses(jl.poses.SE2), limit=lambda: 9.0),
    "refinement.calibration.summary.board_errors": dict(T_camera_board=no_poses),
    "alignment.multi_start.align": dict(
        initial=lambda: jl.alignment.multi_start.translations_around(jnp.zeros(2), spacing=1.0, count=1)
    ),
    "multiview.triangulation.triangulate": dict(poses=no_poses, sigma=lambda: 1.0),
    "multiview.rectification.rectifying_homographies": dict(shape=lambda: (24, 24)),
    "multiview.epipolar.epipolar_gate": dict(band=lambda: 1.0),
    "multiview.epipolar.sampson_components": dict(matrix=lambda: jnp.eye(3)),
    "solvers.ransac.ransac": dict(
        data=lambda: points(2),
        fit=lambda: lambda sample: jnp.mean(sample, axis=0),
        residual=lambda: lambda model, data: jnp.sum((data - model[None]) ** 2, axis=1),
        sample_size=lambda: 1,
        threshold=lambda: 1.0,
        hypotheses=lambda: 8,
    ),
    "refinement.bundle.adjust.adjust": dict(
        initial=lambda: jl.refinement.bundle.Bundle(no_poses(), points(3)),
        observations=lambda: jl.refinement.bundle.Observations.of(
            jnp.zeros(0, int), jnp.zeros(0, int), points(2), sigma=1.0
        ),
        gauge=lambda: None,
    ),
    "refinement.correspondences.refine": dict(correspondences=pairs),
    "refinement.association.associate": dict(observed=features, known=features, sigma=lambda: 1.0),
    "refinement.association.pair_costs": dict(observed=features, known=features, sigma=lambda: 1.0),
    "evaluation.update_rate.simulate_drift": dict(k=lambda: 0.01, way=lambda: 10.0, most=lambda: 4),
    "alignment.correlation.matched_filter.respond": dict(
        noise=lambda: jl.alignment.correlation.WhiteNoise(jnp.array(1.0))
    ),
    "evaluation.consistency.trajectory_nees": dict(covariances=lambda: jnp.zeros((0, 6, 6))),
    "odometry.scene_flow.find_moving": dict(dt=lambda: jnp.array(0.1)),
    "evaluation.targets.mot_metrics.compare": dict(similarity=lambda: jl.evaluation.PointDistance(2.0)),
    "refinement.stereo_motion.motion_problem": dict(loss=lambda: jl.solvers.Quadratic()),
}
NAMED = {
    "sigma": lambda: 1.0,
    "focal": lambda: jnp.array(500.0),
    "cutoff": lambda: 3.0,
    "window": lambda: 2,
    "count": lambda: 2,
    "separation": lambda: 2,
    "camera": camera,
    "model": camera,
    "warp": lambda: jl.images.Translation,
}


def array_of(annotation, sizes):
    """An array of given sizes of named axes: without items, but with pixels, where not given otherwise."""

    # Points of any dimension k.
    sizes = {"k": 3, **sizes} if annotation.dim_str == "n k" else sizes

    def size(name):
        return int(name) if name.isdigit() else sizes.get(name, 0 if name in SETS else PIXELS.get(name, 3))

    shape = tuple(size(name) for name in annotation.dim_str.split() if not name.startswith(("*", ".")))
    kinds = " ".join(str(kind) for kind in annotation.dtypes)
    if "key" in kinds:
        return jax.random.key(0)
    dtype = bool if "bool" in kinds else float if "float" in kinds else np.uint8 if kinds == "uint8" else int
    numbers = np if annotation.array_type is np.ndarray else jnp
    return numbers.eye(shape[0], dtype=dtype) if shape in {(3, 3), (6, 6)} else numbers.ones(shape, dtype)


def value_of(annotation, sizes):
    """Anything of a type: no items, pixels of one gray level, the identity."""
    if is_array(annotation):
        return array_of(annotation, sizes)
    options = [option for option in typing.get_args(annotation) if option is not type(None)]
    if isinstance(annotation, types.UnionType) or typing.get_origin(annotation) is typing.Union:
        return value_of(options[0], sizes)
    if typing.get_origin(annotation) is tuple:
        return tuple(value_of(option, sizes) for option in options)
    simple = {
        jl.poses.SE3: identity,
        jl.poses.SE2: lambda: identity(jl.poses.SE2),
        jl.poses.Group: no_poses,
        jl.sensors.Pinhole: camera,
        jl.sensors.StereoRig: lambda: jl.sensors.StereoRig(camera(), 0.5),
        jl.poses.Trajectory: lambda: jl.poses.Trajectory(jnp.zeros(0), no_poses()),
        jl.beliefs.Gaussian: lambda: jl.beliefs.Gaussian(identity(jl.poses.SE2), jnp.eye(3)),
        jl.solvers.Estimate: lambda: jl.solvers.align_points(jnp.eye(3), jnp.eye(3)),
        int: lambda: 0,
        float: lambda: 1.0,
    }
    if annotation in simple:
        return simple[annotation]()
    hints = hints_of(annotation)
    needed = {
        field.name: value_of(hints[field.name], sizes)
        for field in dataclasses.fields(annotation)
        if field.init and field.default is field.default_factory is dataclasses.MISSING
    }
    return annotation(**needed)


def arguments_of(name, function, **sizes):
    hints, special = hints_of(function), SPECIAL.get(name, {})
    made = {}
    for parameter in inspect.signature(function).parameters.values():
        if parameter.name in special:
            made[parameter.name] = special[parameter.name]()
        elif parameter.default is not inspect.Parameter.empty:
            continue
        elif hints.get(parameter.name, typing.Any) is typing.Any:
            made[parameter.name] = NAMED[parameter.name]()
        elif parameter.name in NAMED and not is_array(hints[parameter.name]):
            made[parameter.name] = NAMED[parameter.name]()
        else:
            made[parameter.name] = value_of(hints[parameter.name], sizes)
    return made


def flags(tree):
    """Every ``ok`` in a result, unless it is one of each item."""
    found = []

    def visit(node):
        if isinstance(node, eqx.Module):
            flag = getattr(node, "ok", None)
            found.extend([flag] if flag is not None and not callable(flag) and np.ndim(flag) == 0 else [])
            for value in vars(node).values():
                visit(value)

    visit(tree)
    return found


RAW = ("zero-size array", "integer modulo", "broadcast", "incompatible shapes", "slice", "gather", "argmin", "argmax")


def check(name, call):
    try:
        found = call()
    except ValueError as error:
        assert not any(part in str(error) for part in RAW), error
        assert len(str(error)) > 20 and "\n" not in str(error).split("-----")[0].strip(), error
        return
    for leaf in jax.tree.leaves(found):
        if eqx.is_inexact_array_like(leaf):
            assert np.isfinite(leaf).all(), (name, found)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_no_items(name):
    given = arguments_of(name, FUNCTIONS[name])
    check(name, lambda: FUNCTIONS[name](**given))


def takes_two_sets(function):
    arrays = [hint for hint in hints_of(function).values() if is_array(hint)]
    return {"n", "m"} <= {axis for hint in arrays for axis in free_axes(hint)}


@pytest.mark.parametrize("few", ["n", "m"])
@pytest.mark.parametrize("name", [name for name, function in FUNCTIONS.items() if takes_two_sets(function)])
def test_only_one_set_is_empty(name, few):
    given = arguments_of(name, FUNCTIONS[name], **{few: 3})
    check(name, lambda: FUNCTIONS[name](**given))


@pytest.mark.parametrize("sizes", [(3, 0), (0, 3)])
def test_a_map_or_a_view_without_features(sizes):
    association = jl.refinement.association
    pose = jl.beliefs.Gaussian(identity(jl.poses.SE2), 0.1 * jnp.eye(3))
    found = association.associate(pose, *(association.Features(jnp.ones((size, 2))) for size in sizes), sigma=0.1)
    np.testing.assert_array_equal(found.columns, np.full(sizes[0], -1))


def takes_pixels(annotation):
    if is_array(annotation):
        return bool({*annotation.dim_str.split()} & {*PIXELS})
    return any(takes_pixels(option) for option in typing.get_args(annotation))


IMAGES = {
    name: function
    for name, function in sorted(public_functions().items())
    if name not in NO_SETS
    if any(takes_pixels(hint) for argument, hint in hints_of(function).items() if argument != "return")
}


@pytest.mark.parametrize("name", IMAGES)
def test_no_pixels(name):
    given = arguments_of(name, IMAGES[name], **dict.fromkeys(PIXELS, 0), **dict.fromkeys(SETS - {"b"}, 3))
    check(name, lambda: IMAGES[name](**given))


def test_functions_are_found():
    assert len(FUNCTIONS) > 50 and len(IMAGES) > 20
    assert {"refinement.pnp.refine_pose", "solvers.point_alignment.align_points"} <= {*FUNCTIONS}


ESTIMATORS = (
    "refinement.pnp.refine_pose",
    "refinement.stereo_motion.refine_motion",
    "refinement.correspondences.refine",
    "refinement.motion_from_flow.motion_from_flow",
    "refinement.motion_from_flow.rotation_from_flow",
    "refinement.motion_from_flow.twist_from_flow",
    "solvers.point_alignment.align_points",
    "solvers.point_alignment.align_scaled_points",
    "multiview.homography.estimate_homography",
    "multiview.two_view.estimate_relative_pose",
    "multiview.triangulation.triangulate",
    "multiview.fundamental_matrix.eight_point",
    "odometry.visual_odometry.estimate_motion",
)


@pytest.mark.parametrize("name", ESTIMATORS)
def test_an_estimate_of_nothing_is_not_ok(name):
    try:
        found = FUNCTIONS[name](**arguments_of(name, FUNCTIONS[name]))
    except ValueError:
        return
    assert flags(found) and not any(bool(flag) for flag in flags(found)), found
