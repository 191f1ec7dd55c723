"""What is freed inside `freed_memory_kept` stays with the process, and goes back to the system afterwards."""

import os
import platform
import subprocess
import sys

import pytest

from phydict.runtime.memory import OWN_CHOICE

CODE = """
import os
import numpy as np
from phydict.runtime import memory
from phydict.runtime.memory import freed_memory_kept

def resident():
    return int(memory.STATM.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20

before = resident()

def tell(situation):
    piece = np.ones(64 * 2**20, np.uint8)
    assert resident() > before + 48
    del piece
    print(situation, "kept" if resident() > before + 48 else "handed back")

tell("before")
with freed_memory_kept(0):
    with freed_memory_kept(0):
        tell("inside")
    tell("still inside")
assert resident() < before + 16
tell("afterwards")
try:
    with freed_memory_kept(0):
        raise KeyError
except KeyError:
    tell("after an error")
for free in None, 2**30, 2**31:
    memory.free_memory = lambda: free
    with freed_memory_kept(2**30):
        tell(f"of {free}")
with freed_memory_kept(0):
    tell("of plenty")
os.environ["MALLOC_TRIM_THRESHOLD_"] = "131072"
with freed_memory_kept(0):
    tell("by the environment")
"""
"""In a process of its own, where no other piece has been free before."""

TOLD = """\
before handed back
inside kept
still inside kept
afterwards handed back
after an error handed back
of None handed back
of 1073741824 handed back
of 2147483648 kept
of plenty kept
by the environment handed back
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other memory than glibc's is left alone")
def test_what_is_freed_stays_inside_and_where_there_is_enough_and_goes_back_afterwards():
    own = {name: value for name, value in os.environ.items() if name not in OWN_CHOICE}
    done = subprocess.run([sys.executable, "-c", CODE], env=own, capture_output=True, text=True, timeout=300)
    assert done.stdout == TOLD, done.stderr
