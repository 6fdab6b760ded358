"""Degenerate input of one-shot estimators: many lanes of one program, with clean ones among them.

Estimators are the public functions whose result has a flag ``ok``; each needs a `Case` that says how to run it.
"""

import dataclasses
import importlib
import inspect
import re
import typing
from collections.abc import Callable, Mapping

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import degenerate_lanes as shared

LARGEST = shared.LARGEST
NOT_FINITE = {"nan": np.nan, "inf": np.inf, "-inf": -np.inf}
HUGE = {"largest": LARGEST, "1e30": 1e30}
SMALL = {"1e-30": 1e-30, "0": 0.0}


@dataclasses.dataclass(frozen=True)
class Case:
    """How to run an estimator on degenerate input.

    Attributes:
        run: the estimator, of a dictionary of its arrays.
        sets: arrays of items, one a row; ``valid``, a mask of them, is made where `masked` is True.
        images: gray levels.
        sigmas: standard deviations.
        numbers: other parameters, and initial values.
        masked: whether ``run`` reads ``valid``: of the items, or of the pixels of the last image.
        unmasked: sets that ``valid`` does not mask.
        partly: sets of which an item that is not finite is ignored, but more of it is used than where it is masked.
        refused: lanes that must not be ``ok`` beyond those that never may.
        free: lanes that may be ``ok`` nevertheless, for a documented reason.
        left_out: lanes that are not checked, with the reason; patterns of whole names.
    """

    run: Callable
    sets: Mapping = dataclasses.field(default_factory=dict)
    images: Mapping = dataclasses.field(default_factory=dict)
    sigmas: Mapping = dataclasses.field(default_factory=dict)
    numbers: Mapping = dataclasses.field(default_factory=dict)
    masked: bool = True
    unmasked: frozenset | set = frozenset()
    partly: frozenset | set = frozenset()
    refused: frozenset | set = frozenset()
    free: frozenset | set = frozenset()
    left_out: Mapping = dataclasses.field(default_factory=dict)

    def base(self):
        """Arrays of the clean lanes."""
        arrays = {**self.sets, **self.images, **self.sigmas, **self.numbers}
        base = {name: jnp.asarray(value, jnp.float32) for name, value in arrays.items()}
        if self.masked:
            some = list((self.sets or self.images).values())[-1]
            base["valid"] = jnp.ones(np.shape(some)[: 1 if self.sets else 2], bool)
        return base


def estimators(room):
    """Public functions of a room whose result has a flag ``ok``, by module and name."""
    found, modules = {}, [importlib.import_module(f"jaxloc.{room}")]
    while modules:
        module = modules.pop()
        for name in getattr(module, "__all__", None) or vars(module):
            thing = None if name.startswith("_") else getattr(module, name)
            if inspect.ismodule(thing) and thing.__name__.startswith(f"jaxloc.{room}."):
                modules.append(thing)
            home = getattr(thing, "__module__", None) or ""
            if not callable(thing) or inspect.isclass(thing) or not home.startswith(f"jaxloc.{room}"):
                continue
            result = typing.get_type_hints(thing).get("return")
            if (
                inspect.isclass(result)
                and _has_flag(result)
                and (hasattr(module, "__all__") or home == module.__name__)
            ):
                found[f"{home.removeprefix(f'jaxloc.{room}.')}.{thing.__name__}"] = thing
    return found


def _has_flag(record):
    names = {field.name for field in dataclasses.fields(record)} if dataclasses.is_dataclass(record) else set()
    return "ok" in names or "estimate" in names


def check_every_estimator_is_known(room, known):
    """A new estimator needs a recipe of inputs: a `Case` in this file, or a reason why there is none."""
    missing = sorted(set(estimators(room)) - set(known))
    assert not missing, f"no degenerate inputs for {missing}: add a Case for each to tests/{room}/test_*_degenerate.py"
    gone = sorted(set(known) - set(estimators(room)))
    assert not gone, f"{gone} are no public estimators of {room}"


def _spoiled(value, place, number):
    return value.at[place].set(number)


