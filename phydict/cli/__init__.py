"""The command lines. Their pictures go to files, so no window system, nor a wrong one in MPLBACKEND, matters."""

import os

os.environ["MPLBACKEND"] = "agg"
