"""Fixtures of the pipelines: a run that is saved, restored and continued."""

import jax
import numpy as np
import pytest

from jaxloc.pipelines import checkpoint


def numbers(output):
    """All leaves of an output but the wall times."""
    leaves = jax.tree_util.tree_leaves_with_path(output)
    return [(str(path), leaf) for path, leaf in leaves if "timings" not in str(path)]


@pytest.fixture
def check_resumed(tmp_path):
    """Checks that a run that is saved after some frames and restored gives the numbers of one pass, to the last bit."""

    def check(begin, step, frames, at):
        state, whole = begin(), []
        for index, frame in enumerate(frames):
            if index == at:
                checkpoint.save(tmp_path / "a.state", state)
            state, output = step(state, frame)
            whole.append(output)
        restored = checkpoint.restore(tmp_path / "a.state", begin())
        for index, frame in enumerate(frames[at:], start=at):
            restored, output = step(restored, frame)
            for (name, one), (_, other) in zip(numbers(whole[index]), numbers(output), strict=True):
                np.testing.assert_array_equal(one, other, err_msg=f"frame {index}{name}")
        return whole, state

    return check
