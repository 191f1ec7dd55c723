"""A prior whose weights, gradients and optimizer state are sharded over processes: PyTorch's fully_shard (FSDP2)."""

from __future__ import annotations

import torch
from torch.distributed.device_mesh import DeviceMesh
from torch.distributed.fsdp import fully_shard, register_fsdp_forward_method

from phydict.prior.prior import Prior


def shard(prior: Prior, mesh: DeviceMesh) -> Prior:
    """Shards `prior`, in place, over the processes of a one-dimensional `mesh`.

    Each block of the network is gathered when it computes and let go after; the rest is one group, gathered by
    `forward` and by `context` alike. Names of weights stay. From here on every process must make the same calls.
    """
    prior.to(memory_format=torch.contiguous_format)  # type: ignore[call-overload]  # the only one that can be sharded
    for block in prior.network.blocks():
        fully_shard(block, mesh=mesh)
    fully_shard(prior, mesh=mesh)
    register_fsdp_forward_method(prior, "context")
    return prior
