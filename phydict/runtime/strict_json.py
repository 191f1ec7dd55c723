"""JSON that every reader takes: without NaN and Infinity."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping


def strict_json(value: object, indent: int | None = None) -> str:
    """Nested plain values as JSON, with null for what is no finite number, which JSON cannot say."""
    return json.dumps(_finite(value), allow_nan=False, indent=indent)


def _finite(value: object) -> object:
    if isinstance(value, Mapping):
        return {str(key): _finite(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
