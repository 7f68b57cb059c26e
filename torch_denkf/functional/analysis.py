"""The measurement update of an ensemble Kalman filter: four schemes, each in two equivalent spaces.

With Y = R^-1/2 HA / sqrt(E − 1) the innovation covariance of eq. 9 is S = R^1/2 (I + YᵀY) R^1/2 (members
are rows here), and every scheme needs only the O x O matrix I + YᵀY or, by Woodbury's identity, the E x E
matrix I + YYᵀ. Nothing of size S x S is ever formed, and in ensemble space nothing of size O x O.

Sources: the paper's eqs. 6 to 12 ("sensor"); Burgers et al. 1998 ("perturbed"); Bishop et al. 2001 and
Hunt et al. 2007 ("etkf"); Sakov & Oke 2008, Tellus A 60 ("sakov").
"""

from __future__ import annotations

import math
from functools import partial
from typing import Literal, NamedTuple, get_args

import torch
from torch import Tensor

from torch_denkf._checks import check_choice, check_ensemble, check_observed, check_one_dtype, check_shape, check_shapes
from torch_denkf.functional._ensemble_space import analyse_in_tiles, columns_in_a_tile, solve_ensemble_space
from torch_denkf.functional._whitened import Whitened, scores, shift, whiten
from torch_denkf.functional.kernels.small_system import WrittenOut, identity_of, is_written_out, on_gpu
from torch_denkf.functional.linalg import Solver, inverse_square_root_difference

Scheme = Literal["sensor", "perturbed", "etkf", "sakov"]
Space = Literal["auto", "observation", "ensemble"]


class Analysis(NamedTuple):
    """Holds the results of :func:`analyse`.

    Attributes:
        ensemble: the analysis ensemble X_{t|t}, ``[*B, E, S]``, in the state's units.
        innovation: mean observation minus mean predicted observation, ``[*B, O]``; 0 where unobserved.
        nis: the normalised innovation squared, innovationᵀ S⁻¹ innovation over the observed components,
            ``[*B, 1]``, no unit; its expectation is their number if the filter is consistent.
        log_likelihood: log N(innovation; 0, S) over the observed components, ``[*B, 1]``; 0 where nothing
            is observed.
    """

    ensemble: Tensor
    innovation: Tensor
    nis: Tensor
    log_likelihood: Tensor


