"""The command lines. They start with a wrong MPLBACKEND, since their pictures go to files, and with a cache of PyTorch
that cannot be written, which is left to its default place."""

import os

os.environ["MPLBACKEND"] = "agg"
try:
    os.makedirs(os.environ.get("TORCHINDUCTOR_CACHE_DIR") or os.curdir, exist_ok=True)
except OSError:
    del os.environ["TORCHINDUCTOR_CACHE_DIR"]
