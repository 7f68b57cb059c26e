"""Small filters for tests; importable, so that worker processes find them."""

import torch
from tensordict import TensorDict
from torch import nn

from torch_denkf.compilation import need_compiler
from torch_denkf.filters import DEnKF, Filter, KalmanFilter
from torch_denkf.functional import analyse
from torch_denkf.functional.moments import ensemble_mean, ensemble_var
from torch_denkf.modules import EnsembleAnalysis, GaussianPrior, Initial, StochasticMLP, Transition, Update
from torch_denkf.modules.noise import ConstantNoise, DiagonalNoise
from torch_denkf.modules.observation import LearnedObservation, LinearObservation
from torch_denkf.modules.sensor import VectorSensor
from torch_denkf.modules.transition import LearnedTransition

S, M, OBS, A, E = 3, 4, 2, 2, 4  # state, measurement, observation, action, members


def toy_denkf(scheme="sensor", layer="dropout", *, sensor_layer="dropout", ensemble_size=E, action=True, **kwargs):
    """Returns four learned sub-models on a vector measurement and an action."""
    initial, in_key = kwargs.pop("initial", None), kwargs.pop("in_key", "measurement")
    return DEnKF(
        transition=LearnedTransition(
            StochasticMLP(S + A * action, S, (8, 8), layer=layer, rate=0.3, output_gain=0.5),
            action_key="action" if action else None,
        ),
        sensor=VectorSensor(
            M, OBS, ensemble_size=ensemble_size, num_cells=(8,), layer=sensor_layer, rate=0.5, in_key=in_key
        ),
        observation=LearnedObservation(StochasticMLP(S, OBS, (8,), layer="none")),
        noise=DiagonalNoise(OBS, r=0.5, num_cells=(4,)),
        analysis=EnsembleAnalysis(scheme),
        initial=GaussianPrior(torch.zeros(S), torch.ones(S), ensemble_size=ensemble_size)
        if initial is None
        else initial,
        **kwargs,
    )


def random_draws(filter):
    """Returns the filter, whose noise is used as it was drawn: what an oracle computes from the draws holds for it."""
    for module in filter.modules():
        if hasattr(module, "exact"):
            module.exact = False
    return filter


def toy_frames(batch, *, masks=1, resets=True):
    """Measurements, actions, masks of width ``masks`` and starts that differ between rows, for ``[*B, T]``."""
    frames = TensorDict({"measurement": torch.randn(*batch, M), "action": torch.randn(*batch, A)}, batch)
    if masks:
        frames["observed"] = torch.rand(*batch, masks) < 0.7
    if resets:
        frames["is_init"] = torch.rand(*batch, 1) < 0.2
        frames["is_init"][..., 0, :] = True
    return frames


class NoisyLinear(Transition):
    """x' = F x + B a + N(0, Q) for every member; without ``root`` deterministic."""

    def __init__(self, matrix, root=None, control=None):
        keys = [("belief", "ensemble")] + ["action"] * (control is not None)
        super().__init__(nn.Identity(), keys, [("forecast", "ensemble")])
        self.noise_names = () if root is None else ("",)
        self.register_buffer("matrix", matrix)
        self.register_buffer("root", root)
        self.register_buffer("control", control)

    def draw_noise(self, batch_size, *, members=None, device=None, dtype=None, generator=None, **_):
        if self.root is None or members is None:
            return None
        shape = (*batch_size, members, self.matrix.shape[0])
        return torch.randn(shape, device=device, dtype=dtype, generator=generator)

    def noise_sizes(self, state, *_):
        return {"members": state.shape[-2]}

    def compute(self, state, action=None, *, noise):
        out = state @ self.matrix.mT
        if action is not None:
            out = out + (action @ self.control.mT).unsqueeze(-2)
        return out if noise is None else out + noise @ self.root.mT


class FixedEnsemble(Initial):
    """An initial belief without randomness: always the same members."""

    def __init__(self, members):
        super().__init__(nn.Identity(), [], [("belief", name) for name in ("ensemble", "mean", "var")])
        self.register_buffer("members", members)
        self.ensemble_size, self.state_dim = members.shape

    def compute(self, *, batch_size):
        ensemble = self.members.expand(*batch_size, *self.members.shape)
        return ensemble, ensemble_mean(ensemble), ensemble_var(ensemble)


class Perturbed(Update):
    """A stochastic analysis as a user writes it, with or without a mask."""

    noise_names = ("",)

    def __init__(self, *, masked=False, reading="observation", info="info"):
        reads = [("forecast", "ensemble"), ("forecast", "observation"), reading, ("sensor", "noise")]
        writes = [("belief", name) for name in ("ensemble", "mean", "var")] + [
            (info, name) for name in ("innovation", "nis", "log_likelihood")
        ]
        super().__init__(nn.Identity(), reads, writes, optional_keys=["observed"] if masked else [])
        self.reading_keys, self.info_prefix = self.in_keys[2:], info

    def draw_noise(self, batch_size, *, members=None, observation_dim=None, device=None, dtype=None, **_):
        if members is None or observation_dim is None:
            return None
        return torch.randn(*batch_size, members, observation_dim, device=device, dtype=dtype)

    def noise_sizes(self, forecast, predicted, *_):
        return {"members": forecast.shape[-2], "observation_dim": predicted.shape[-1]}

    def compute(self, forecast, predicted, reading, variance, observed=None, *, noise):
        ensemble, *rest = analyse(
            forecast, predicted, reading, variance, scheme="perturbed", observed=observed, perturbation=noise
        )
        return ensemble, ensemble_mean(ensemble), ensemble_var(ensemble), *rest


