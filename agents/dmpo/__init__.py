"""Distributional MPO with a recurrent image encoder, in JAX. Start with README.md."""
