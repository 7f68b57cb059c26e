"""Monitors the innovations of a filter's sensors, and raises an alarm if a sensor is inconsistent."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from tensordict.utils import expand_as_right
from torch import Tensor, nn

from torch_denkf._checks import check_count, check_number
from torch_denkf.monitoring._calibration import (
    IDENTITY,
    check_observation_dim,
    chi_square_table,
    empirical_quantile,
    score_table,
    sign_limits,
)
from torch_denkf.monitoring.change_detection import cusum_step, cusum_threshold, normal_score
from torch_denkf.monitoring.chi_square import chi_square_p_value, detectable_bias
from torch_denkf.monitoring.innovation_tests import (
    InnovationWindow,
    innovation_tests,
    interpolate,
    observe,
)
from torch_denkf.monitoring.signs import floors
from torch_denkf.submodel import SubModel

__all__ = ["InnovationMonitor", "MonitoredSensor"]

_CLAIMS = 3  # steps over which the claimed noise is averaged
_STATE = ("terms", "last", "cusum", "claim", "p_value", "whiteness", "evidence")


class MonitoredSensor(NamedTuple):
    """Keys of a sensor's innovations.

    Attributes:
        info_prefix: prefix of ``innovation`` ``[*B, O]`` and ``nis`` ``[*B, 1]``; with several analyses, that of one
            analysis, such as ``("info", "camera_analysis")``; of a gated analysis its ``gate_prefix``.
        observation_dim: O.
        observed_key: optional observed mask ``[*B, 1]`` or ``[*B, O]`` of the analysis.
        noise_key: optional variances ``[*B, O]`` that the sensor reports, which are monitored, too.
        sign_key: optional signs of a fault ``[*B, K]``, see :class:`SignGate`, which are also read in steps without an
            observation.
        signs: K.
        floor: lower bounds of the signs' limits, one for all or one for each.
    """

    info_prefix: NestedKey
    observation_dim: int
    observed_key: NestedKey = "observed"
    noise_key: NestedKey | None = None
    sign_key: NestedKey | None = None
    signs: int = 0
    floor: float | Sequence[float] = 0.0


class InnovationMonitor(SubModel):
    r"""Tests the consistency of each sensor's innovations with the filter, and raises one alarm.

    * The *normalised innovation squared* :math:`d^T S^{-1} d`, summed over a window of observed steps: a chi-square
      variable while the filter is consistent.
    * A *cumulative sum* of the normal scores of single steps: the fastest test for a change of one size (Page 1954).
    * *Whiteness*: the correlation of successive normalised innovations over the window.
    * The *claimed noise*, for a sensor that has learned to report large variances when it sees nothing: its normalised
      innovations are then smaller than usual, not larger. The statistic is the mean score of three steps, and is used
      after :meth:`calibrate`.
    * *Signs* of any kind, such as the black share of an image: the largest of a step. They are also used after
      :meth:`calibrate`.

    Each is compared with its own distribution. A real filter's innovations have heavier tails than in theory, because
    of few members, model errors and coloured noise. :meth:`calibrate` estimates the distributions on clean data.

    The monitor is stateless: its state is under ``(monitor_prefix, sensor, ...)`` and is carried from step to step if
    :class:`~torch_denkf.monitoring.Monitored` puts the monitor into a filter. A step without an observation of a sensor
    does not change its entries.

    ============================== ========= ===========================================================================
    entry                          shape     content
    ============================== ========= ===========================================================================
    (key, sensor, ``p_value``)     ``[1]``   of the windowed normalised innovation squared
    (key, sensor, ``whiteness``)   ``[1]``   p-value of the correlation of successive innovations, two-sided
    (key, sensor, ``cusum``)       ``[1]``   cumulative sum, in standard normal numbers
    (key, sensor, ``claim``)       ``[3]``   scores of the claimed noise, the latest first
    (key, sensor, ``evidence``)    ``[1]``   the largest of all tests, as a multiple of its limit
    (key, ``alarm``)               ``[1]``   bool: some sensor's evidence exceeds 1
    (key, ``sensor``)              ``[1]``   int64: whose evidence is largest, by its place in ``sensors``; -1 without
                                             an alarm
    ============================== ========= ===========================================================================

    Args:
        sensors: keys of the sensors by name.
        window: length of the window in steps.
        false_alarm_rate: false alarms per step, divided equally among all tests of all sensors; for a cumulative sum it
            is the inverse of the average run length.
        reference: half of the shift that the cumulative sums detect fastest, in standard deviations of a step's score.
        largest: bound of a single step's score, so that several steps decide.
        ceiling: bound of the cumulative sums, as a multiple of their limits, which limits how long an alarm outlasts
            its cause.
        whiteness: whether the correlation of successive innovations may raise the alarm. A learned sensor with coloured
            errors fails this test on clean data.
        monitor_prefix: prefix of the outputs.

    Raises:
        ValueError: if a number is out of range, or there is no sensor.

    Example:
        >>> monitor = InnovationMonitor({"gps": MonitoredSensor("info", 2)}, window=10)
        >>> round(monitor.detectable_bias()["gps"], 2)  # standard deviations of the innovation
        2.14
    """

    p_limit: Tensor
    cusum_limit: Tensor
    claim_limit: Tensor
    whiteness_limit: Tensor
    tables: Tensor
    claims: Tensor

    def __init__(
        self,
        sensors: Mapping[str, MonitoredSensor],
        *,
        window: int = 10,
        false_alarm_rate: float = 1e-3,
        reference: float = 0.5,
        largest: float = 4.0,
        ceiling: float = 1.5,
        whiteness: bool = False,
        monitor_prefix: str = "monitor",
    ):
        if not sensors:
            raise ValueError("sensors names none; pass at least one, such as {'camera': MonitoredSensor('info', 2)}")
        check_count("window", window)
        check_number("false_alarm_rate", false_alarm_rate, above=0, below=0.5)
        check_number("reference", reference, above=0)
        check_number("largest", largest, above=reference)
        check_number("ceiling", ceiling, least=1)
        read: list[NestedKey] = []
        state: list[NestedKey] = []
        optional: list[NestedKey] = []
        for name, sensor in sensors.items():
            check_count(f"the observation_dim of {name!r}", sensor.observation_dim)
            info = unravel_key(sensor.info_prefix)
            info = (info,) if isinstance(info, str) else info
            read += [(*info, "nis"), (*info, "innovation")]
            read += [] if sensor.noise_key is None else [sensor.noise_key]
            state += [(monitor_prefix, name, entry) for entry in _STATE]
            optional.append(sensor.observed_key)
            optional += [] if sensor.sign_key is None else [sensor.sign_key]
        state += [(monitor_prefix, "alarm"), (monitor_prefix, "sensor")]
        super().__init__(nn.Identity(), [*read, *state], state, optional_keys=optional)
        self.sensors, self.state_keys, self.window = dict(sensors), list(self.out_keys), window
        self.false_alarm_rate, self.reference, self.largest = false_alarm_rate, reference, largest
        self.ceiling, self.whiteness, self.monitor_prefix = ceiling, whiteness, monitor_prefix
        further = sum((sensor.noise_key is not None) + (sensor.sign_key is not None) for sensor in sensors.values())
        count = len(sensors)
        self.share = false_alarm_rate / (count * (3 if whiteness else 2) + further)
        self.register_buffer("p_limit", torch.full((count,), self.share))
        self.register_buffer("whiteness_limit", torch.full((count,), self.share))
        self.register_buffer("cusum_limit", torch.full((count,), cusum_threshold(1 / self.share, reference)))
        self.register_buffer("claim_limit", torch.full((count,), torch.inf))
        self.register_buffer("tables", IDENTITY.repeat(count, 1, 1))
        self.register_buffer("claims", IDENTITY.repeat(count, 1, 1))
        for name, sensor in sensors.items():
            self.register_buffer(f"scale_{name}", torch.ones(sensor.observation_dim))
            if sensor.sign_key is not None:
                check_count(f"signs of {name!r}", sensor.signs)
                self.register_buffer(f"floor_{name}", floors(sensor.floor, sensor.signs))
                self.register_buffer(f"sign_limit_{name}", torch.full((sensor.signs,), torch.inf))

    # ------------------------------------------------------------------------------------------------------ one step

    def on_entries(self, entries, call):
        """Returns state, evidence and alarm after one more step."""
        written = {}
        for place, (name, sensor) in enumerate(self.sensors.items()):
            written.update(self._after(place, name, sensor, entries))
        sizes = [written[self.monitor_prefix, name, "evidence"] for name in self.sensors]
        most, which = torch.cat(sizes, -1).max(-1, keepdim=True)
        alarm = most > 1
        written[self.state_keys[-2]], written[self.state_keys[-1]] = alarm, torch.where(alarm, which, -1)
        return written

    def _after(self, place: int, name: str, sensor: MonitoredSensor, entries) -> dict:
        """Returns the entries of one sensor after one more step."""
        nis, innovation, noise, freedom = self._read(sensor, entries)
        keys = [(self.monitor_prefix, name, entry) for entry in _STATE]
        old = dict(zip(_STATE, (self.required(entries, key) for key in keys), strict=True))
        dtype = nis.dtype
        nis = interpolate(nis, *self.tables[place].to(dtype)).clamp_min(0)
        scale = getattr(self, f"scale_{name}").to(dtype)
        window = observe(InnovationWindow(old["terms"], old["last"]), nis, innovation, freedom, scale)
        tests, seen = innovation_tests(window), freedom > 0
        score = normal_score(chi_square_p_value(nis, freedom), self.largest)
        cusum = self._sum(old["cusum"], score, seen, self.cusum_limit[place])
        limits = [limit[place].to(dtype) for limit in (self.p_limit, self.whiteness_limit)]
        evidence = [cusum / self.cusum_limit[place], _logarithms(tests.p_value, limits[0])]
        claim = old["claim"]
        if noise is not None:
            # The reported noise jumps at once: with twice the bound, two steps decide.
            most = 2 * self.largest
            score = self.claim_score(name, noise).clamp(-most, most)
            claim = torch.where(seen, torch.cat([score, claim[..., :-1]], -1), claim)
            evidence.append(claim.mean(-1, keepdim=True) / self.claim_limit[place])
        if self.whiteness:
            evidence.append(_logarithms(tests.whiteness, limits[1]))
        evidence += self._signs(name, sensor, entries)
        size = torch.cat(evidence, -1).amax(-1, keepdim=True).to(dtype)
        values = (*window, cusum, claim, tests.p_value, tests.whiteness, size)
        return dict(zip(keys, values, strict=True))

    def claim_score(self, name: str, noise: Tensor) -> Tensor:
        """Returns the standard normal score of a sensor's claimed variances ``[*B, O]``, ``[*B, 1]``.

        It is the score of their mean logarithm in the distribution of the calibration data.
        """
        place = list(self.sensors).index(name)
        return interpolate(_claimed(noise), *self.claims[place].to(noise.dtype))

    def _signs(self, name: str, sensor: MonitoredSensor, entries) -> list[Tensor]:
        """Returns the signs as multiples of their limits, if there are any."""
        signs = None if sensor.sign_key is None else entries.get(unravel_key(sensor.sign_key))
        if signs is None:
            return []
        return [(signs / getattr(self, f"sign_limit_{name}").to(signs.dtype)).nan_to_num(0.0, posinf=0.0)]

    def _read(self, sensor: MonitoredSensor, entries) -> tuple[Tensor, Tensor, Tensor | None, Tensor]:
        """Returns normalised innovation squared, innovation, claimed noise, and the number of observed components."""
        info = unravel_key(sensor.info_prefix)
        info = (info,) if isinstance(info, str) else info
        nis, innovation = (self.required(entries, (*info, entry)) for entry in ("nis", "innovation"))
        check_observation_dim(sensor.observation_dim, innovation, f"the monitored sensor at {sensor.info_prefix!r}")
        noise = None if sensor.noise_key is None else self.required(entries, unravel_key(sensor.noise_key))
        mask = entries.get(unravel_key(sensor.observed_key))
        # Without a mask in the entries, components with a zero innovation count as not observed.
        seen = innovation != 0 if mask is None else mask.expand(innovation.shape)
        count = seen.sum(-1, keepdim=True).to(nis.dtype)
        return nis, innovation, noise, torch.where(nis > 0, count, 0)  # nis is 0 at a reset

    def _sum(self, total: Tensor, score: Tensor, seen: Tensor, limit: Tensor) -> Tensor:
        ceiling = (self.ceiling * limit).to(total.dtype)
        return torch.where(seen, torch.minimum(cusum_step(total, score, self.reference), ceiling), total)

    def initial_state(self, batch_size: Sequence[int], *, device=None, dtype=None) -> list[Tensor]:
        """Returns the entries before anything was observed, in the order of ``state_keys``."""
        make = {"device": device, "dtype": dtype}
        zero, values = torch.zeros(*batch_size, 1, **make), []
        for sensor in self.sensors.values():
            values += [torch.zeros(*batch_size, self.window, 4, **make)]
            values += [torch.zeros(*batch_size, sensor.observation_dim, **make), zero]
            values += [torch.zeros(*batch_size, _CLAIMS, **make)]
            values += [torch.ones_like(zero), torch.ones_like(zero), zero]
        alarm = torch.zeros(*batch_size, 1, dtype=torch.bool, device=device)
        return [*values, alarm, torch.full_like(alarm, -1, dtype=torch.int64)]

    # --------------------------------------------------------------------------------------------------- calibration

    @torch.no_grad()
    def calibrate(self, clean: Sequence[TensorDictBase], *, margin: float = 1.0) -> InnovationMonitor:
        """Calibrates the distributions of the tests on clean data.

        Quantiles of the normalised innovation squared are mapped to those of the chi-square distribution, those of the
        claimed noise to normal scores. Then each test's limit becomes its quantile on the data, unless the theoretical
        limit is farther out.

        Args:
            clean: recordings ``[*B, T]``, time last: the outputs of a filter, with the entries that the monitor reads;
                an episode begins at the first step, and at each ``is_init``. A reliable limit needs about ten times as
                many steps as the mean time between false alarms.
            margin: factor on the limits, for data that are fewer or less varied than those in use.

        Returns:
            This monitor.

        Raises:
            KeyError: if an entry is missing.
            ValueError: if a sensor is observed at fewer than 50 steps.
        """
        recordings = [_entries(each) for each in clean]
        for place, (name, sensor) in enumerate(self.sensors.items()):
            parts, claims = [], []
            for entries in recordings:
                nis, innovation, noise, freedom = self._read(sensor, entries)
                seen = (freedom > 0).squeeze(-1)
                parts.append((nis.squeeze(-1)[seen], innovation[seen]))
                claims += [] if noise is None else [_claimed(noise[seen]).squeeze(-1)]
            nis, innovation = (torch.cat(column).double() for column in zip(*parts, strict=True))
            if len(nis) < 50:
                raise ValueError(f"calibrate needs 50 steps at which {name!r} is observed; there are {len(nis)}")
            getattr(self, f"scale_{name}").copy_(innovation.square().mean(0).sqrt().clamp_min(1e-12))
            self.tables[place] = chi_square_table(nis, sensor.observation_dim)
            if claims:
                self.claims[place] = score_table(torch.cat(claims).double())
            if sensor.sign_key is not None:
                signs = [entries.get(unravel_key(sensor.sign_key)) for entries in recordings]
                known = [each.flatten(0, -2) for each in signs if each is not None]
                if known:
                    limits = sign_limits(torch.cat(known), self.share, getattr(self, f"floor_{name}"), margin)
                    getattr(self, f"sign_limit_{name}").copy_(limits)
        self._set_limits([self.replay(each) for each in clean], margin)
        return self

    def _set_limits(self, tests: Sequence[TensorDictBase], margin: float) -> None:
        strict = cusum_threshold(1 / self.share, self.reference)
        for place, (name, sensor) in enumerate(self.sensors.items()):

            def extreme(entry: str, level: float, name: str = name) -> float:
                values = [each[self.monitor_prefix, name, entry].flatten().double() for each in tests]
                return float(empirical_quantile(torch.cat(values), torch.tensor([level])))

            self.p_limit[place] = min(self.share, extreme("p_value", self.share)) ** margin
            self.whiteness_limit[place] = min(self.share, extreme("whiteness", self.share)) ** margin
            self.cusum_limit[place] = margin * max(strict, extreme("cusum", 1 - self.share))
            if sensor.noise_key is not None:
                means = [each[self.monitor_prefix, name, "claim"].double().mean(-1).flatten() for each in tests]
                found = float(empirical_quantile(torch.cat(means), torch.tensor([1 - self.share])))
                # Scores of successive frames may be fully correlated: then their mean is standard normal, too.
                normal = -float(torch.special.ndtri(torch.tensor(self.share, dtype=torch.float64)))
                self.claim_limit[place] = margin * max(normal, found)

    @torch.no_grad()
    def replay(self, recorded: TensorDictBase) -> TensorDictBase:
        """Returns the monitor's entries from a filter's outputs ``[*B, T]``, time last."""
        batch, entries = recorded.batch_size[:-1], _entries(recorded)
        read = [key for key in (*self.in_keys, *self.optional_keys, "is_init") if key not in self.state_keys]
        rows = recorded.select(*(key for key in read if key in entries)).unbind(-1)
        dtype = self._read(next(iter(self.sensors.values())), entries)[0].dtype
        start = self.initial_state(batch, device=recorded.device, dtype=dtype)
        state, out = dict(zip(self.state_keys, start, strict=True)), []
        for row in rows:
            new = row.get("is_init", None)
            if new is not None:
                pairs = zip(state.items(), start, strict=True)
                state = {key: torch.where(expand_as_right(new, old), value, old) for (key, old), value in pairs}
            for key, value in state.items():
                row.set(key, value)
            row = self(row)
            state = {key: row.get(key) for key in self.state_keys}
            out.append(row.select(*self.state_keys))
        return torch.stack(out, len(batch))

    def detectable_bias(self, power: float = 0.9) -> dict[str, float]:
        """Returns the smallest constant bias of each sensor's innovations that the windowed test detects.

        The filter follows a biased sensor, so that the innovation's bias is smaller than the sensor's. Neither this
        test nor a gate detects a smaller bias.

        Args:
            power: probability of detection.

        Returns: Bias by sensor, in standard deviations of its innovation.
        """
        limits = self.p_limit.double().clamp_min(1e-300).tolist()
        return {
            name: detectable_bias(sensor.observation_dim, limit, power=power, window=self.window)
            for (name, sensor), limit in zip(self.sensors.items(), limits, strict=True)
        }


def _logarithms(p_value: Tensor, limit: Tensor) -> Tensor:
    """Returns the ratio of the logarithms of a p-value and its limit."""
    least = torch.finfo(p_value.dtype).tiny
    return p_value.clamp_min(least).log() / limit.clamp_min(least).log()


def _claimed(noise: Tensor) -> Tensor:
    """Returns the mean logarithm of the claimed variances ``[*B, 1]``."""
    return noise.clamp_min(torch.finfo(noise.dtype).tiny).log().mean(-1, keepdim=True)


def _entries(tensordict: TensorDictBase) -> dict:
    return {unravel_key(key): value for key, value in tensordict.items(True, True)}
