"""A sequence of EKF and UKF against dynamax's (JAX), jitted, at B = 64 vmapped: one model, one set of weights.

Both sides start from the same belief, read the same readings, and return the same means and covariances, forecast and
updated; :func:`same_beliefs` checks that before the timing. Theirs has one more forecast, after the last reading.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from benchmarks.speed.jax_networks import jax, jnp, mlp
from benchmarks.speed.ours import filters, sequence
from benchmarks.speed.pairs import Row, against
from benchmarks.speed.workload import (
    OBSERVATION,
    POINTS,
    PROCESS_STD,
    STATE,
    STD,
    STEPS,
    make_frames,
    make_gaussian_filter,
    weights,
)
from torch_denkf.filters.base import Filter

NOTE = "same networks, weights, Q, R, readings, means and covariances; ours also writes variance, innovation and NIS"
LIMITS = {1: (2.0, 1.0), 64: (1.0, 0.7)}
FRAMES = STEPS + 1
#: A call of theirs takes 0.6 ms, and three times as long just after an eager one of ours: time many in a row.
WARM_S = 0.03


def dynamax_sequence(kind: str, batch: int) -> Callable[[], object]:
    """Returns their jitted filter over a sequence, as a function without arguments that waits for the posterior."""
    from dynamax.nonlinear_gaussian_ssm import (
        ParamsNLGSSM,
        UKFHyperParams,
        extended_kalman_filter,
        unscented_kalman_filter,
    )

    parameters = jax.tree.map(jnp.asarray, weights(make_gaussian_filter(kind)))
    readings = jnp.asarray(make_frames(batch, FRAMES, samples=False).get(("sensor", "ensemble")).numpy())

    def posterior(layers, reading):
        model = ParamsNLGSSM(
            initial_mean=jnp.zeros(STATE),
            initial_covariance=jnp.eye(STATE),
            dynamics_function=lambda x: x + mlp(layers["transition"], x),
            dynamics_covariance=PROCESS_STD**2 * jnp.eye(STATE),
            emission_function=lambda x: mlp(layers["observation"], x),
            emission_covariance=STD**2 * jnp.eye(OBSERVATION),
        )
        if kind == "EKF":
            return extended_kalman_filter(model, reading)
        return unscented_kalman_filter(model, reading, UKFHyperParams(**POINTS))

    if batch == 1:
        compiled = jax.jit(lambda layers, readings: posterior(layers, readings[0]))
    else:
        compiled = jax.jit(jax.vmap(posterior, (None, 0)))
    return lambda: jax.block_until_ready(compiled(parameters, readings))


def same_beliefs(filter: Filter, kind: str, batch: int) -> None:
    """Checks that both compute the same means, covariances and likelihood on the timed readings.

    In single precision they differ by 1e-5 at most: theirs updates P - K S K', ours in Joseph's form, and our sigma
    points use a regularised covariance.

    Raises:
        AssertionError: if they differ by more.
    """
    with torch.no_grad():
        ours = filter.sequence(make_frames(batch, FRAMES, samples=False))
    theirs = dynamax_sequence(kind, batch)()
    pairs = {
        "means": (ours["belief", "mean"], theirs.filtered_means),
        "covariances": (ours["belief", "cov"], theirs.filtered_covariances),
        "forecast means": (ours["forecast", "mean"][:, 1:], theirs.predicted_means[..., :-1, :]),
        "forecast covariances": (ours["forecast", "cov"][:, 1:], theirs.predicted_covariances[..., :-1, :, :]),
        "log-likelihoods": (ours["info", "log_likelihood"].sum((1, 2)), theirs.marginal_loglik),
    }
    for name, (own, other) in pairs.items():
        other = np.asarray(other).reshape(own.shape)
        np.testing.assert_allclose(own.numpy(), other, rtol=1e-3, atol=5e-5, err_msg=f"{kind}, B={batch}: {name}")


def rows(seconds: float) -> list[Row]:
    out = []
    for kind in ("EKF", "UKF"):
        for batch, (target, aim) in LIMITS.items():
            ours = filters(make_gaussian_filter, kind)
            for filter in ours.values():
                same_beliefs(filter, kind, batch)
            calls = {name: sequence(filter, batch, samples=False) for name, filter in ours.items()}
            theirs, title = dynamax_sequence(kind, batch), f"{kind} sequence / dynamax, B={batch}"
            how, fields = {"seconds": seconds, "shortest": WARM_S}, {"target": target, "aim": aim, "note": NOTE}
            out += against(calls, "dynamax", theirs, title, how=how, per=FRAMES, **fields)
    return out
