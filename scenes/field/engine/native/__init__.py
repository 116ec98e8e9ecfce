"""C++ snippets of the fused kernels: vectors of samples, hash grid, networks."""
