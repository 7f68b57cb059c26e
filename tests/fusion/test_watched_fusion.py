"""Gates and monitors around filters of several sensors: against the filter by hand, and readings that are hidden."""

from functools import partial

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torch.testing import assert_close

from tests.filters.factories import linear_kalman, linear_system
from torch_denkf.deployment.package import PackagedStep
from torch_denkf.filters import Filter
from torch_denkf.fusion import FusedFilter, FusedSensor
from torch_denkf.modules import (
    ConstantNoise,
    EKFAnalysis,
    EnsembleAnalysis,
    GaussianPrior,
    LearnedTransition,
    LinearObservation,
    LinearTransition,
    MomentPrior,
    Select,
)
from torch_denkf.monitoring import Gated, InnovationMonitor, Monitored, MonitoredSensor

NAMES = ("first", "second")


def fused(**kwargs):
    F, Q, H, R = linear_system()
    delay = kwargs.pop("delay", 0)
    sensors = {
        "first": FusedSensor(LinearObservation(H[:1]), R[:1].sqrt()),
        "second": FusedSensor(LinearObservation(H[1:]), R[1:].sqrt(), delay=delay),
    }
    return FusedFilter(LinearTransition(F, Q), sensors, initial=MomentPrior(torch.zeros(2), torch.eye(2)), **kwargs)


def readings(*batch):
    torch.manual_seed(0)
    frames = TensorDict({name: 3 * torch.randn(*batch, 1) for name in NAMES}, batch)
    for name in NAMES:
        frames[f"{name}_observed"] = torch.rand(*batch, 1) < 0.6
    return frames


def watch(*names, **kwargs):
    sensors = {name: MonitoredSensor(("info", name), 1, f"{name}_observed") for name in names}
    return InnovationMonitor(sensors, **kwargs)


def test_a_gate_counts_no_reading_of_the_time_before_an_episode(float64):
    frames = readings(2, 8).select(*NAMES)
    out = Gated(fused(delay=3), adapt_noise=0.1).sequence(frames)
    count = out["gate_second", "terms"][0, :, :, 0, 1].sum(-1)
    assert count.tolist() == [0, 0, 0, 1, 2, 3, 3, 3]
    assert not out["gate_second", "log_noise"][:, :3].any()


def test_gate_of_a_joint_update_counts_observed_components(float64):
    frames = readings(2, 8)
    out = Gated(fused(joint=True), 2, window=20).sequence(frames.copy())
    seen = frames["first_observed"].long() + frames["second_observed"]
    seen[:, 0] = 0  # the initial belief sees no frame
    assert torch.equal(out["gate", "terms"][..., 0, 1].sum(-1), seen.cumsum(1).squeeze(-1).double())


def test_monitor_of_a_joint_update_counts_observed_components(float64):
    frames = readings(2, 8)
    monitor = InnovationMonitor({"both": MonitoredSensor("info", 2)}, window=20)
    terms = Monitored(fused(joint=True), monitor).sequence(frames.copy())["monitor", "both", "terms"]
    alone = Monitored(linear_kalman(), InnovationMonitor({"both": MonitoredSensor("info", 2)}, window=20))
    as_one = TensorDict({"observation": torch.cat([frames[name] for name in NAMES], -1)}, [2, 8])
    as_one["observed"] = torch.cat([frames[f"{name}_observed"] for name in NAMES], -1)
    alone.initial.module.mean.zero_()
    alone.initial.module.cov.copy_(torch.eye(2))
    assert_close(terms, alone.sequence(as_one)["monitor", "both", "terms"])


def test_monitors_read_the_diagnostics_of_each_sensor(float64):
    frames = readings(3, 20)
    both = Monitored(fused(delay=2), watch(*NAMES))
    out, plain = both.sequence(frames.copy()), fused(delay=2).sequence(frames.copy())
    assert torch.equal(out["belief", "mean"], plain["belief", "mean"])
    replayed = both.monitor.replay(out)
    two = Monitored(Monitored(fused(delay=2), watch("first")), watch("second", monitor_prefix="other"))
    apart = two.sequence(frames.copy())
    for key in ("terms", "p_value"):
        assert_close(replayed["monitor", "second", key], out["monitor", "second", key])
        assert_close(apart["monitor", "first", key], out["monitor", "first", key])
        assert_close(apart["other", "second", key], out["monitor", "second", key])
    assert out["monitor", "second", "cusum"].any()
    assert two.monitor.monitor_prefix == "other"


