"""Wrong arguments of public functions: one clear error that names the argument, without a hook that checks types.

The tests themselves run under such a hook, so the functions are tried in a process of its own.
"""

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOMS = ("poses", "sensors", "multiview", "refinement")

CODE = """
import inspect, json, sys
sys.path.insert(0, sys.argv[1])
import jax, jax.numpy as jnp, numpy as np
import jaxloc as jl
from jaxloc.poses import SE2, SE3, SO2, SO3, Direction
from test_empty_sets import PIXELS, SETS, SPECIAL, arguments_of, hints_of, identity, is_array, public_functions

sizes = {name: 4 for name in SETS} | {"m": 5, "k": 3}
found = {}

def call(name, function, given, argument, wrong, kind):
    try:
        function(**{**given, argument: wrong})
        said = "no error"
    except (TypeError, ValueError) as error:
        said = str(error)
        named = f": {argument} has shape " in said or f": {argument} is " in said
        if named or isinstance(error, ValueError) and "have" in said and str(np.shape(wrong)) in said:
            return True
    except Exception as error:
        said = f"{type(error).__name__}: {error}"
    found[f"{name}, {argument}, {kind}"] = said[:200]
    return False

def mutations(value):
    value = jnp.asarray(value)
    yield "stacked", jnp.stack([value, value])
    if value.ndim:
        yield "an axis less", value[0]
        yield "larger", jnp.concatenate([value, value], axis=-1)

def is_record(hint):
    return inspect.isclass(hint) and hint.__module__.startswith("jaxloc.")

def tried(name, function, given, hints):
    count = 0
    for argument, value in given.items():
        hint = hints.get(argument)
        if is_array(hint) and "key" not in str(hint.dtypes):
            axes = hint.dim_str.split()
            if any(axis[0] in "*." for axis in axes):
                continue
            free = len([axis for axis in axes if not axis.isdigit()])
            alone = not axes or (not axes[-1].isdigit() and axes.count(axes[-1]) == 1)
            for kind, wrong in mutations(value):
                if kind == "larger" and alone:
                    continue
                count += call(name, function, given, argument, wrong, kind)
        elif is_record(hint) and not issubclass(hint, tuple):
            count += call(name, function, given, argument, jnp.eye(4), "a matrix")
            count += call(name, function, given, argument, "abc", "a text")
    return count

count = 0
for name, function in public_functions().items():
    room = name.split(".")[0]
    # Series are elementwise.
    if room not in sys.argv[2:] or name.startswith("poses.series."):
        continue
    hints = hints_of(function)
    try:
        given = arguments_of(name, function, **sizes)
    except Exception as error:
        continue
    # Whatever SPECIAL makes has no items: its sizes would be wrong with those of the others.
    if name in SPECIAL or not any(is_array(hint) or is_record(hint) for hint in hints.values()):
        continue
    count += tried(name, function, given, hints)

camera = jl.sensors.Pinhole(500.0, 500.0, 320.0, 240.0)
things = [SE2.identity(), SE3.identity(), SO2.identity(), SO3.identity(), Direction.from_vector([0.0, 0.0, 1.0]),
          camera, jl.sensors.StereoRig(camera, 0.5)]
for thing in things:
    for name, _ in inspect.getmembers(type(thing), callable):
        if name.startswith("_"):
            continue
        method = getattr(thing, name)
        hints = hints_of(method)
        try:
            given = arguments_of(name, method, **sizes)
        except Exception:
            continue
        count += tried(f"{type(thing).__name__}.{name}", method, given, hints)
print(json.dumps({"count": count, "found": found}))
"""


@pytest.fixture(scope="module")
def results():
    here = str(Path(__file__).parent)
    done = subprocess.run([sys.executable, "-c", CODE, here, *ROOMS], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-3000:]
    return json.loads(done.stdout.splitlines()[-1])


def test_every_wrong_argument_is_named(results):
    assert not results["found"], "\n".join(f"{key}: {value}" for key, value in results["found"].items())
    assert results["count"] > 150