def _line(points):
    """All points moved to a line through the first two, as far apart as they are from the first."""
    along = jnp.linspace(0.0, 1.0, points.shape[0], dtype=points.dtype)
    return points[:1] + along[:, None] * (points[1:2] - points[:1])


def _set_lanes(name, base, masked):
    value = base[name]
    yield from ((f"{name}={key}", {name: jnp.full_like(value, x)}) for key, x in _all_numbers())
    yield f"{name} equal", {name: jnp.broadcast_to(value[:1], value.shape)}
    if value.ndim == 2:
        yield f"{name} on a line", {name: _line(value)}
    yield f"{name}+1e7", {name: value + 1e7}
    yield from ((f"{name}*{key}", {name: value * x}) for key, x in (("1e30", 1e30), ("1e-30", 1e-30)))
    for key, x in {**NOT_FINITE, **HUGE}.items():
        broken = {name: _spoiled(value, 1, x)}
        yield f"{name}[1]={key}", broken
        if masked:
            yield f"{name}[1]={key} masked", broken | {"valid": base["valid"].at[1].set(False)}


def _image_lanes(name, base):
    value = base[name]
    place = tuple(side // 2 for side in value.shape)
    yield from ((f"{name}={key}", {name: jnp.full_like(value, x)}) for key, x in _all_numbers())
    yield f"{name} equal", {name: jnp.full_like(value, 100.0)}
    yield f"{name} stripes", {name: jnp.broadcast_to(value[..., :1, :], value.shape)}
    yield f"{name}+1e7", {name: value + 1e7}
    yield from ((f"{name}*{key}", {name: value * x}) for key, x in (("1e30", 1e30), ("1e-30", 1e-30)))
    yield from ((f"{name}[1]={key}", {name: _spoiled(value, place, x)}) for key, x in {**NOT_FINITE, **HUGE}.items())


def _all_numbers():
    return {**NOT_FINITE, **HUGE, **SMALL}.items()


def lanes_of(case):
    """Names and arrays of all lanes: the clean ones are the first and the last."""
    base = case.base()
    lanes = {"clean": {}}
    if case.masked:
        lanes["all masked"] = {"valid": jnp.zeros_like(base["valid"])}
        lanes["[1] masked"] = {"valid": base["valid"].at[1].set(False)}
    for name in case.sets:
        lanes |= dict(_set_lanes(name, base, case.masked and name not in case.unmasked))
    for name in case.images:
        lanes |= dict(_image_lanes(name, base))
    for name in case.sigmas:
        numbers = [*_all_numbers(), ("-1", -1.0)]
        lanes |= {f"{name}={key}": {name: jnp.full_like(base[name], x)} for key, x in numbers}
    for name in case.numbers:
        numbers = [*_all_numbers(), ("-1", -1.0), ("1e7", 1e7)]
        lanes |= {f"{name}={key}": {name: jnp.full_like(base[name], x)} for key, x in numbers}
    lanes["clean again"] = {}
    return {name: base | lane for name, lane in lanes.items()}


def refused(case):
    """Lanes that may never be ok: nothing finite, nothing valid, points of one place, no standard deviation."""
    names = {"all masked"} if case.masked else set()
    for name in (*case.sets, *case.images):
        names |= {f"{name}={key}" for key, _ in _all_numbers()} | {f"{name} equal"}
        if not case.masked and name in case.sets:
            names |= {f"{name}[1]={key}" for key in NOT_FINITE}
    names |= {f"{name} stripes" for name in case.images}
    for name in case.sigmas:
        names |= {f"{name}={key}" for key in (*NOT_FINITE, "0", "-1")}
    for name in case.numbers:
        names |= {f"{name}={key}" for key in NOT_FINITE}
    return (names | set(case.refused)) - set(case.free)


def _program(case):
    def one(parameters):
        floats = {name: value for name, value in parameters.items() if value.dtype != bool}

        def loss(floats):
            result = case.run({**parameters, **floats})
            found = getattr(result, "estimate", result)
            state = getattr(found, "value", found), getattr(found, "covariance", None)
            total = sum(jnp.sum(leaf) for leaf in jax.tree.leaves(state) if eqx.is_inexact_array(leaf))
            # A bundle keeps its data, too.
            kept = [x for name, x in vars(found).items() if name not in ("problem", "structure")]
            kept = eqx.filter(kept, eqx.is_inexact_array)
            return total, (kept, jnp.any(found.ok), jnp.all(found.ok))

        (_, kept), gradients = jax.value_and_grad(loss, has_aux=True)(floats)
        return kept, gradients

    return jax.jit(jax.vmap(one))


def _finite_rows(leaf):
    return np.isfinite(leaf).reshape(leaf.shape[0], -1).all(axis=1)


def problems_of(case, only=None):
    """What is wrong, as "lane: what".

    Args:
        case: the estimator and its inputs.
        only: names of the lanes to run, all by default.
    """
    lanes = {name: lane for name, lane in lanes_of(case).items() if only is None or name in only}
    names = list(lanes)
    (values, some, every), gradients = jax.tree.map(np.asarray, _program(case)(shared.stacked(list(lanes.values()))))
    broken = []
    for what, found in (("values not finite", values), ("gradient not finite", gradients)):
        for leaf in jax.tree.leaves(found):
            broken += [(name, what) for name, good in zip(names, _finite_rows(leaf), strict=True) if not good]
    for leaf in gradients.values():
        # NaN is reported above.
        moving = np.any(np.nan_to_num(leaf).reshape(len(names), -1) != 0.0, axis=1) & ~some
        broken += [(name, "gradient though not ok") for name, there in zip(names, moving, strict=True) if there]
    wrong = refused(case)
    every_name = set(lanes_of(case))
    unknown = (wrong | set(case.free)) - every_name
    unknown |= {pattern for pattern in case.left_out if not any(re.fullmatch(pattern, name) for name in every_name)}
    assert not unknown, f"no such lanes: {sorted(unknown)}"
    broken += [(name, "ok") for i, name in enumerate(names) if name in wrong and some[i]]
    broken += [(name, "not ok") for i, name in enumerate(names) if name.startswith("clean") and not every[i]]
    broken += _differences(case, names, values, some)
    kinds = {}
    for name, what in broken:
        if not any(re.fullmatch(pattern, name) for pattern in case.left_out):
            kinds.setdefault(what, []).append(name)
    return [f"{what}: {', '.join(dict.fromkeys(names))}" for what, names in kinds.items()]


def _differences(case, names, values, some):
    """Lanes that must equal another one: what is masked has no influence, nor what is not finite, unless refused."""
    pairs = [("clean again", "clean")]
    if "[1] masked" in names:
        pairs += [(name, "[1] masked") for name in names if name.endswith(" masked") and "=" in name]
        ignored = [f"{name}[1]={key}" for name in case.sets if name not in case.partly for key in NOT_FINITE]
        pairs += [(name, "[1] masked") for name in ignored if f"{name} masked" in names]
    found = []
    for name, other in pairs:
        a, b = names.index(name), names.index(other)
        if not name.endswith("masked") and not some[a] and name != "clean again":
            continue
        for leaf in jax.tree.leaves(values):
            scale = 1.0 + np.abs(leaf[b]).max(initial=0.0)
            if not np.allclose(leaf[a], leaf[b], rtol=1e-4, atol=1e-5 * scale):
                found.append((name, f"differs from '{other}'"))
    return found


def check(case, only=None):
    """Runs the lanes of an estimator in one program, and checks values, gradients and ``ok``."""
    problems = problems_of(case, only)
    assert not problems, "\n".join(["", *problems])


def make_tests(room, cases, *, quick, lanes, others=()):
    """The tests of a room: every estimator has a case, one estimator in some lanes, and (slow) all in all lanes.

    Args:
        room: its name.
        cases: by estimator.
        quick: the estimator that runs in the quick part of the suite.
        lanes: of it.
        others: estimators that run as part of others.
    """

    def test_every_estimator_is_here():
        check_every_estimator_is_known(room, {*cases, *others})

    def test_some_lanes():
        check(cases[quick], lanes)

    @pytest.mark.slow
    @pytest.mark.parametrize("name", cases)
    def test_estimators(name):
        check(cases[name])

    return test_every_estimator_is_here, test_some_lanes, test_estimators
