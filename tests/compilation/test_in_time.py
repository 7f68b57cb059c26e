"""Oracle: one step back after the other."""

import pytest
import torch
from tensordict import TensorDict
from torch.testing import assert_close

from tests.filters.factories import toy_denkf, toy_frames
from torch_denkf.compilation.in_time import prefixes, rts_in_time
from torch_denkf.filters import KalmanFilter
from torch_denkf.functional.smoothing.rts import rts_smooth
from torch_denkf.modules import KalmanAnalysis, LinearTransition
from torch_denkf.modules.around import Wrapper
from torch_denkf.smoothers import RTSSmoother
from torch_denkf.submodel import Transition


@pytest.mark.parametrize("count", [1, 2, 3, 4, 7, 8, 33])
def test_prefixes_of_a_product_that_does_not_commute(float64, count):
    matrices = torch.randn(count, 2, 2) / 2
    expected = [matrices[0]]
    for matrix in matrices[1:]:
        expected.append(expected[-1] @ matrix)
    (found,) = prefixes(lambda one, other: (one[0] @ other[0],), (matrices,))
    assert_close(found, torch.stack(expected))


def values(*batch, count, size=3):
    """Returns what a linear filter hands to the smoother."""

    def spread():
        root = torch.randn(*batch, count, size, size)
        return root @ root.mT + torch.eye(size)

    cov, move = spread(), torch.randn(*batch, count, size, size)
    before = torch.cat([cov[..., :1, :, :], cov[..., :-1, :, :]], -3)
    forecast = move @ before @ move.mT + spread()
    mean, forecast_mean = torch.randn(2, *batch, count, size)
    return mean, cov, forecast_mean, forecast, before @ move.mT


@pytest.mark.parametrize("batch", [(), (2,), (2, 3)])
@pytest.mark.parametrize("count", [1, 2, 9])
def test_all_times_at_once_are_one_after_the_other(float64, batch, count):
    entries = [value.requires_grad_() for value in values(*batch, count=count)]
    follows = torch.rand(*batch, count) > 0.2
    for keep in ({}, {"follows": follows}):
        ours, theirs = rts_in_time(*entries, **keep), rts_smooth(*entries, **keep)
        assert_close(ours, theirs, rtol=1e-9, atol=1e-10)
        gradients = (
            torch.autograd.grad(mean.sin().sum() + cov.sin().sum(), entries, materialize_grads=True)
            for mean, cov in (ours, theirs)
        )
        assert_close(*gradients, rtol=1e-7, atol=1e-8)


def linear_system(control=False, **options):
    move = torch.tensor([[1.0, 0.1, 0.0], [0.0, 0.9, 0.2], [0.0, -0.2, 0.8]])
    options |= {"control": torch.randn(3, 2)} if control else {}
    return KalmanFilter(
        move,
        torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 1.0]]),
        process_noise=[0.1, 0.0, 0.3],
        noise=[0.5, 1.0],
        mean=torch.zeros(3),
        cov=torch.eye(3),
        **options,
    )


@pytest.mark.parametrize("options", [{}, {"control": True}, {"update_at_reset": True}])
@pytest.mark.parametrize("batch", [(), (2,)])
@pytest.mark.parametrize("marked", [False, True])
def test_a_log_at_once_is_one_step_after_the_other(float64, options, batch, marked):
    filter, count = linear_system(**options), 13
    frames = TensorDict({"observation": torch.randn(*batch, count, 2), "action": torch.randn(*batch, count, 2)})
    frames.batch_size = (*batch, count)
    if marked:
        frames["observed"] = torch.rand(*batch, count, 2) > 0.4
        frames["observation"] = frames["observation"].masked_fill(~frames["observed"], torch.nan)
        frames["is_init"] = torch.rand(*batch, count, 1) > 0.7
    expected = filter.sequence(frames.clone())
    found = filter.compile(mode="in time").sequence(frames.clone())
    for key in filter.out_keys:
        assert_close(found[key], expected[key], rtol=1e-9, atol=1e-10)
    assert_close(filter.sequence(frames.clone(), detach_every=2)["belief", "mean"], expected["belief", "mean"])
    smoothed = RTSSmoother(filter)(frames.clone())["smoothed", "mean"]
    assert_close(smoothed, RTSSmoother(filter.compile(chunk=0))(frames.clone())["smoothed", "mean"])


