"""Operations that torch lacks: ball query, batched singular values, kernels for GPUs."""
