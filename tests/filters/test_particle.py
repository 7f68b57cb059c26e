"""Oracles: the Kalman filter, importance sampling in closed form, steps against sequences, policy against transform."""

import math
import pickle

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.envs import InitTracker, TransformedEnv, check_env_specs
from torchrl.modules.utils import get_env_transforms_from_module

from tests.filters.factories import (
    OBS,
    A,
    FixedEnsemble,
    M,
    NoisyLinear,
    S,
    linear_kalman,
    linear_system,
    toy_frames,
)
from tests.filters.test_base import assert_equal, make_dyadic, stepwise
from torch_denkf.envs.linear import LinearGaussianEnv
from torch_denkf.filters import DPF, PFM, ParticleFilter
from torch_denkf.functional import weighted_mean, weighted_var
from torch_denkf.modules import (
    AroundState,
    ClonedPrior,
    ClonedTransition,
    ConstantNoise,
    DiagonalNoise,
    GaussianLikelihood,
    GaussianPrior,
    LearnedLikelihood,
    LearnedObservation,
    LearnedTransition,
    LinearObservation,
    NoisyTransition,
    PairObservation,
    ResampledTransition,
    StochasticMLP,
    UnicycleTransition,
    VectorSensor,
    WithWeights,
)
from torch_denkf.transforms import DEnKFTransform

E = 6
BELIEF = [("belief", name) for name in ("ensemble", "log_weight", "mean", "var")]
SCHEMES = ["systematic", "soft", "transport", None]


def toy_parts(ensemble_size=E):
    transition = LearnedTransition(StochasticMLP(S + A, S, (8,), rate=0.3, output_gain=0.5), action_key="action")
    q = DiagonalNoise(2, r=0.5, in_features=S, num_cells=(4,), in_key=("belief", "mean"), out_key=("forecast", "q"))
    return {
        "transition": NoisyTransition(transition, q, [0, 2]),
        "sensor": VectorSensor(M, OBS, ensemble_size=ensemble_size, num_cells=(8,), rate=0.5),
        "observation": LearnedObservation(StochasticMLP(S, OBS, (8,), layer="none")),
        "initial": GaussianPrior(torch.zeros(S), torch.ones(S), ensemble_size=ensemble_size),
    }


def toy_filter(scheme="soft", learned=False, **kwargs):
    """All parts learned; the likelihood Gaussian, or learned on the measurement itself."""
    options = {"likelihood": LearnedLikelihood(M, OBS, num_cells=(8,), encoding_key="measurement")} if learned else {}
    if not learned:
        options["noise"] = DiagonalNoise(OBS, r=0.5, num_cells=(4,))
    return ParticleFilter(**toy_parts(), **options, resampling=scheme, alpha=0.3, **kwargs)


def bootstrap(size, *, noisy=True, initial=None, **kwargs):
    """The bootstrap filter of :func:`linear_system`, with the prior of :func:`linear_kalman`."""
    F, Q, H, R = linear_system()
    kf = linear_kalman()
    prior = GaussianPrior(kf.initial.mean, kf.initial.cov.diagonal().sqrt(), ensemble_size=size)
    return ParticleFilter(
        NoisyLinear(F, torch.linalg.cholesky(Q) if noisy else None, size),
        None,
        LinearObservation(H),
        GaussianLikelihood(sensor_key="observation"),
        noise=ConstantNoise(R.sqrt(), in_key="observation"),
        initial=prior if initial is None else initial,
        **kwargs,
    )


def readings(steps, masked=True):
    td = TensorDict({"observation": torch.randn(steps, 2)}, [steps])
    return td.set("observed", torch.rand(steps, 2) < 0.8) if masked else td


# ---------------------------------------------------------------------------------------------- the exact filter


def errors_by_size(sizes, rows_of, **kwargs):
    """Root-mean-square difference of the means, in standard deviations, for each number of particles."""
    td = readings(12)
    exact = linear_kalman().sequence(td.copy())["belief"][1:]
    errors = []
    for size in sizes:
        with torch.no_grad():
            out = bootstrap(size, **kwargs).sequence(td.expand(rows_of(size), 12).clone())
        # The rows are replications: all have the same readings.
        errors.append((out["belief", "mean"][:, 1:] - exact["mean"]) / exact["var"].sqrt())
    return [error.square().mean().sqrt() for error in errors], errors


