"""Field rendering with fused Warp kernels, on CPU and CUDA."""
