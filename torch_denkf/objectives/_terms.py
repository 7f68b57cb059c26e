"""The terms of the library's losses, and the scores that they use: for members, for particles and for a Gaussian.

Errors are zero without a label; a score is over the components that have one.
"""

from __future__ import annotations

import math

import torch
from tensordict import NestedKey
from torch import Tensor, nn

from torch_denkf import beliefs
from torch_denkf.functional import crps_ensemble, crps_gaussian
from torch_denkf.functional.gaussian import gaussian_log_prob
from torch_denkf.functional.linalg import as_covariance
from torch_denkf.functional.scores import energy_score
from torch_denkf.functional.weighted import weighted_mean
from torch_denkf.modules import StochasticMLP
from torch_denkf.objectives._labels import Labels, Targets, check_row_mask, mean_of
from torch_denkf.objectives.filter_loss import FilterLoss, Term

MEMBER_SCORES = ("crps", "energy", "mse")
GAUSSIAN_SCORES = ("crps", "nll", "mse")

#: The objective for each kind of belief, for messages.
BELIEFS = (
    "DEnKFLoss scores members of equal weight, MixtureLoss particles with weights, GaussianLoss a mean and a "
    "covariance. "
)


class OfBelief(Term):
    """A term for a belief, a forecast or a smoothed belief, which is stored under the loss's key named ``key``."""

    def __init__(self, name: str, key: str, weight: float = 1.0):
        self.name, self.key = name, key
        super().__init__(weight)

    def place(self, truth: Targets) -> NestedKey:
        """Returns the key of the belief."""
        return getattr(truth.keys, self.key)


class Members(OfBelief):
    """The score of members of equal weight."""

    def forward(self, out, truth):
        filter = truth.loss.filter
        weights = [kind.key("log_weight") for kind in filter.structure.kinds if isinstance(kind, beliefs.Particles)]
        if weights:
            raise TypeError(
                f"DEnKFLoss scores members of equal weight, but those of this {type(filter).__name__} have weights, "
                f'{weights[0]!r}. Use MixtureLoss, with score="crps" for the score of this loss'
            )
        return score_ensemble(truth, truth.entry(self.place(truth), BELIEFS))


class Moments(OfBelief):
    """The score of a mean and a covariance."""

    def forward(self, out, truth):
        mean, cov = (truth.entry((self.place(truth), name), BELIEFS) for name in ("mean", "cov"))
        return score_moments(truth, mean, cov)


class Particles(OfBelief):
    """The score of weighted particles."""

    def forward(self, out, truth):
        errors, log_weights, labels = self.errors(truth)
        std = labels.in_all_components("component_std", truth.loss.component_std)
        return score_mixture(errors, labels.mask, log_weights, truth.loss.score, std, labels.scale), labels.rows

    def errors(self, truth: Targets) -> tuple[Tensor, Tensor, Labels]:
        """Returns errors of the particles ``[*B, T, E, S]``, their log-weights ``[*B, T, E]`` and the labels."""
        place = self.place(truth)
        particles = truth.entry((place, "ensemble"), BELIEFS)
        log_weights = truth.out.get((place, "log_weight"), None)
        if log_weights is None:
            log_weights = torch.full_like(particles[..., 0], -math.log(particles.shape[-2]))
        labels = truth.state(particles.shape[-1])
        return labels.errors(particles, log_weights.softmax(-1), each=self.each(truth)), log_weights, labels

    def each(self, truth: Targets) -> bool:
        """Tells whether errors are taken in the tangent space at the truth, as for the mixture's density."""
        return truth.loss.score == "mixture"


class Mean(Particles):
    """The squared error of the particles' mean."""

    def forward(self, out, truth):
        errors, log_weights, labels = self.errors(truth)
        # The mean of errors, because angles on both sides of pi have no mean.
        return labels.mean(weighted_mean(errors, log_weights).square()), labels.rows

    def each(self, truth):
        """Returns False."""
        return False


class Sensor(Term):
    """The score of a sensor's samples against the true observation."""

    name = "sensor"
    of_frames = True

    def forward(self, out, truth):
        samples, labels = sensor_samples(truth)
        # Samples have no density: for scores of the state by density, samples are scored by their CRPS.
        score = truth.loss.score if truth.loss.score in ("mse", "energy") else "crps"
        return score_members(labels.errors(samples), labels.mask, score), labels.rows

    def exists(self, loss: FilterLoss) -> bool:
        """Returns True if a module writes samples, or the user has set their key."""
        structure = loss.filter.structure
        samples = [*filter(beliefs.is_samples, structure.frame_keys)] or ("sensor", "ensemble") in structure.step_keys
        return loss.tensor_keys.sensor is not None or bool(samples)


