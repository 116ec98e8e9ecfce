"""Field training on CPU cores with fused numba kernels."""