def test_two_monitors_of_one_name_raise():
    with pytest.raises(ValueError, match="monitor_prefix='monitor2'"):
        Monitored(Monitored(fused(), watch("first")), watch("second"))


@pytest.mark.parametrize(
    "wrap", [lambda f: Gated(f, 2), lambda f: Monitored(f, InnovationMonitor({"both": MonitoredSensor("info", 2)}))]
)
def test_single_readings_of_a_joint_update_are_left_out_of_no_wrapped_filter(wrap):
    filter = wrap(fused(joint=True))
    row = filter.initialise(readings(2))
    with pytest.raises(ValueError, match="hide them with their masks"):
        filter.step(row, without=["first"])


@pytest.mark.parametrize("told", [1, 3])
def test_another_number_of_components_than_the_reading_has_raises(told):
    monitor = InnovationMonitor({"both": MonitoredSensor("info", told)})
    for filter in (Gated(fused(joint=True), told), Monitored(fused(joint=True), monitor)):
        with pytest.raises(ValueError, match="pass observation_dim=2"):
            filter.sequence(readings(2, 4))


def test_gate_infers_the_dimension_of_a_joint_reading(float64):
    told, found = (Gated(fused(joint=True), *dim).sequence(readings(2, 9)) for dim in ((2,), ()))
    assert (told["gate", "factor"] > 1).any()
    assert_close(found["belief", "mean"], told["belief", "mean"], rtol=0, atol=0)


def test_a_joint_update_with_perturbed_readings_draws_its_noise_before_the_step(float64):
    filter = FusedFilter(
        LearnedTransition(torch.nn.Linear(2, 2)),
        {"first": FusedSensor(Select([0]), [0.3]), "second": FusedSensor(Select([0, 1]), [0.3, 0.2])},
        initial=GaussianPrior([0.0, 0.0], [1.0, 1.0], ensemble_size=5),
        process_noise=[0.1, 0.1],
        joint=True,
        analysis=partial(EnsembleAnalysis, "perturbed"),
    )
    frames = TensorDict({"first": torch.zeros(4, 1), "second": torch.zeros(4, 2)}, [4])
    noise = filter.draw_noise(frames)["noise", "analysis"]
    assert noise.shape == (4, 5, 3)


def test_two_analyses_in_one_place_have_gates_of_their_own(float64):
    F, Q, H, R = linear_system()
    parts = []
    for index, name in enumerate(NAMES):
        parts.append(ConstantNoise(R[index : index + 1].sqrt(), in_key=name, out_key=f"{name}_noise"))
        keys = {"observation_key": name, "noise_variance_key": f"{name}_noise", "observed_key": f"{name}_observed"}
        keys |= {"belief_prefix": "between"} if index == 0 else {"forecast_prefix": "between"}
        parts.append(EKFAnalysis(LinearObservation(H[index : index + 1]), info_prefix=f"info_{name}", **keys))
    update = TensorDictSequential(*parts)
    by_hand = Filter({"t": LinearTransition(F, Q), "u": update}, initial=MomentPrior(torch.zeros(2), torch.eye(2)))
    gated = Gated(by_hand, 1, rate=0.2)
    assert [gate.gate_prefix for gate in gated.gates] == ["gate_u_0", "gate_u_1"]
    out, expected = (each.sequence(readings(2, 9)) for each in (gated, Gated(fused(), rate=0.2)))
    assert (out["gate_u_1", "factor"] > 1).any()
    assert_close(out["belief", "mean"], expected["belief", "mean"])


def test_package_inputs_are_made_contiguous():
    signature = {"inputs": [("x", [2, 3], "torch.float32")], "outputs": ["y"], "carry": []}
    step = PackagedStep(lambda x: (torch.tensor(x.stride()),), signature)
    assert step({"x": torch.ones(3, 2).mT})["y"].tolist() == [3, 1]