class Noise(Term):
    """The negative log-likelihood of the true observation, given the samples' mean and R."""

    name = "noise"
    of_frames = True

    def forward(self, out, truth):
        samples, labels = sensor_samples(truth)
        noise = truth.entry(truth.keys.noise or truth.loss.reading.noise, "R must be computed from frames only. ")
        error = labels.errors(samples).mean(-2)
        return score_gaussian(error, labels.mask, as_covariance(noise, error), "nll", labels.scale), labels.rows


class Visible(Term):
    """The binary cross entropy of the sensor's visibility."""

    name = "visible"
    of_frames = True
    needs_state = False

    def forward(self, out, truth):
        p = truth.entry(truth.keys.visible, "A Visibility next to the sensor writes it. ")
        labels = truth.visible()
        target = labels.values.to(p.dtype)
        return labels.mean(nn.functional.binary_cross_entropy(p, target, reduction="none")), labels.rows


class Observation(Term):
    """The squared error of the observation model at the true state."""

    name = "observation"
    of_frames = True

    def forward(self, out, truth):
        model = truth.loss.reading.model
        if model is None:
            raise KeyError(
                "loss_observation is for a model with an observe() method, and the filter has no observation model "
                "with one, or one for each of several sensors: select one, set_keys(sensor=NAME). Or set the weight "
                "observation=0."
            )
        state = truth.whole_state()
        observation = model.observe(state.values)
        labels = truth.observation(truth.entry(truth.keys.target_observation, given=True), observation.shape[-1])
        labels = labels._replace(mask=labels.mask & state.mask)
        return labels.mean(labels.errors(observation).square()), labels.rows


class Likelihood(Term):
    """The negative log-likelihood of the readings."""

    name = "nll"
    needs_state = False

    def forward(self, out, truth):
        key = truth.keys.log_likelihood
        # The likelihoods of several analyses, each with its own readings, are multiplied.
        keys = truth.loss.filter.structure.likelihoods if key == truth.loss.default_keys.log_likelihood else []
        first, *others = [truth.entry(key) for key in keys or [key]]
        return -sum(others, first).squeeze(-1), None


class Divergence(Term):
    """The KL divergence of flipout weights from their prior."""

    name = "kl"
    needs_state = False

    def forward(self, out, truth):
        layers = (part for part in truth.loss.filter.modules() if isinstance(part, StochasticMLP))
        return sum((layer.kl() for layer in layers), torch.zeros(())), None


def score_members(errors: Tensor, mask: Tensor, score: str) -> Tensor:
    """Scores members by their ``errors``.

    One member is a point: the CRPS is its absolute error, the energy score the length of its error.
    Fair scores need at least two members.

    Args:
        errors: ``[*, E, N]``, in the units of the score.
        mask: components with a label, ``[*, N]``.
        score: ``"crps"``, fair, in each dimension, averaged; ``"energy"``, fair, of all dimensions together; ``"mse"``,
            the squared error of the mean.

    Returns:
        The scores, ``[*]``.

    Example:
        >>> score_members(torch.tensor([[-3.0]]), torch.tensor([True]), "crps")
        tensor(3.)
        >>> score_members(torch.tensor([[-1.0], [1.0]]), torch.tensor([True]), "crps")
        tensor(0.)
    """
    if score == "mse":
        return mean_of(errors.mean(-2).square(), mask)
    zero, fair = torch.zeros_like(errors[..., 0, :]), errors.shape[-2] > 1
    if score == "energy":
        return energy_score(errors, zero, fair=fair)
    return mean_of(crps_ensemble(errors, zero, fair=fair), mask)


def score_mixture(
    errors: Tensor, mask: Tensor, log_weights: Tensor, score: str, std: Tensor, scale: Tensor | None
) -> Tensor:
    """Scores weighted particles by their ``errors``.

    Args:
        errors: ``[*, E, N]``, divided by ``scale``.
        mask: components with a label, ``[*, N]``.
        log_weights: ``[*, E]``.
        score: ``"mixture"``, the negative log-density of all dimensions together in their own units, with a Gaussian
            around each particle; ``"crps"`` with weights, in each dimension, averaged.
        std: width of these Gaussians, ``[N]``.
        scale: ``[N]``; ``None`` for one.

    Returns:
        The scores, ``[*]``.
    """
    if score == "crps":
        return mean_of(crps_ensemble(errors, torch.zeros_like(errors[..., 0, :]), log_weights), mask)
    # The density of the unscaled state is the density of the scaled state, divided by all scales.
    width = std if scale is None else std * scale
    constant = torch.where(mask, width.log() + 0.5 * math.log(2 * math.pi), 0).sum(-1)
    log_density = log_weights - 0.5 * (errors / std).square().sum(-1)
    return constant - torch.logsumexp(log_density, -1)