def analyse(
    forecast: Tensor,
    predicted: Tensor,
    observation: Tensor,
    noise: Tensor,
    *,
    scheme: Scheme = "sensor",
    observed: Tensor | None = None,
    perturbation: Tensor | None = None,
    rotation: Tensor | None = None,
    taper: tuple[Tensor, Tensor] | None = None,
    significance: float | Tensor | None = None,
    space: Space = "auto",
) -> Analysis:
    """Conditions a forecast ensemble on an observation.

    Members are rows. A are their deviations from the mean, HA those of their predictions, and W = HA R^-1/2 / √(E − 1).
    With the gain K = AᵀHA S⁻¹ / (E − 1) (eq. 11) and d = mean observation − mean prediction:

    * ``"sensor"``: xⁱ + K (ỹⁱ − Hxⁱ), with the sensor's own samples ỹⁱ (the paper's eq. 12);
    * ``"perturbed"``: xⁱ + K (y + εⁱ − Hxⁱ) with εⁱ ~ N(0, R), the classical stochastic filter;
    * ``"etkf"``: mean x̄ + K d, deviations (I + WWᵀ)^-1/2 A, the symmetric square root: it has exactly the
      covariance of the Kalman update;
    * ``"sakov"``: mean x̄ + K d, deviations A − HA Kᵀ / 2, its approximation for small gains.

    The last three use the mean of the observation if they are given samples.

    Args:
        forecast: X_{t|t-1}, ``[*B, E, S]`` with E >= 2, in the state's units.
        predicted: the observation each member predicts, HX, ``[*B, E, O]``, in the sensor's units.
        observation: samples of it, ``[*B, E, O]``, or one value, ``[*B, O]`` (told apart by their number
            of dimensions), in the sensor's units.
        noise: variances R, ``[*B, O]``, positive, in the sensor's units squared.
        scheme: one of the four above.
        observed: boolean, ``[*B, 1]`` or ``[*B, O]``; components with False are left out of the update, whatever the
            values of their observation and noise, NaN included. An ensemble with no observed component is returned
            unchanged. None: everything is observed.
        perturbation: standard normal draws for ``"perturbed"``, ``[*B, E, O]``; they are centred over the
            members and rescaled by sqrt(E / (E − 1)), which keeps their variance. None: drawn here.
        rotation: orthogonal matrices that keep the vector of ones, ``[*B, E, E]``, applied to the
            analysis anomalies of ``"etkf"`` (:func:`~torch_denkf.functional.inflation.random_rotation`).
        taper: localisation: factors in [0, 1] on the sample covariances of state and predicted observation
            ``[*B, S, O]`` and of the predicted observations ``[*B, O, O]``, before anything is solved (Houtekamer
            & Mitchell 2001). Batch dimensions may be left out. Not for ``"etkf"``; needs observation space.
        significance: localisation by sample correlations, see :func:`significant`: the number of standard deviations,
            such as 3, that a sample correlation must be away from zero to be used. ``None`` uses all. The
            components of the reading are then assimilated one after the other, each with the correlations after the
            update before it (Whitaker & Hamill 2002; Anderson 2003). Needs observation space.
        space: where to solve: ``"observation"`` costs O(O³ + O E S), ``"ensemble"`` O(E³ + E² (S + O));
            ``"auto"`` takes observation space if O < E: the smaller system is also the accurate one. Without
            gradients, ensemble space processes large states in tiles: it needs memory for the result and a few tiles.

    Returns:
        An :class:`Analysis`; all NaN for batch elements whose system is not positive definite.

    Raises:
        ValueError: for shapes that do not fit, an unknown scheme or space, ``"sensor"`` without samples,
            or a perturbation, rotation or taper for a scheme or a space that does not use it.

    Examples:
        Two members at -1 and 1, observed directly with variance 2, equal to their own: the update goes half-way.

        >>> import torch
        >>> ensemble = torch.tensor([[-1.0], [1.0]])
        >>> result = analyse(ensemble, ensemble, torch.tensor([4.0]), torch.tensor([2.0]), scheme="etkf")
        >>> print(f"{result.ensemble.mean():.2f} {result.ensemble.var():.2f}")
        2.00 1.00
    """
    given = forecast, predicted, observation, noise
    check_analysis_arguments(*given, scheme, observed, perturbation, rotation, taper, significance, space)
    size, dim = predicted.shape[-2:]
    in_observation_space = space == "observation" or (
        space == "auto" and (dim < size or taper is not None or significance is not None)
    )
    columns = None if in_observation_space else columns_in_a_tile(*given, perturbation)
    if columns is not None:
        tiled = partial(analyse_in_tiles, scheme=scheme, columns=columns, rotation=rotation)
        return Analysis(*tiled(*given, observed=observed, perturbation=perturbation))

    if on_gpu(forecast) and scheme == "sensor" and in_observation_space and taper is None and significance is None:
        return _in_few_launches(*given, observed)
    samples = observation if observation.ndim == forecast.ndim else observation.unsqueeze(-2)
    reading = whiten(predicted, samples, noise, observed)  # eqs. 6 to 8
    mean = forecast.mean(-2, keepdim=True)
    anomalies = forecast - mean  # A, eq. 10
    acted_on = shift(scheme, reading, observed, perturbation)
    # Both spaces solve with S, eq. 9, in units of the noise; the increment is K, eq. 11, times the innovations.
    if significance is not None:
        believed = partial(_one_after_the_other, scheme=scheme, taper=taper, significance=significance)
        increment, root, square, log_det = believed(reading, anomalies, acted_on)
    else:
        solve = partial(_observation_space, taper=taper) if in_observation_space else _ensemble_space
        increment, root, square, log_det = solve(reading, anomalies, acted_on, square_root=scheme == "etkf")
    if root is not None and rotation is not None:
        root = rotation @ root
    ensemble = forecast + increment if root is None else mean + increment + root  # eq. 12

    count: int | Tensor = dim
    if observed is not None:
        count = observed.expand(noise.shape).sum(-1, keepdim=True, dtype=noise.dtype)
        ensemble = torch.where((count > 0).unsqueeze(-1), ensemble, forecast)
    log_noise = reading.noise.log().sum(-1, keepdim=True)
    return Analysis(ensemble, reading.innovation.squeeze(-2), *scores(square, log_det, log_noise, count, size))


