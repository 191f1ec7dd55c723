"""What both command lines share: bad input ends in one clear sentence."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def one_sentence_errors() -> Iterator[None]:
    """Prints ValueError and OSError as one sentence and exits with code 2; PHYDICT_TRACEBACK=1 shows the trace."""
    try:
        yield
    except (ValueError, OSError) as error:
        if os.environ.get("PHYDICT_TRACEBACK"):
            raise
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        raise SystemExit(2) from None
