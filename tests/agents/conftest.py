"""Compile quickly: these tests, and the processes they start, compile much and compute little."""

import jax
import pytest


@pytest.fixture(autouse=True, scope="module")
def _compile_quickly():
  before = jax.config.read("jax_disable_most_optimizations")
  jax.config.update("jax_disable_most_optimizations", True)
  with pytest.MonkeyPatch.context() as patch:
    patch.setenv("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")
    yield
  jax.config.update("jax_disable_most_optimizations", before)
