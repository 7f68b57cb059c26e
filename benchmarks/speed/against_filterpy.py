"""A step against filterpy's ensemble Kalman filter with networks of the same size in numpy."""

from __future__ import annotations

import numpy as np

from benchmarks.speed.ours import steps
from benchmarks.speed.pairs import Row, against
from benchmarks.speed.workload import MEMBERS, OBSERVATION, RATE, STATE, make_filter, make_frames, noise_floor, weights

NOTE = "same networks and weights; theirs calls them for each member, and adds a tiny Gaussian process noise of its own"


def mlp(layers: list, x: np.ndarray, random: np.random.Generator | None = None) -> np.ndarray:
    """Runs a ReLU network on one row; with a generator, with dropout in each layer."""
    for weight, bias in layers[:-1]:
        x = np.maximum(weight @ x + bias, 0)
        if random is not None:
            x = x * (random.random(x.shape, dtype=np.float32) >= RATE) / np.float32(1 - RATE)
    weight, bias = layers[-1]
    return weight @ x + bias


def filterpy_loop():
    """Returns a call of their predict and update, from the members of the last call."""
    from filterpy.kalman import EnsembleKalmanFilter

    filter = make_filter()
    layers, (variance, floor) = weights(filter), noise_floor(filter)
    random = np.random.default_rng(0)
    np.random.seed(0)  # theirs draws from numpy's global generator
    reading = make_frames(1, 1, samples=False).get(("sensor", "ensemble"))[0, 0].numpy()
    theirs = EnsembleKalmanFilter(
        x=np.zeros(STATE),
        P=np.eye(STATE),
        dim_z=OBSERVATION,
        dt=1.0,
        N=MEMBERS,
        hx=lambda x: mlp(layers["observation"], x),
        fx=lambda x, dt: x + mlp(layers["transition"], x, random),
    )
    theirs.Q = 1e-6 * np.eye(STATE)

    def call() -> np.ndarray:
        theirs.predict()
        theirs.update(reading, np.diag(variance * (1 + mlp(layers["noise"], reading)) ** 2 + floor))
        return theirs.x

    return call


def rows(seconds: float) -> list[Row]:
    import torch

    filter = make_filter("perturbed")
    x = torch.randn(STATE)
    np.testing.assert_allclose(
        mlp(weights(filter)["transition"], x.numpy()),
        filter["transition"].module(x, sample=False).detach().numpy(),
        rtol=1e-4,
        atol=1e-5,
    )
    fields = {"how": {"seconds": seconds}, "target": 0.3, "note": NOTE}
    return against(steps(1), "filterpy", filterpy_loop(), "step / filterpy, B=1", **fields)