def linear_system(dtype=None):
    """F, Q, H, R (variances), all of two dimensions."""
    dtype = torch.get_default_dtype() if dtype is None else dtype
    return (
        torch.tensor([[0.9, 0.3], [-0.2, 0.8]], dtype=dtype),
        torch.tensor([[0.2, 0.05], [0.05, 0.1]], dtype=dtype),
        torch.tensor([[1.0, 0.5], [0.0, 1.0]], dtype=dtype),
        torch.tensor([0.5, 0.3], dtype=dtype),
    )


def linear_kalman(**kwargs):
    F, Q, H, R = linear_system()
    return KalmanFilter(
        F,
        H,
        process_noise_cov=Q,
        noise=R.sqrt(),
        mean=torch.tensor([1.0, -1.0]),
        cov=torch.diag(torch.tensor([1.0, 2.0])),
        **kwargs,
    )


def linear_denkf(scheme="etkf", *, ensemble_size=6, noisy=False, control=None, initial=None, r=None, **kwargs):
    """Returns an ensemble filter of :func:`linear_system`; without ``noisy`` or ``initial`` it is deterministic."""
    F, Q, H, R = linear_system()
    generator = torch.Generator().manual_seed(0)
    members = torch.randn(ensemble_size, 2, generator=generator, dtype=F.dtype)
    return DEnKF(
        transition=NoisyLinear(F, torch.linalg.cholesky(Q) if noisy else None, control),
        sensor=None,
        observation=LinearObservation(H),
        noise=ConstantNoise(R.sqrt() if r is None else r, in_key="observation"),
        analysis=EnsembleAnalysis(scheme, observation_key="observation"),
        initial=FixedEnsemble(members) if initial is None else initial,
        **kwargs,
    )


def believing(threshold, **kwargs):
    """Makes a filter that localises by significance."""
    analysis = EnsembleAnalysis("etkf", observation_key="observation", localisation="significance", threshold=threshold)
    return linear_denkf(**kwargs).with_modules(analysis=analysis)


def linear_with(modules, *, analysis=None, initial=None, **options):
    """Returns the filter of :func:`linear_denkf` with other modules in front, or instead of those of the same name."""
    plain = linear_denkf()
    parts = {**modules, **{name: plain[name] for name in ("noise", "transition", "observation") if name not in modules}}
    parts.setdefault("analysis", plain["analysis"] if analysis is None else analysis)
    return Filter(parts, initial=plain.initial if initial is None else initial, **options)


def parts_of_reading(index, before, after, scheme="etkf", **kwargs):
    """Returns noise ``r``, observation ``h`` and analysis ``a`` of one reading, between two ensemble prefixes."""
    _, _, H, R = linear_system()
    return {
        f"r{index}": ConstantNoise(R[[index]].sqrt(), in_key=f"y{index}", out_key=f"r{index}"),
        f"h{index}": LinearObservation(H[[index]], in_key=(before, "ensemble"), out_key=f"p{index}"),
        f"a{index}": EnsembleAnalysis(
            scheme,
            forecast_key=(before, "ensemble"),
            predicted_key=f"p{index}",
            observation_key=f"y{index}",
            noise_variance_key=f"r{index}",
            belief_prefix=after,
            **kwargs,
        ),
    }


def random_walk(**kwargs):
    """x' = x + N(0, .25), read with N(0, 1) noise, from N(0, 1)."""
    one = torch.eye(1)
    return KalmanFilter(one, one, process_noise=[0.5], noise=[1.0], mean=torch.zeros(1), cov=one, **kwargs)


def assert_equal(first, second, keys, *, atol=0.0):
    for key in keys:
        torch.testing.assert_close(first[key], second[key], rtol=0, atol=atol, msg=lambda m, k=key: f"{k}: {m}")


def stepwise(filter, frames):
    """Takes single steps as in an environment; equals ``filter.sequence(frames)``."""
    time = frames.ndim - 1
    rows, out = frames.unbind(time), []
    for t, row in enumerate(rows):
        row = row.copy()
        if row.get("action", None) is not None:
            row["action"] = rows[max(t - 1, 0)]["action"]
        carry = out[-1] if out else filter.initialise(row.copy())
        for key in filter.carry_keys:
            row[key] = carry[key]
        out.append(filter(row))
    return torch.stack([row.exclude("action", "next") for row in out], time)


def make_dyadic(module):
    """Rounds weights to multiples of 1/16, so that sums of their products with such numbers are exact.

    A frame module runs on [B, T] frames in a sequence and on [B] in a step, and a matrix product may sum in another
    order for another number of rows. Sums without rounding do not depend on the order.
    """
    with torch.no_grad():
        for parameter in module.parameters():
            parameter.copy_((parameter * 16).round() / 16)


def has_compiler():
    """Tells if inductor finds a C++ compiler."""
    try:
        need_compiler()
    except RuntimeError:
        return False
    return True
