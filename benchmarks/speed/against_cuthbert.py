"""A sequence against cuthbert's ensemble Kalman filter (JAX), jitted in a scan, at B = 64 vmapped."""

from __future__ import annotations

import torch

from benchmarks.speed.jax_networks import jax, jnp, mlp
from benchmarks.speed.ours import sequences
from benchmarks.speed.pairs import Row, against
from benchmarks.speed.workload import MEMBERS, STATE, STEPS, make_filter, make_frames, noise_floor, weights

NOTE = "same networks and weights, perturbed readings; theirs draws dropout with threefry in each layer"
LIMITS = {(1, False): (0.7, None), (64, False): (0.5, None), (1, True): (0.8, None), (64, True): (0.5, None)}


def cuthbert_sequence(batch: int, backward: bool):
    """Returns their jitted filter over a sequence, as a function without arguments that waits for the result."""
    from cuthbert import filter as run
    from cuthbert.ensemble_kalman import ensemble_kalman_filter

    filter = make_filter("perturbed")
    parameters = jax.tree.map(jnp.asarray, weights(filter))
    variance, floor = map(jnp.asarray, noise_floor(filter))
    readings = jnp.asarray(make_frames(batch, STEPS, samples=False).get(("sensor", "ensemble")).numpy())

    def means(layers, reading, key):
        def observations(inputs):
            r = variance * (1 + mlp(layers["noise"], inputs)) ** 2 + floor
            return lambda x: mlp(layers["observation"], x), jnp.diag(jnp.sqrt(r)), inputs

        theirs = ensemble_kalman_filter.build_filter(
            init_sample=lambda key: jax.random.normal(key, (STATE,)),
            get_dynamics=lambda inputs: lambda x, key: x + mlp(layers["transition"], x, key),
            get_observations=observations,
            n_particles=MEMBERS,
        )
        first, second = jax.random.split(key)
        return run(theirs, reading, theirs.init_prepare(key=first), key=second).mean

    batched = jax.vmap(means, (None, 0, 0))
    if batch == 1:

        def call(layers, readings, keys):
            return means(layers, readings[0], keys[0])
    else:
        call = batched
    if backward:

        def loss(layers, readings, keys, means=call):
            return jnp.square(means(layers, readings, keys)).sum()

        call = jax.grad(loss)
    compiled = jax.jit(call)
    keys = jax.random.split(jax.random.key(0), batch)
    return lambda: jax.block_until_ready(compiled(parameters, readings, keys))


def same_networks() -> None:
    """Checks that both compute the same forecast without noise."""
    filter = make_filter()
    x = torch.randn(STATE)
    theirs = mlp(jax.tree.map(jnp.asarray, weights(filter))["transition"], jnp.asarray(x.numpy()))
    ours = filter["transition"].module(x, sample=False)
    torch.testing.assert_close(torch.from_numpy(jax.device_get(theirs).copy()), ours.detach(), rtol=1e-4, atol=1e-5)


def rows(seconds: float) -> list[Row]:
    same_networks()
    out = []
    for (batch, backward), (target, aim) in LIMITS.items():
        ours = sequences(batch, scheme="perturbed", backward=backward)
        theirs, title = cuthbert_sequence(batch, backward), f"sequence / cuthbert, {'gradients, ' * backward}B={batch}"
        fields = {"per": STEPS, "target": target, "aim": aim, "note": NOTE}
        out += against(ours, "cuthbert", theirs, title, how={"seconds": seconds}, **fields)
    return out
