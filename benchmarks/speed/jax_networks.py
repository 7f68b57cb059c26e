"""The workload's networks in JAX, with their weights as arrays that can be differentiated."""

from __future__ import annotations

import os

# One thread, as for all candidates; read when jax is imported.
os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
os.environ.setdefault("JAX_PLATFORMS", "cpu")

import jax
import jax.numpy as jnp

from benchmarks.speed.workload import RATE


def mlp(layers: list, x: jax.Array, key: jax.Array | None = None) -> jax.Array:
    """Runs a ReLU network on one row ``[in]``; with a key, with dropout after each hidden layer."""
    keys = None if key is None else jax.random.split(key, len(layers) - 1)
    for index, (weight, bias) in enumerate(layers[:-1]):
        x = jax.nn.relu(weight @ x + bias)
        if keys is not None:
            x = jnp.where(jax.random.bernoulli(keys[index], 1 - RATE, x.shape), x / (1 - RATE), 0.0)
    weight, bias = layers[-1]
    return weight @ x + bias
