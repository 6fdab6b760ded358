"""No batch of a program with linear algebra waits for ever; each is a process of its own, which can be stopped."""

import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).with_name("batches.py")
PROGRAMS = ("pose_graphs", "calibrations", "bundles", "camera_poses", "kalman_filters")
LIMIT = 600  # s; each takes 10 to 150 on two cores


@pytest.mark.slow
@pytest.mark.parametrize("program", PROGRAMS)
def test_a_thousand_batches_end(program):
    subprocess.run([sys.executable, str(SCRIPT), program, "1000"], check=True, timeout=LIMIT)