def _in_few_launches(
    forecast: Tensor, predicted: Tensor, samples: Tensor, noise: Tensor, observed: Tensor | None
) -> Analysis:
    """Updates with samples of the reading, for a GPU: one mean, one difference and one product for all entries."""
    size, dim = predicted.shape[-2:]
    count: int | Tensor = dim
    if observed is not None:
        members = observed.unsqueeze(-2)
        predicted, samples = torch.where(members, predicted, 0), torch.where(members, samples, 0)
        noise = torch.where(observed, noise, 1)
        count = observed.expand(noise.shape).sum(-1, keepdim=True, dtype=noise.dtype)
    shift = samples - predicted
    joint = torch.cat([predicted, forecast], -1)
    anomalies = joint - joint.mean(-2, keepdim=True)
    gram, cross = (anomalies[..., :dim].mT @ anomalies).split([dim, forecast.shape[-1]], -1)
    noise = torch.where(identity_of(gram, torch.bool), noise.unsqueeze(-1), 0)  # R may be infinite
    solver = Solver(torch.add(gram, noise, alpha=size - 1))  # (E - 1) S, eq. 9
    gain = solver.solve(cross)  # eqs. 11 and 12
    ensemble = torch.baddbmm(forecast, shift, gain) if shift.ndim == 3 else forecast + shift @ gain
    if observed is not None:
        ensemble = torch.where(observed.any(-1)[..., None, None], ensemble, forecast)
    innovation = shift.mean(-2)
    nis = (size - 1) * solver.square(innovation.unsqueeze(-1))
    constant = 0.5 * dim * math.log(size - 1) - 0.5 * math.log(2 * math.pi) * count
    return Analysis(ensemble, innovation, nis, torch.rsub(nis + solver.log_det(), constant, alpha=0.5))


def check_analysis_arguments(
    forecast, predicted, observation, noise, scheme, observed, perturbation, rotation, taper, significance, space
) -> None:
    """Raises for arguments of :func:`analyse` that do not fit each other."""
    batch, size, dim = forecast.shape[:-2], forecast.shape[-2:-1], predicted.shape[-1:]
    each, single = (*batch, *size, *dim), (*batch, *dim)
    fits = forecast.ndim > 1 and predicted.shape == each and noise.shape == single and size[0] > 1
    fits = fits and observation.shape in (each, single) and forecast.is_floating_point()
    if not fits or not forecast.dtype == predicted.dtype == observation.dtype == noise.dtype:
        _check_entries(forecast, predicted, observation, noise)
    (size,), (dim,) = size, dim
    check_choice("scheme", scheme, get_args(Scheme))
    check_choice("space", space, get_args(Space))
    if scheme == "sensor" and observation.ndim != forecast.ndim:
        raise ValueError(
            f"scheme 'sensor' needs one observation per member, [*B, E, O], got {list(observation.shape)}; "
            "use 'perturbed', 'etkf' or 'sakov' for a single observation"
        )
    if observed is not None:
        check_observed(observed, batch, dim)
    if perturbation is not None:
        if scheme != "perturbed":
            raise ValueError(f"perturbation is for scheme 'perturbed', not {scheme!r}; leave it out")
        check_shape("perturbation", perturbation, (*batch, size, dim), "[*B, E, O]")
    if taper is not None:
        if scheme == "etkf" or space == "ensemble":
            raise ValueError(f"taper is not for scheme 'etkf' nor for ensemble space, got {scheme!r}, {space!r}")
        for name, value, rows in zip(("state", "observation"), taper, (forecast.shape[-1], dim), strict=True):
            if value.shape[-2:] != (rows, dim):
                raise ValueError(f"the {name}'s taper must be [*B, {rows}, {dim}], got {list(value.shape)}")
    if significance is not None and space == "ensemble":
        raise ValueError("significance needs observation space; leave space out")
    if significance is not None:
        check_significance(significance, size)
    if rotation is not None:
        if scheme != "etkf":
            raise ValueError(f"rotation is for scheme 'etkf', not {scheme!r}; leave it out")
        check_shape("rotation", rotation, (*batch, size, size), "[*B, E, E]")


