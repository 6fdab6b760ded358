"""Compilation of functions that take arrays, records and numbers."""

import functools
import inspect
from collections.abc import Callable
from typing import Any, TypeVar, cast, get_args

import equinox as eqx
import jax.numpy as jnp

_Function = TypeVar("_Function", bound=Callable)


def filter_jit(function: _Function) -> _Function:
    """`equinox.filter_jit` that traces numbers as well: a new one does not compile the function anew.

    A Python float becomes a weakly typed array, which takes the precision of the arrays that it meets, unless the
    parameter is annotated as `float`: these, integers, booleans and strings stay Python values, for shapes and choices.

    Args:
        function: of pytrees.

    Returns:
        The compiled function.

    Example:
        >>> scale = filter_jit(lambda x, by: x * by)
        >>> float(scale(jnp.array(2.0), 1.5)), float(scale(jnp.array(2.0), 2.5))
        (3.0, 5.0)
    """
    compiled = eqx.filter_jit(function)
    parameters = inspect.signature(function).parameters
    names = list(parameters)
    static = {name for name in names if _takes_float(parameters[name].annotation)}

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        traced = (value if name in static else _traceable(value) for name, value in zip(names, args, strict=False))
        named = {name: value if name in static else _traceable(value) for name, value in kwargs.items()}
        return compiled(*traced, *args[len(names) :], **named)

    return cast(_Function, call)


def _takes_float(annotation: Any) -> bool:
    return annotation is float or float in get_args(annotation)


def _traceable(value: Any) -> Any:
    return jnp.asarray(float(value)) if isinstance(value, float) else value