@pytest.mark.parametrize(
    "options", [{}, {"resampling": "soft", "alpha": 0.3}, {"ess_threshold": 0.5}], ids=["systematic", "soft", "ess"]
)
def test_errors_fall_with_the_square_root_of_the_number_of_particles(float64, options):
    sizes = torch.tensor([32, 128, 512, 2048])
    rms, errors = errors_by_size(sizes.tolist(), lambda size: max(24, 20_000 // size), **options)
    x, y = sizes.log(), torch.stack(rms).log()
    slope = ((x - x.mean()) * (y - y.mean())).sum() / (x - x.mean()).square().sum()
    # With 24 rows or more of correlated steps an rms is known to some 10 %, and over a factor of 64 the slope to 0.03.
    assert -0.6 < slope < -0.4
    assert rms[-1] < 0.07
    # What is left at 2048 is scatter, not bias: the rows' mean is nearer by far than a single row.
    assert errors[-1].mean(0).square().mean().sqrt() < 0.5 * rms[-1]


def test_transport_comes_near_and_is_biased_by_its_regularisation(float64):
    rms, bias = {}, {}
    for epsilon in (0.05, 1.0):
        torch.manual_seed(0)  # the same readings
        options = {"resampling": "transport", "epsilon": epsilon}
        rms[epsilon], errors = errors_by_size([16, 128], lambda size: 2048 // size, **options)
        bias[epsilon] = errors[-1].mean(0).square().mean().sqrt()
    # Eight times the particles: 0.35 of the error, where it is not bias.
    assert rms[0.05][1] < 0.45 * rms[0.05][0]
    assert rms[0.05][1] < 0.3
    # The mean of 16 rows scatters by a quarter of one row's error: what exceeds it is bias, little of it and much.
    assert bias[0.05] < 0.4 * rms[0.05][1]
    assert bias[1.0] > 0.7 * rms[1.0][1]
    assert bias[1.0] > 3 * bias[0.05]


def test_variance_and_likelihood_of_many_particles(float64):
    td = readings(20)
    td["observed"][7] = False
    exact = linear_kalman().sequence(td.copy())
    rows = 8
    with torch.no_grad():
        out = bootstrap(5000).sequence(td.expand(rows, 20).clone())
    for key in (("belief", "mean"), ("belief", "var"), ("info", "log_likelihood")):
        error = out[key] - exact[key]
        if key[0] == "info":  # zero, exactly, where nothing is observed
            unseen = ~td["observed"].any(-1)
            assert (out[key][:, unseen] == 0).all()
            error = error[:, ~unseen]
        # N(0, 1) over steps and dimensions if there is no bias, with a standard error from 8 rows; 3 would be a bias.
        z = error.mean(0)[1:] / (error.std(0)[1:] / rows**0.5)
        assert z.square().mean().sqrt() < 2
    assert (out["belief", "var"] / exact["belief", "var"] - 1)[:, 1:].abs().max() < 0.3
    assert (out["info", "log_likelihood"] - exact["info", "log_likelihood"])[:, 1:].abs().max() < 0.4


def test_the_estimate_of_the_likelihood_is_unbiased(float64):
    # With few particles its logarithm is biased, and its value is not (Del Moral 2004, section 7.4).
    td = readings(5, masked=False)
    exact = linear_kalman().sequence(td.copy())["info", "log_likelihood"][1:].sum()
    with torch.no_grad():
        out = bootstrap(25).sequence(td.expand(8000, 5).clone())
    ratio = (out["info", "log_likelihood"][:, 1:].sum((1, 2)) - exact).exp()
    assert (ratio.mean() - 1).abs() < 4 * ratio.std() / 8000**0.5
    assert ratio.log().mean() < -0.05


def test_without_resampling_it_is_importance_sampling(float64):
    # Deterministic motion: the weights are the products of the readings' densities along each particle's path.
    F, _, H, R = linear_system()
    start = GaussianPrior(torch.zeros(2), torch.ones(2), ensemble_size=E)
    filter = bootstrap(E, noisy=False, initial=start, resampling=None)
    td = filter.draw_noise(readings(6, masked=False).expand(3, 6).clone())
    out = filter.sequence(td.copy())
    paths = [td["noise", "initial"][:, 0]]
    log_weights = torch.zeros(3, E)
    for t in range(1, 6):
        paths.append(paths[-1] @ F.mT)
        normal = torch.distributions.Normal(paths[-1] @ H.mT, R.sqrt())
        log_weights = log_weights + normal.log_prob(td["observation"][:, t].unsqueeze(1)).sum(-1)
    torch.testing.assert_close(out["belief", "ensemble"][:, -1], paths[-1])
    torch.testing.assert_close(out["belief", "log_weight"][:, -1], log_weights.log_softmax(-1))
    evidence = torch.logsumexp(log_weights, -1) - math.log(E)
    torch.testing.assert_close(out["info", "log_likelihood"][:, 1:].sum((1, 2)), evidence)


# ------------------------------------------------------------------------------------------ steps and sequences


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("learned", [False, True])
@pytest.mark.parametrize(("batch", "masks", "update_at_reset"), [((3, 12), 1, False), ((2, 2, 6), OBS, True)])
def test_step_equals_sequence_bit_for_bit(float64, scheme, learned, batch, masks, update_at_reset):
    filter = toy_filter(scheme, learned, update_at_reset=update_at_reset)
    make_dyadic(filter["sensor"])
    if not learned:
        make_dyadic(filter["noise"])
    frames = toy_frames(batch, masks=masks)
    frames["measurement"] = (frames["measurement"] * 16).round() / 16
    assert frames["is_init"][..., 1:, :].any()
    filter.draw_noise(frames)
    drawn = {"sensor", "initial", "transition", "motion"}
    assert set(frames["noise"].keys()) == drawn | ({"resampling"} if scheme in ("systematic", "soft") else set())
    steps, sequence = stepwise(filter, frames), filter.sequence(frames.copy())
    # Sums over 8 rows of a matrix product may come in another order for another number of rows: 1e-16.
    assert_equal(steps, sequence, list(dict.fromkeys(filter.out_keys)), atol=1e-12)
    assert (sequence["belief", "log_weight"].logsumexp(-1).abs() < 1e-12).all()
    assert not sequence["belief", "mean"][..., 1, :].equal(sequence["belief", "mean"][..., 0, :])


@pytest.mark.parametrize("scheme", SCHEMES)
def test_resets_start_from_equal_weights(float64, scheme):
    filter = toy_filter(scheme)
    frames = filter.draw_noise(toy_frames((3, 12)))
    out = filter.sequence(frames.copy())
    start = frames["is_init"].squeeze(-1)
    for key in ("belief", "forecast"):
        assert (out[key, "log_weight"][start] == -math.log(E)).all()
        assert out[key, "ensemble"][start].equal(frames["noise", "initial"][start])
    updated = ~start & frames["observed"].squeeze(-1)
    assert updated.any()
    assert (out["belief", "log_weight"].std(-1)[updated] > 1e-3).all()
    # A reset forgets: what follows equals a sequence that begins there.
    row, time = (start & (torch.arange(12) > 0)).nonzero()[0].tolist()
    tail = filter.sequence(frames[row : row + 1, time:].copy())
    assert_equal(tail[0], out[row, time:], BELIEF, atol=1e-12)


def test_stored_belief_continues(float64):
    filter = toy_filter()
    frames = filter.draw_noise(toy_frames((2, 9), resets=False))
    whole = filter.sequence(frames.copy())
    tail = filter.sequence(whole[:, 4:].copy().set("noise", frames["noise"][:, 4:]))
    # The action of the step before is not in the tail; it starts from the belief at 4, with the action at 4.
    assert_equal(tail, whole[:, 4:], BELIEF, atol=1e-12)


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("learned", [False, True])
def test_missing_frames_are_pure_prediction(float64, scheme, learned):
    filter = toy_filter(scheme, learned)
    frames = toy_frames((2, 6), resets=False, masks=0)
    frames["observed"] = torch.ones(2, 6, 1, dtype=torch.bool)
    frames["observed"][:, 2:5] = False
    frames["measurement"][:, 2:5] = torch.nan
    out = filter.sequence(frames)
    assert all(out[key].isfinite().all() for key in BELIEF)
    assert out["belief", "ensemble"].equal(out["forecast", "ensemble"])
    for t in (2, 3, 4):
        assert out["belief", "log_weight"][:, t].equal(out["belief", "log_weight"][:, 1]), "weights stay"
    assert (out["info", "log_likelihood"][:, 2:5] == 0).all()
    assert not out["forecast", "log_weight"][:, 1].equal(out["belief", "log_weight"][:, 1])
    assert not out["belief", "log_weight"][:, 5].equal(out["belief", "log_weight"][:, 4])
    out["belief", "mean"].square().sum().backward()
    grads = [p.grad for p in filter.parameters() if p.grad is not None]
    assert all(grad.isfinite().all() for grad in grads)


@pytest.mark.parametrize("kept", [0, 1])
def test_partial_mask_is_the_filter_of_the_remaining_dimension(float64, kept):
    F, Q, H, R = linear_system()
    both = bootstrap(50)
    one = ParticleFilter(
        NoisyLinear(F, torch.linalg.cholesky(Q), 50),
        None,
        LinearObservation(H[[kept]]),
        GaussianLikelihood(sensor_key="observation"),
        noise=ConstantNoise(R[[kept]].sqrt(), in_key="observation"),
        initial=both.initial,
    )
    td = both.draw_noise(TensorDict({"observation": torch.randn(2, 8, 2)}, [2, 8]))
    single = one.sequence(td.copy().set("observation", td["observation"][..., [kept]]))
    observed = torch.tensor([kept == 0, kept == 1]).expand(2, 8, 2)
    td["observation"] = torch.where(observed, td["observation"], torch.nan)
    masked = both.sequence(td.set("observed", observed))
    assert_equal(masked, single, [*BELIEF, ("info", "ess"), ("info", "log_likelihood")], atol=1e-11)


# ------------------------------------------------------------------------------------------------- gradients


@pytest.mark.parametrize("scheme", ["systematic", "soft", "transport"])
def test_where_gradients_go(float64, scheme):
    filter = toy_filter(scheme)
    frames = filter.draw_noise(toy_frames((2, 6), resets=False, masks=0))
    frames["measurement"].requires_grad_()
    out = filter.sequence(frames.copy())
    (grad,) = torch.autograd.grad(out["belief", "mean"][:, 4].sum(), frames["measurement"], retain_graph=True)
    size = grad.abs().sum((0, 2))
    assert (size[[0, 5]] == 0).all()
    assert size[4] > 0
    # Hard resampling ends the gradient at the step, the others let it through to the first update.
    assert (size[1:4] == 0).all() if scheme == "systematic" else (size[1:4] > 0).all()
    out["belief", "mean"].square().sum().backward()
    for name in ("transition", "sensor", "observation", "noise"):
        grads = [p.grad for p in filter[name].parameters() if p.grad is not None]
        assert all(grad.isfinite().all() for grad in grads), name
        assert sum(grad.abs().sum() for grad in grads) > 0, name


def test_gradient_through_a_sequence_by_finite_differences(float64):
    filter = toy_filter("soft")
    frames = filter.draw_noise(toy_frames((2, 5), masks=0, resets=False))
    loss = lambda: filter.sequence(frames.copy())["belief", "mean"].square().sum()  # noqa: E731
    loss().backward()
    checked, step = 0, 1e-6
    for name in ("transition", "observation", "noise"):
        for parameter in filter[name].parameters():
            if parameter.grad is None or not parameter.grad.any():
                continue
            entry, values = int(parameter.grad.abs().argmax()), []
            for sign in (1, -1):
                with torch.no_grad():
                    parameter.view(-1)[entry] += sign * step
                    values.append(loss())
                    parameter.view(-1)[entry] -= sign * step
            difference = (values[0] - values[1]) / (2 * step)
            # A particle that is picked anew within 1e-6 would show as a difference of order 1e6.
            torch.testing.assert_close(parameter.grad.view(-1)[entry], difference, rtol=1e-5, atol=1e-7)
            checked += 1
    assert checked >= 8


# -------------------------------------------------------------------------------------------------- in torchrl


class Actor(TensorDictModule):
    def __init__(self):
        super().__init__(torch.nn.Linear(2, 1), in_keys=[("belief", "mean")], out_keys=["action"])


def make_env(**kwargs):
    F, Q, H, R = linear_system()
    return LinearGaussianEnv(F, H, Q.diagonal().sqrt(), R.sqrt(), missing=0.3, seed=1, **kwargs)


@pytest.mark.parametrize("update_at_reset", [False, True])
def test_policy_transform_and_sequence_agree(float64, update_at_reset):
    # Without any randomness: one start, no motion noise, transport.
    start = FixedEnsemble(torch.randn(E, 2))
    filter = bootstrap(E, noisy=False, initial=start, resampling="transport", update_at_reset=update_at_reset)
    actor = Actor()

    def env(*transforms):
        env = TransformedEnv(make_env(batch_size=[3], max_steps=[4, 5, 30]))
        for transform in transforms:
            env.append_transform(transform)
        return env

    policy = TensorDictSequential(filter, actor)
    with torch.no_grad():
        by_policy = env(get_env_transforms_from_module(policy)).rollout(12, policy, break_when_any_done=False)
        by_transform = env(InitTracker(), DEnKFTransform(filter)).rollout(12, actor, break_when_any_done=False)
    assert by_policy["is_init"].sum(1).flatten().tolist() == [3, 3, 1]
    assert by_policy["state"].equal(by_transform["state"]), "the same episodes"
    assert_equal(by_policy, by_transform, BELIEF, atol=1e-12)
    frames = by_transform.select("observation", "observed", "is_init", "action")
    assert_equal(filter.sequence(frames), by_transform, BELIEF, atol=1e-12)
    assert (by_transform["belief", "log_weight"].std(-1) > 0).any()


def test_primer_holds_particles_and_weights():
    filter = toy_filter()
    primer = filter.make_tensordict_primer()
    assert primer.primers["belief", "ensemble"].shape == (E, S)
    assert primer.primers["belief", "log_weight"].shape == (E,)


@pytest.mark.parametrize("store_ensemble", [True, False])
@pytest.mark.parametrize("batch_size", [[], [3]])
def test_specs_and_partial_resets_in_an_environment(store_ensemble, batch_size):
    steps = 4 if not batch_size else [4, 5, 30]
    base = make_env(batch_size=batch_size, max_steps=steps)
    env = TransformedEnv(base, DEnKFTransform(bootstrap(8), store_ensemble=store_ensemble))
    check_env_specs(env)
    rollout = env.rollout(12, break_when_any_done=False)
    assert (("belief", "log_weight") in rollout.keys(True, True)) == store_ensemble
    if store_ensemble:
        rollout = rollout if batch_size else rollout.unsqueeze(0)
        start = torch.cat([torch.ones_like(rollout["done"][:, :1]), rollout["next", "done"][:, :-1]], 1).squeeze(-1)
        weights = rollout["belief", "log_weight"]
        equal = torch.full((8,), -math.log(8))
        torch.testing.assert_close(weights[start], equal.expand_as(weights[start]))
        kept = ~start[:, 1:]
        for key in ("log_weight", "ensemble", "mean"):
            assert rollout["belief", key][:, 1:][kept].equal(rollout["next", "belief", key][:, :-1][kept])
        mean = weighted_mean(rollout["next", "belief", "ensemble"], rollout["next", "belief", "log_weight"])
        torch.testing.assert_close(rollout["next", "belief", "mean"], mean)


def test_summaries_are_weighted(float64):
    filter = toy_filter()
    particles, log_weights = torch.randn(4, E, S), torch.randn(4, E).log_softmax(-1)
    out = filter.summarise(TensorDict({"belief": {"ensemble": particles, "log_weight": log_weights}}, [4]))
    assert out["belief", "mean"].equal(weighted_mean(particles, log_weights))
    assert out["belief", "var"].equal(weighted_var(particles, log_weights))
    assert (out["belief", "mean"] - particles.mean(-2)).abs().max() > 0.1
    # What a step writes is what follows from its carry.
    step = filter.sequence(toy_frames((3, 5)))
    again = filter.summarise(step.select(*filter.carry_keys))
    assert_equal(again, step, [("belief", "mean"), ("belief", "var")], atol=1e-14)


def test_copies(float64):
    filter = toy_filter()
    frames = filter.draw_noise(toy_frames((2, 5)))
    expected = filter.sequence(frames.copy())
    assert_equal(pickle.loads(pickle.dumps(filter)).sequence(frames.copy()), expected, BELIEF)
    fresh = toy_filter()
    fresh.load_state_dict(filter.state_dict())
    assert_equal(fresh.sequence(frames.copy()), expected, BELIEF)


def test_compiled_step_equals_eager(float64):
    # "aot_eager" traces forward and backward into one graph each, which is what breaks if anything does. The other
    # schemes are compiled with the mathematics, tests/functional/test_resampling.py.
    filter = toy_filter("soft")
    td = filter.initialise(toy_frames((3,), resets=False))
    td["belief", "log_weight"] = torch.randn(3, E).log_softmax(-1)
    filter.draw_noise(td)
    results = []
    torch._dynamo.reset()
    for step in (filter.step, torch.compile(filter.step, fullgraph=True, backend="aot_eager")):
        filter.zero_grad()
        out = step(td.copy())
        out["belief", "mean"].square().sum().backward()
        results.append((out.detach(), [p.grad.clone() for p in filter.parameters() if p.grad is not None]))
    (eager, grads), (compiled, compiled_grads) = results
    assert_equal(compiled, eager, filter.out_keys, atol=1e-12)
    assert len(grads) > 10
    torch.testing.assert_close(compiled_grads, grads)


# ----------------------------------------------------------------------------------------------------- presets


def test_dpf():
    parts = toy_parts()
    noisy = parts.pop("transition")
    filter = DPF(
        noisy.module["transition"],
        likelihood=LearnedLikelihood(M, OBS, num_cells=(8,), encoding_key="measurement"),
        motion_noise=noisy.module["noise"],
        noisy_dims=[0, 2],
        **parts,
    )
    assert filter["transition"].scheme == "systematic"
    assert isinstance(filter["transition"].module, NoisyTransition)
    assert filter["transition"].module.before
    assert "noise" not in dict(filter.module.named_children())
    out = filter.sequence(toy_frames((3, 6)))
    out["belief", "mean"].square().sum().backward()
    for part in (filter["transition"], filter["likelihood"], filter["observation"]):
        assert any(p.grad is not None and p.grad.any() for p in part.parameters())


@pytest.mark.parametrize("learned", [False, True])
def test_pfm(learned):
    likelihood = LearnedLikelihood(M, OBS, bound="clipped", encoding_key="measurement") if learned else None
    filter = PFM(**toy_parts(), noise=None if learned else DiagonalNoise(OBS), learned_likelihood=likelihood)
    assert (filter["transition"].scheme, filter["transition"].alpha) == ("soft", 0.05)
    assert isinstance(filter["likelihood"], LearnedLikelihood if learned else GaussianLikelihood)
    out = filter.sequence(toy_frames((3, 6)))
    out["belief", "mean"].square().sum().backward()
    assert all(p.grad is None or p.grad.isfinite().all() for p in filter.parameters())
    with pytest.raises(ValueError, match="its Gaussian likelihood, or a learned_likelihood"):
        PFM(**toy_parts())


def test_what_is_there_already_is_kept():
    parts = toy_parts()
    transition = ResampledTransition(parts.pop("transition"), "transport")
    initial = WithWeights(parts.pop("initial"))
    filter = ParticleFilter(transition, initial=initial, noise=DiagonalNoise(OBS), **parts)
    assert filter["transition"] is transition
    assert filter.initial is initial
    assert filter.carry_keys == [("belief", "ensemble"), ("belief", "log_weight")]
    assert filter["transition"].module.ensemble_size == E


def test_clones_of_past_velocities_are_resampled_along():
    # Pairs over gaps with particles: the past is part of each particle.
    q = ConstantNoise([1.0, 0.1], in_key=("belief", "ensemble"), out_key=("forecast", "q"))
    vehicle = NoisyTransition(UnicycleTransition(torch.zeros_like, dt=0.1), q, [3, 4], before=True)
    filter = ParticleFilter(
        ClonedTransition(vehicle),
        None,
        PairObservation(history_key=None),
        GaussianLikelihood(sensor_key="y", observed_key=("forecast", "observed")),
        noise=ConstantNoise([0.5, 0.1], in_key="y"),
        initial=ClonedPrior(AroundState([0.0, 0.0, 0.0, 1.0, 0.1], ensemble_size=200), lags=2),
        resampling="soft",
    )
    frames = TensorDict({"y": torch.zeros(2, 6, 2), "state": torch.zeros(2, 6, 5)}, [2, 6])
    frames["observed"] = torch.ones(2, 6, 1, dtype=torch.bool)
    frames["steps"] = torch.ones(2, 6, 1, dtype=torch.int64)
    frames["observed"][:, 3] = False
    frames["steps"][:, 4] = 2
    frames["y"][..., 0] = frames["state"][..., 3] = 10.0  # 1 m a step
    frames["y"][:, 4] = torch.tensor([20.0, 0.0])  # over two steps
    out = filter.sequence(frames.copy())
    ensemble = out["belief", "ensemble"]
    assert ensemble.shape == (2, 6, 200, 9)
    # The pose of every particle is the sum of its own velocities: of this step and the two before it.
    moved = 0.1 * (ensemble[:, 5, :, 4] + ensemble[:, 5, :, 6] + ensemble[:, 5, :, 8])
    start = ensemble[:, 5, :, 2] - moved
    known = out["belief", "ensemble"][:, 2, :, 2]
    assert (start.unsqueeze(-1) - known.unsqueeze(-2)).abs().min(-1).values.max() < 1e-5
    # Steps of noise 1 m/s and readings of 0.5 m/s leave a standard deviation of some 0.5 m/s.
    assert ((out["belief", "mean"][:, 1:, 3] - 10).abs() < 2).all()
