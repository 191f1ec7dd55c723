"""How much memory a computation takes."""

import weakref

import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves


class Peak(TorchDispatchMode):
    """The most bytes that tensors made within it held at once."""

    def __init__(self):
        super().__init__()
        self.live, self.held, self.most = weakref.WeakKeyDictionary(), 0, 0

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        result = function(*args, **(kwargs or {}))
        for tensor in tree_leaves(result):
            if isinstance(tensor, torch.Tensor) and tensor.untyped_storage() not in self.live:
                storage, size = tensor.untyped_storage(), tensor.untyped_storage().nbytes()
                self.live[storage] = size
                self.held += size
                weakref.finalize(storage, self._freed, size)
        self.most = max(self.most, self.held)
        return result

    def _freed(self, size):
        self.held -= size
