"""A process that keeps the memory it frees."""

import subprocess
import sys

import pytest

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="glibc's mallopt")

PROGRAM = """
import resource
import numpy as np
from virest.app.machine import keep_freed_memory
{keep}
def fill():
    for _ in range(20):
        [np.ones((1280, 720), np.float32) for _ in range(8)]
fill()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
fill()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def test_kept_memory_is_not_fetched_again() -> None:
    """Allocating and freeing pictures causes thousands of page faults, and hardly any once memory is kept."""
    faults = [
        int(subprocess.run([sys.executable, "-c", PROGRAM.format(keep=keep)], capture_output=True, check=True).stdout)
        for keep in ("", "keep_freed_memory()")
    ]
    assert faults[1] < 0.05 * max(faults[0], 2000)
