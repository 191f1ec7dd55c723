"""Tensors from files, without running code that they may hold."""

from __future__ import annotations

import re
import warnings
import zipfile
from pathlib import Path
from pickle import UnpicklingError

import torch


def read_torch(file: str | Path) -> object:
    """What torch.save wrote, if it is tensors in plain containers. Code is never run.

    Raises ValueError where the file is truncated or asks for anything else.
    """
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Detected pickle protocol")
            return torch.load(file, map_location="cpu", weights_only=True, mmap=zipfile.is_zipfile(file))
    except UnpicklingError as error:
        code = re.search(r"GLOBAL (\S+)", str(error))
        reason = f"asks for code ({code[1]})" if code else "is no file of weights (perhaps a pickle with code)"
        raise ValueError(f"'{file}' {reason} and was refused, since only weights are read: give a .safetensors file, "
                         "or tensors alone as torch.save writes them") from error
    except Exception as error:  # whatever a damaged file leads to
        raise ValueError(f"'{file}' is truncated or damaged: copy it again") from error
