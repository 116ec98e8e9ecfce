"""Training of a radiance field with fused Warp kernels, on CPU threads and CUDA."""