def test_in_time_is_for_constant_matrices():
    with pytest.raises(TypeError, match="constant matrices"):
        toy_denkf().compile(mode="in time").sequence(toy_frames((2, 3)))
    with pytest.raises(ValueError, match="no options"):
        linear_system().compile(mode="in time", dynamic=True)


def test_in_time_names_readings_of_another_dtype():
    for strategy in ({"chunk": 0}, {"mode": "in time"}):
        with pytest.raises(TypeError, match=r"got .*'observation' in torch.float64. Convert the data"):
            linear_system().compile(**strategy).sequence(TensorDict({"observation": torch.zeros(3, 2).double()}, [3]))


@pytest.mark.parametrize("kind", ["transition", "wrapper", "analysis"])
def test_in_time_rejects_modules_that_change_the_matrices(kind):
    filter = linear_system()

    class Drift(LinearTransition):
        pass

    class Wind(Wrapper, Transition):
        pass

    class Own(KalmanAnalysis):
        pass

    made = {
        "transition": lambda: Drift(torch.eye(3), torch.eye(3)),
        "wrapper": lambda: Wind(filter["transition"]),
        "analysis": lambda: Own(torch.eye(2, 3), torch.ones(2)),
    }[kind]()
    other = filter.with_modules({"analysis" if kind == "analysis" else "transition": made})
    with pytest.raises(TypeError, match=type(made).__name__):
        other.compile(mode="in time").sequence(TensorDict({"observation": torch.zeros(3, 2)}, [3]))


def test_an_episode_that_diverges_does_not_reach_the_one_before(float64):
    mean, *others = values(count=6)
    follows = torch.ones(6, dtype=torch.bool)
    follows[3] = False
    expected = rts_smooth(mean, *others, follows=follows)
    mean[4:] = torch.nan
    found = rts_in_time(mean, *others, follows=follows)
    for ours, theirs in zip(found, expected, strict=True):
        assert_close(ours[:3], theirs[:3])
    assert found[0][3:5].isnan().any()


@pytest.mark.filterwarnings("ignore:The variance")
def test_in_time_holds_the_ceiling(float64):
    filter, frames = linear_system(variance_ceiling=0.3), TensorDict({"observation": torch.randn(9, 2)}, [9])
    expected = filter.sequence(frames.clone())["belief", "cov"]
    assert_close(filter.compile(mode="in time").sequence(frames.clone())["belief", "cov"], expected)


@pytest.mark.parametrize("stored", [False, True])
def test_cuts_and_a_policys_data_are_taken_one_step_after_the_other(float64, stored):
    """Gradients stop at the cuts, and a policy's steps begin at the beliefs that were stored, as eagerly."""
    frames, found = TensorDict({"observation": torch.randn(2, 6, 2)}, [2, 6]), []
    if stored:
        before = {"mean": torch.randn(2, 6, 3), "cov": 4 * torch.eye(3).expand(2, 6, 3, 3)}
        frames["previous"] = TensorDict({"belief": before, "known": torch.ones(2, 6, 1, dtype=torch.bool)}, [2, 6])
        frames["is_init"] = torch.arange(6).expand(2, 6).unsqueeze(-1) == 3
    for filter in (linear_system(), linear_system().compile(mode="in time")):
        observation = frames["observation"].clone().requires_grad_()
        out = filter.sequence(frames.clone().set("observation", observation), detach_every=None if stored else 4)
        found.append((out["belief", "mean"], *torch.autograd.grad(out["belief", "mean"][:, -1].sum(), observation)))
    assert_close(*found, rtol=1e-9, atol=1e-10)
    assert (found[1][1] == 0).all(-1)[0].tolist() == [True] * 3 + [not stored] + [False] * 2


@pytest.mark.parametrize("kind", ["alone", "with starts", "from a belief"])
def test_samples_of_a_reading_count_by_their_mean(float64, kind):
    filter, key = linear_system(observation_key=("sensor", "ensemble")), ("sensor", "ensemble")
    frames = TensorDict({key: torch.randn(2, 9, 5, 2)}, [2, 9])
    if kind == "with starts":
        frames["is_init"] = torch.rand(2, 9, 1) > 0.7
    if kind == "from a belief":
        frames["is_init"] = torch.zeros(2, 9, 1, dtype=torch.bool)
        frames["belief"] = {"mean": torch.ones(2, 9, 3), "cov": torch.eye(3).expand(2, 9, 3, 3)}
    expected = filter.sequence(frames.clone())["belief", "mean"]
    assert_close(filter.compile(mode="in time").sequence(frames)["belief", "mean"], expected)
