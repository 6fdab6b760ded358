"""jaxloc: a differentiable JAX toolkit for robot localization and for tracking what moves.

The package is a house of rooms (``jaxloc.poses``, ``jaxloc.solvers``, ...), each loaded when it is first named, so that
``import jaxloc`` starts no backend and costs no more than ``import jax``.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

_ROOMS = (
    "alignment",
    "beliefs",
    "data",
    "evaluation",
    "features",
    "filters",
    "images",
    "lanes",
    "multiview",
    "odometry",
    "pipelines",
    "poses",
    "refinement",
    "sensors",
    "slam",
    "solvers",
    "tracking",
)

__all__ = [*_ROOMS, "__version__"]

if TYPE_CHECKING:
    from jaxloc import (
        alignment,
        beliefs,
        data,
        evaluation,
        features,
        filters,
        images,
        lanes,
        multiview,
        odometry,
        pipelines,
        poses,
        refinement,
        sensors,
        slam,
        solvers,
        tracking,
    )


def __getattr__(name: str) -> Any:
    if name in _ROOMS:
        return import_module(f"jaxloc.{name}")
    raise AttributeError(f"module 'jaxloc' has no attribute {name!r}; its rooms are {', '.join(_ROOMS)}.")


def __dir__() -> list[str]:
    return sorted(__all__)
