"""Sparse matrices as torch tensors."""

from __future__ import annotations

import warnings

import numpy as np
import torch


def index_type(entries: int, columns: int) -> type[np.signedinteger]:
    """The smaller integer type that can count a CSR matrix's entries and columns."""
    return np.int32 if max(entries, columns) < 2**31 else np.int64


def csr_tensor(matrix, like: torch.Tensor) -> torch.Tensor:
    """A scipy sparse matrix as torch CSR, its columns sorted, in the precision and on the device of `like`."""
    matrix = matrix.tocsr()
    matrix.sort_indices()
    kind = index_type(matrix.nnz, matrix.shape[1])
    rows, columns = (torch.as_tensor(part.astype(kind, copy=False)) for part in (matrix.indptr, matrix.indices))
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Sparse CSR tensor support is in beta state")
        return torch.sparse_csr_tensor(rows, columns, torch.as_tensor(matrix.data).to(like.dtype), matrix.shape,
                                       device=like.device, check_invariants=False)
