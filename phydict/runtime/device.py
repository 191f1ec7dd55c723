"""Devices that a user names."""

from __future__ import annotations

import torch

from phydict.runtime.reading import reason


def usable_device(device: str | torch.device, option: str) -> torch.device:
    """A device that tensors can be made on. Raises ValueError, in one sentence, for any other; `option` is what named
    it."""
    try:
        return torch.empty(0, device=device).device
    except Exception as error:  # torch has a kind for each reason
        raise ValueError(f"{option} {device} cannot be used ({reason(error)[:100]}): give cpu, or leave it "
                         "out") from error
