"""Checks of the arguments of public functions by their annotations, at trace time."""

import functools
import inspect
import types
import typing
from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import numpy as np

_Function = TypeVar("_Function", bound=Callable)
_MAKERS = {"SE2": "SE2.from_matrix", "SE3": "SE3.from_matrix", "SO3": "SO3.from_matrix", "SO2": "SO2.from_angle"}


def checked(function: _Function) -> _Function:
    """Makes a function check the shapes of its arrays, and the types of its records, before anything else.

    What is needed is read from the annotations: ``Float[Array, "n 3"]`` is an array of two axes, the second of size
    three, and n is the same in all arguments; a class of jaxloc is an instance of it. Everything else (`Any`, numbers,
    dtypes) is not looked at. Inside `jax.jit` the check runs once, when the function is traced; the axes of `jax.vmap`
    are not seen.

    Args:
        function: annotated; decorate it below `filter_jit` and ``staticmethod``.

    Returns:
        The function, which raises a ValueError for a wrong shape and a TypeError for something else than an array or
        than the record that is needed.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> jl.poses.SE3.identity().apply(jnp.zeros(2))
        Traceback (most recent call last):
        ...
        ValueError: SE3.apply: points has shape (2,), but (n, 3) is needed.
    """
    names = [*inspect.signature(function).parameters]
    rules: dict[str, list] = {}
    known = []

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        if not known:
            # At the first call, when all classes of the module exist.
            rules.update(_rules(function, names))
            known.append(True)
        sizes: dict[str, int] = {}
        for name, value in zip(names, args, strict=False):
            if name in rules:
                _check(function, name, value, rules[name], sizes)
        for name, value in kwargs.items():
            if name in rules:
                _check(function, name, value, rules[name], sizes)
        return function(*args, **kwargs)

    return typing.cast(_Function, call)


def _rules(function: Callable, names: list[str]) -> dict[str, list]:
    """What each argument may be: axes of arrays, classes, None; arguments without a rule are left out."""
    try:
        hints = typing.get_type_hints(function)
    except NameError:  # annotations for type checkers only
        return {}
    found = {}
    for name in names:
        hint = hints.get(name, Any)
        options = typing.get_args(hint) if _is_union(hint) else (hint,)
        parts = [_rule(option) for option in options]
        if all(part is not None for part in parts):
            found[name] = parts
    return found


def _is_union(hint: Any) -> bool:
    return isinstance(hint, types.UnionType) or typing.get_origin(hint) is typing.Union


def _rule(option: Any) -> Any:
    """Axes of an array, a class, or None for what is not checked."""
    text = getattr(option, "dim_str", None)
    if text is not None:
        axes = tuple(axis.split("=")[-1].lstrip("#?") for axis in text.split())
        plain = all(axis.lstrip("*_").isidentifier() or axis.isdigit() or axis in {"_", "..."} for axis in axes)
        return axes if plain and sum(axis[0] in "*." for axis in axes) <= 1 else None
    if option is type(None) or (inspect.isclass(option) and issubclass(option, eqx.Module)):
        return option
    return None


def _check(function: Callable, name: str, value: Any, options: list, sizes: dict[str, int]) -> None:
    for option in options:
        if isinstance(option, tuple):
            if not isinstance(value, eqx.Module) and value is not None and _fits(_shape(value), option, sizes):
                return
        elif isinstance(value, option):
            return
    _refuse(function, name, value, options, sizes)


def _shape(value: Any) -> tuple[int, ...] | None:
    shape = getattr(value, "shape", None)
    if shape is not None:
        return tuple(shape)
    return np.shape(value) if isinstance(value, int | float | complex | list | tuple) else None


def _fits(shape: tuple[int, ...] | None, axes: tuple[str, ...], sizes: dict[str, int]) -> bool:
    """Whether a shape has these axes; notes the sizes of the named ones if it has."""
    if shape is None:
        return False
    several = [place for place, axis in enumerate(axes) if axis[0] in "*."]
    if several:
        behind = len(axes) - several[0] - 1
        if len(shape) < len(axes) - 1:
            return False
        shape = shape[: several[0]] + shape[len(shape) - behind :]
        axes = axes[: several[0]] + axes[several[0] + 1 :]
    if len(shape) != len(axes):
        return False
    bound = dict(sizes)
    for size, axis in zip(shape, axes, strict=True):
        wanted = int(axis) if axis.isdigit() else size if axis[0] == "_" else bound.setdefault(axis, size)
        if size != wanted:
            return False
    sizes.update(bound)
    return True


def _refuse(function: Callable, name: str, value: Any, options: list, sizes: dict[str, int]) -> None:
    where = f"{function.__qualname__}: {name}"
    arrays = [option for option in options if isinstance(option, tuple)]
    classes = [option.__name__ for option in options if inspect.isclass(option) and option is not type(None)]
    shape = None if isinstance(value, eqx.Module) else _shape(value)
    if shape is not None and arrays:
        needed = " or ".join(f"({', '.join(axes)}{',' * (len(axes) == 1)})" for axes in arrays)
        named = {axis for axes in arrays for axis in axes}
        bound = ", ".join(f"{axis} = {size}" for axis, size in sizes.items() if axis in named)
        raise ValueError(f"{where} has shape {shape}, but {needed} is needed{bound and f' with {bound}'}.")
    given = f"an array of shape {shape}" if shape is not None else f"of type {type(value).__name__}"
    makers = [_MAKERS[kind] for kind in classes if kind in _MAKERS and shape is not None]
    hint = f"; {makers[0]} makes one of an array" if makers else ""
    raise TypeError(f"{where} is {given}, but {' or '.join(['an array'] * bool(arrays) + classes)} is needed{hint}.")