def _check_entries(forecast: Tensor, predicted: Tensor, observation: Tensor, noise: Tensor) -> None:
    check_ensemble("forecast", forecast, min_size=2)
    check_one_dtype(forecast=forecast, predicted=predicted, observation=observation, noise=noise)
    if predicted.ndim < 2:
        raise ValueError(f"predicted must be [*B, E, O], got {list(predicted.shape)}")
    batch, size, dim = forecast.shape[:-2], forecast.shape[-2], predicted.shape[-1]
    samples = observation.ndim == forecast.ndim
    if samples and observation.shape[-2] != size:
        raise ValueError(
            f"observation must be [*B, E, O], a sample for each of E = {size} members, got {observation.shape[-2]} "
            "samples; give the sensor the ensemble_size of the initial belief"
        )
    each, single = ((*batch, size, dim), "[*B, E, O]"), ((*batch, dim), "[*B, O]")
    check_shapes(
        ("predicted", predicted, *each),
        ("noise", noise, *single),
        ("observation", observation, *(each if samples else single)),
    )


def _observation_space(
    reading: Whitened,
    anomalies: Tensor,
    acted_on: Tensor,
    *,
    square_root: bool,
    taper: tuple[Tensor, Tensor] | None = None,
) -> tuple[Tensor, Tensor | None, Tensor, Tensor]:
    """Solves with I + YᵀY, O x O.

    Returns:
        The increment of each member, ``[*B, E, S]`` or ``[*B, 1, S]``; the square root's anomalies,
        ``[*B, E, S]``, if asked for; mean_shift (I + YᵀY)⁻¹ mean_shiftᵀ and log det (I + YᵀY), ``[*B, 1]``.
    """
    normalised, mean_shift = reading.normalised, reading.mean_shift
    gram, cross = normalised.mT @ normalised, normalised.mT @ anomalies
    if taper is not None:
        gram, cross = gram * taper[1], cross * taper[0].mT
    transformed = None
    if square_root:
        transformed = anomalies + normalised @ (inverse_square_root_difference(gram) @ cross)
    solver = (WrittenOut if is_written_out(gram) else Solver)(gram, ridge=1)  # with S, eq. 9
    increment = solver.between(acted_on, cross)  # by the gain K, eq. 11
    return increment, transformed, solver.square(mean_shift.mT), solver.log_det()


def _one_after_the_other(
    reading: Whitened,
    anomalies: Tensor,
    acted_on: Tensor,
    *,
    scheme: Scheme,
    taper: tuple[Tensor, Tensor] | None,
    significance: float | Tensor,
) -> tuple[Tensor, Tensor | None, Tensor, Tensor]:
    """Assimilates the components of the reading one after the other, with their significant correlations only.

    A single component needs no matrix, and no product of factors with a matrix, which might not be positive definite.
    The predictions of later components are updated like the state.

    Returns:
        As :func:`_observation_space`; anomalies of the members for all but the stochastic schemes.
    """
    dim, threshold = anomalies.shape[-1], significance
    if isinstance(threshold, Tensor) and threshold.ndim:  # [S]: predicted readings use their mean
        threshold = torch.cat([threshold, threshold.mean().expand(reading.normalised.shape[-1])])
    deterministic = scheme in ("etkf", "sakov")
    acted_on = reading.mean_shift if deterministic else acted_on
    whole = torch.cat([anomalies, reading.normalised], -1)  # the state and its predicted reading
    moved = torch.zeros_like(acted_on[..., :1])
    square = log_det = torch.zeros_like(reading.mean_shift[..., 0])
    for number in range(reading.normalised.shape[-1]):
        place = slice(dim + number, dim + number + 1)
        seen = whole[..., place]  # in units of the noise: R is 1
        cross, total = seen.mT @ whole, 1 + seen.square().sum(-2, keepdim=True)
        gain = cross * significant(cross, seen, whole, threshold) / total
        if taper is not None:
            gain = gain * torch.cat([taper[0][..., number], taper[1][..., number]], -1).unsqueeze(-2)
        shift = acted_on[..., number : number + 1] - (moved[..., place] if number else moved)
        mean_shift = shift.mean(-2, keepdim=True)
        square = square + (mean_shift.square() / total).squeeze(-1)
        log_det = log_det + total.log().squeeze(-1)
        moved = moved + shift * gain
        if deterministic:  # the square root's share of the gain, and its approximation for small gains
            whole = whole - seen * gain * (1 / (1 + total.rsqrt()) if scheme == "etkf" else 0.5)
        else:
            whole = whole + (shift - mean_shift) * gain
    return moved[..., :dim], whole[..., :dim] if deterministic else None, square, log_det


