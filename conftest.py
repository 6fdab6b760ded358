"""How the suite runs: strict dtypes and ranks, warnings are errors, compiled programs kept between runs."""

import gc
import os
from importlib.metadata import version
from pathlib import Path

import jax
import numpy as np
import pytest

REPOSITORY = Path(__file__).resolve().parent
RECORDINGS = REPOSITORY.parent / "shared" / "data"
_CACHE = os.environ.get("JAX_COMPILATION_CACHE_DIR", str(REPOSITORY / ".jax_cache"))

# Half the time of compiling. XLA ends a process that gives it a flag it does not know: only where it was tried.
if version("jaxlib").startswith("0.10."):
    os.environ["XLA_FLAGS"] = os.environ.get("XLA_FLAGS", "") + " --xla_cpu_use_fusion_emitters=false"

jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_compilation_cache_dir", _CACHE)
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)
# Most of the time goes into tracing: 8 % of it into the places in the source that are kept for each operation, 4 % into
# the collection of garbage, of which there is little.
jax.config.update("jax_traceback_in_locations_limit", 0)
gc.set_threshold(100_000, 20, 100)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Examples of docstrings are slow together: three minutes of programs that run once.

    Recordings are no part of the project (their licences forbid it): tests that read them run where they lie.
    """
    for item in items:
        if isinstance(item, pytest.DoctestItem):
            item.add_marker(pytest.mark.slow)
        if item.get_closest_marker("recordings") and not RECORDINGS.is_dir():
            item.add_marker(pytest.mark.skip(reason=f"the recordings are not at {RECORDINGS}"))


@pytest.fixture(autouse=True, scope="module")
def quick_compiles(request):
    """Most tests run a program once: compiling it well costs more than running it badly, but in `heavy` modules."""
    heavy = request.node.get_closest_marker("heavy") is not None
    jax.config.update("jax_disable_most_optimizations", not heavy)
    yield
    # Each program holds memory maps, of which a process may have 65530: a whole suite of them is too many.
    jax.clear_caches()


@pytest.fixture
def recordings() -> Path:
    """The folder with the real recordings."""
    return RECORDINGS


@pytest.fixture
def x64():
    """Runs a test in float64."""
    with jax.enable_x64(True):
        yield


@pytest.fixture(params=["float32", "float64"])
def dtype(request):
    """Runs a test in both precisions: the dtype that its arrays should have."""
    with jax.enable_x64(request.param == "float64"):
        yield np.dtype(request.param)


@pytest.fixture
def rng() -> np.random.Generator:
    """Seeded random numbers for test data."""
    return np.random.default_rng(0)