def score_gaussian(errors: Tensor, mask: Tensor, cov: Tensor, score: str, scale: Tensor | None = None) -> Tensor:
    """Scores a Gaussian by the ``errors`` of its mean.

    Args:
        errors: ``[*, N]``, divided by ``scale``.
        mask: components with a label, ``[*, N]``.
        cov: ``[*, N, N]``, in its own units.
        score: ``"crps"`` in each dimension, averaged; ``"nll"``, the negative log-density of all dimensions together,
            in nats, in their own units; ``"mse"`` of the mean.
        scale: ``[N]``; ``None`` for one.

    Returns:
        The scores, ``[*]``.

    Example:
        >>> score_gaussian(torch.zeros(2), torch.tensor([True, False]), torch.eye(2), "nll")
        tensor(0.9189)
    """
    if score == "mse":
        return mean_of(errors.square(), mask)
    if scale is not None:
        cov = cov / scale.unsqueeze(-1) / scale
    zero = torch.zeros_like(errors)
    if score == "nll":
        # Components without a label are made independent and standard normal; their density at zero is subtracted
        # again. The result is a density of the unscaled errors: the scale only conditions the arithmetic.
        identity = torch.eye(cov.shape[-1], dtype=cov.dtype, device=cov.device)
        cov = torch.where(mask.unsqueeze(-1) & mask.unsqueeze(-2), cov, identity)
        units = zero if scale is None else scale.log().expand_as(errors)
        added = torch.where(mask, units, -0.5 * math.log(2 * math.pi))
        return added.sum(-1) - gaussian_log_prob(errors, zero, cov)
    # Without spread the CRPS is the absolute error; a spread of 1e-6 is nearly zero, and has a derivative.
    return mean_of(crps_gaussian(zero, cov.diagonal(dim1=-2, dim2=-1).clamp(min=1e-12), errors), mask)


def score_ensemble(truth: Targets, ensemble: Tensor) -> tuple[Tensor, Tensor]:
    """Scores members ``[*B, E, S]`` against the true state; also returns the label mask."""
    labels = truth.state(ensemble.shape[-1])
    return score_members(labels.errors(ensemble), labels.mask, truth.loss.score), labels.rows


def score_moments(truth: Targets, mean: Tensor, cov: Tensor) -> tuple[Tensor, Tensor]:
    """Scores a mean ``[*B, S]`` and a covariance ``[*B, S, S]`` against the true state; also returns the label mask."""
    labels = truth.state(mean.shape[-1])
    return score_gaussian(labels.errors(mean), labels.mask, cov, truth.loss.score, labels.scale), labels.rows


def sensor_samples(truth: Targets) -> tuple[Tensor, Labels]:
    """Returns the sensor's samples ``[*B, E, O]``, and their labels in observed rows.

    Raises:
        KeyError: if there are no samples, or no true observation.
    """
    keys, filter, data, reading = truth.keys, truth.loss.filter, truth.data, truth.loss.reading
    target, model = data.get(keys.target_observation, None), reading.model
    if target is None:
        if model is None or learns(model):
            named = sorted({key[1] for key in filter.structure.frame_keys if beliefs.is_samples(key) and key[2:]})
            several = "has no observation model with an observe() method, or several sensors, of which none is selected"
            several += f" (there are {named})" * bool(named)
            why = several if model is None else "learns its observation model"
            raise KeyError(
                f"loss_sensor needs the true observation in {keys.target_observation!r}, because the filter {why}. Add "
                "the entry, or rename it with set_keys(target_observation=...); select a sensor, set_keys(sensor=...); "
                "or set the weight sensor=0.0."
            )
        target = truth.observed_state(model.observe)
    written = [key for key in (*filter.structure.frame_keys, *filter.structure.step_keys) if beliefs.is_samples(key)]
    cure = f"The filter writes the samples {written}: select one of several sensors, or set the weight sensor=0.0. "
    samples = truth.entry(reading.samples, "" if reading.samples in written else cure)
    if samples.ndim == data.ndim + 1:
        samples = samples.unsqueeze(-2)
    labels = truth.observation(target, samples.shape[-1])
    observed = truth.out.get(reading.observed, None)
    if observed is not None:
        check_row_mask(reading.observed, observed, labels.values)
        labels = labels._replace(mask=labels.mask & observed.all(-1, keepdim=True))
    return samples, labels


def learns(model: nn.Module) -> bool:
    """Tells whether a model has parameters."""
    return any(True for _ in model.parameters())
