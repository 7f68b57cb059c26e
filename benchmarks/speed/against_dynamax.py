"""A sequence against dynamax's extended and unscented Kalman filters (JAX), jitted: no ensemble, so no target."""

from __future__ import annotations

from benchmarks.speed.jax_networks import jax, jnp, mlp
from benchmarks.speed.ours import sequence
from benchmarks.speed.pairs import Row, interleave
from benchmarks.speed.workload import OBSERVATION, STATE, STD, STEPS, make_filter, make_frames, weights


def rows(seconds: float) -> list[Row]:
    from dynamax.nonlinear_gaussian_ssm import (
        ParamsNLGSSM,
        UKFHyperParams,
        extended_kalman_filter,
        unscented_kalman_filter,
    )

    filter = make_filter("perturbed")
    layers = jax.tree.map(jnp.asarray, weights(filter))
    parameters = ParamsNLGSSM(
        initial_mean=jnp.zeros(STATE),
        initial_covariance=jnp.eye(STATE),
        dynamics_function=lambda x: x + mlp(layers["transition"], x),
        dynamics_covariance=0.01 * jnp.eye(STATE),
        emission_function=lambda x: mlp(layers["observation"], x),
        emission_covariance=STD**2 * jnp.eye(OBSERVATION),
    )
    readings = jnp.asarray(make_frames(1, STEPS, samples=False).get(("sensor", "ensemble"))[0].numpy())
    extended = jax.jit(lambda y: extended_kalman_filter(parameters, y))
    unscented = jax.jit(lambda y: unscented_kalman_filter(parameters, y, UKFHyperParams()))
    timings = interleave(
        {
            "ours": sequence(filter, 1, samples=False),
            "EKF": lambda: jax.block_until_ready(extended(readings)),
            "UKF": lambda: jax.block_until_ready(unscented(readings)),
        },
        seconds=seconds,
    )
    note = "theirs carries mean and covariance with a constant Q and R; ours 32 members through dropout networks"
    return [
        timings.row(f"sequence / dynamax {name}, B=1", "ours", name, per=STEPS, note=note) for name in ("EKF", "UKF")
    ]