def check_significance(threshold: float | Tensor | None, size: int) -> None:
    """Raises a ``ValueError`` if no correlation of E members can be significant."""
    if threshold is not None and not isinstance(threshold, Tensor) and threshold**2 >= size - 1:
        raise ValueError(
            f"With {size} members no correlation is {threshold:g} standard deviations away from chance: the largest is "
            f"{math.sqrt(size - 1):.1f}. Take a smaller threshold, or more than {math.floor(threshold**2) + 1} members."
        )


def significant(cross: Tensor, predicted: Tensor, state: Tensor, threshold: float | Tensor) -> Tensor:
    r"""Computes the localisation factor of sample covariances by significance, :math:`\max(0, 1 - (z_0 / z)^2)`.

    The sample correlation r of two independent components of E members is not zero: its standard deviation is
    :math:`1 / \sqrt{E - 1}`. So :math:`z = |r| \sqrt{E - 1}` measures the significance of r. Each update multiplies
    a gain by this factor, so that correlations by chance have no effect. With fast sensors, thousands of such updates
    would otherwise shrink components about which the readings have no information. With many members the factor is 1.

    Correlation-based localisation: Anderson, Monthly Weather Review 140, 2012; Luo & Bhakta, Computational Geosciences
    24, 2020; Vishny, Morzfeld, Gwirtz, Bach, Dunbar & Hodyss, JAMES 16, 2024. This factor is smooth.

    Gradients reach the threshold, which may be trained, and not the anomalies: for them the factor is a constant, as a
    taper is. Near the threshold, where correlations are due to chance, its slope is steepest: training a filter of a
    robot arm with 64 members with these gradients diverged. So with several readings the threshold's gradient ignores
    how the first ones change the correlations for the later ones.

    Args:
        cross: products of the anomalies, ``[*B, O, S]``.
        predicted: anomalies of the predicted observations, ``[*B, E, O]``, in any unit.
        state: anomalies of the state, ``[*B, E, S]``.
        threshold: :math:`z_0`, positive, one number or ``[S]``, below :math:`\sqrt{E - 1}`, the largest z.

    Returns:
        Factors in [0, 1), ``[*B, O, S]``.

    Example:
        >>> anomalies = torch.tensor([[-1.0, 1.0], [0.0, -2.0], [1.0, 1.0]])  # two uncorrelated components
        >>> significant(anomalies[:, :1].mT @ anomalies, anomalies[:, :1], anomalies, 1.0)
        tensor([[0.5000, 0.0000]])
    """
    cross, predicted, state = cross.detach(), predicted.detach(), state.detach()
    spread = predicted.square().sum(-2).unsqueeze(-1) * state.square().sum(-2, keepdim=True)
    limit = threshold**2 * spread / (state.shape[-2] - 1)
    explained = cross.square()
    chance = explained <= limit  # False for a NaN threshold, which reaches the result
    return torch.where(chance, 0, 1 - limit / torch.where(chance, 1, explained))


def _ensemble_space(
    reading: Whitened, anomalies: Tensor, acted_on: Tensor, *, square_root: bool
) -> tuple[Tensor, Tensor | None, Tensor, Tensor]:
    """Solves with I + YYᵀ, E x E; the results equal those of :func:`_observation_space`."""
    y = reading.normalised
    weights, root, log_det = solve_ensemble_space(y @ y.mT, y @ acted_on.mT, square_root=square_root)
    mean_weights = weights.mean(-2, keepdim=True)
    # dᵀ(I + YᵀY)⁻¹d is the minimum over w of |d - Yᵀw|² + |w|²: nothing cancels.
    residual = reading.mean_shift - mean_weights @ y
    square = residual.square().sum(-1) + mean_weights.square().sum(-1)
    return weights @ anomalies, None if root is None else root @ anomalies, square, log_det
