"""Readings that cannot be true are missing observations. Oracle: the same filter on readings that a mask hides."""

import re

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import ExcludeTransform, TransformedEnv, check_env_specs
from torchrl.modules.utils import get_env_transforms_from_module

from tests.filters.composed import ReplayedFrames
from tests.filters.factories import linear_denkf, linear_kalman
from tests.transforms.envs_for_tests import base_env, toy_base_env, toy_filter
from torch_denkf import DEnKFTransform, RejectReadings
from torch_denkf.functional.manifolds import SE2, SE3, SO3, Circle, Euclidean, Product
from torch_denkf.modules import FromSensor

NAN, INF = torch.nan, torch.inf
COUNT = ("info", "rejected")
BAD = [NAN, INF, -INF, 1e30, -2e18]


def of(key, *rows, **others):
    """Returns a tensordict ``[B]`` with the rows of one reading."""
    return TensorDict({key: torch.tensor(rows), **others}, [len(rows)])


# ------------------------------------------------------------------------------------------- masks, counts, numbers


@pytest.mark.parametrize("value", BAD)
def test_a_reading_is_rejected_as_a_whole(value):
    td = of("gps", [1.0, 2.0], [value, 3.0], [4.0, value])
    out = RejectReadings({"gps": "gps_observed"})(td)
    assert out is td
    assert out["gps"].tolist() == [[1.0, 2.0], [0.0, 3.0], [4.0, 0.0]]
    assert out["gps_observed"].tolist() == [[True], [False], [False]]
    assert out[COUNT].tolist() == [[0], [1], [1]]
    assert out[COUNT].dtype == torch.int64


@pytest.mark.parametrize("mask", [[[True], [True], [False]], [[True, True], [True, False], [False, True]]])
@pytest.mark.parametrize("apart", [False, True])
def test_a_given_mask_is_combined(mask, apart):
    rows = torch.tensor([[1.0, 2.0], [NAN, 3.0], [4.0, INF]])
    observed = torch.tensor(mask)
    out = RejectReadings({"gps": "seen"}, by_component=["gps"] if apart else [])(
        of("gps", *rows.tolist(), seen=observed)
    )
    fine = rows.isfinite() if apart else rows.isfinite().all(-1, keepdim=True)
    assert out["seen"].equal(observed & fine)
    assert out[COUNT].equal((observed & ~fine).sum(-1, keepdim=True))


def test_readings_that_share_a_mask_are_rejected_together():
    out = RejectReadings({"a": "observed", "b": "observed"}, by_component=["b"], count_key="lost")(
        TensorDict(
            {"a": torch.tensor([[NAN], [0.0], [0.0]]), "b": torch.tensor([[0.0, 0.0], [0.0, INF], [0.0, 0.0]])}, [3]
        )
    )
    assert out["observed"].tolist() == [[False, False], [True, False], [True, True]]
    assert out["lost"].tolist() == [[2], [1], [0]]


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32, torch.bfloat16, torch.float16])
def test_each_precision_has_its_limit(dtype):
    rows = torch.tensor([[-2.0], [9e17], [2e18], [NAN]], dtype=torch.float64).to(dtype)
    out = RejectReadings({"x": "seen"})(TensorDict({"x": rows}, [4]))
    half = dtype == torch.float16  # 9e17 is infinite there
    assert out["seen"].flatten().tolist() == [True, not half, False, False]
    assert out["x"].dtype == dtype
    assert out["x"].isfinite().all()
    assert RejectReadings({"x": "seen"}, limit=1.0)(TensorDict({"x": rows}, [4]))[COUNT].sum() == 4


@pytest.mark.parametrize("dtype", [torch.uint8, torch.int64, torch.bool])
def test_integers_are_always_readings(dtype):
    pixels = torch.ones(2, 3, 4, 4, dtype=dtype)
    out = RejectReadings({"pixels": "observed"}, limit=0.5)(TensorDict({"pixels": pixels}, [2]))
    assert out["pixels"].equal(pixels)
    assert out["observed"].all()
    assert out[COUNT].sum() == 0


def test_the_data_keep_their_nan():
    data = torch.tensor([[1.0], [NAN]])
    kept, mask = data.clone(), torch.ones(2, 1, dtype=torch.bool)
    td = TensorDict({"x": data, "seen": mask}, [2]).lock_()
    out = RejectReadings({"x": "seen"})(td.copy())
    assert out["x"].tolist() == [[1.0], [0.0]]
    torch.testing.assert_close(data, kept, equal_nan=True)
    assert mask.all()
    assert td["x"] is data
    assert COUNT not in td.keys(True)


@pytest.mark.parametrize("batch", [[], [0], [3, 0]])
def test_batches_of_any_size(batch):
    td = TensorDict({"x": torch.zeros(*batch, 2), "n": torch.zeros(*batch, 2, 2)}, batch)
    out = RejectReadings({"x": "seen"}, noises={"x": "n"}, on_bad="raise")(td)
    assert out["seen"].shape == out[COUNT].shape == (*batch, 1)


# ---------------------------------------------------------------------------------------------------- spaces, noises


def test_a_pose_is_rejected_as_a_whole():
    out = RejectReadings({"pose": "seen"}, spaces={"pose": SE2()})(of("pose", [0.5, NAN, 20.0], [1.0, 2.0, 3.0]))
    assert out["pose"].tolist() == [[0.0, 0.0, 0.0], [1.0, 2.0, 3.0]]
    assert out["seen"].tolist() == [[False] * 3, [True] * 3]


def test_a_quaternion_of_zeros_is_no_rotation():
    space = Product(Euclidean(1), SE3())
    point = torch.tensor([5.0, 1.0, 0.0, 0.0, 0.0, 1.0, 2.0, 3.0]).expand(2, 8).clone()
    point[1, 1:5] = 0
    td = TensorDict({"pose": point}, [2])
    out = RejectReadings({"pose": "seen"}, spaces={"pose": space})(td.copy())
    assert out["seen"].tolist() == [[True] * 7, [True] + [False] * 6]
    assert out["pose"].tolist() == [point[0].tolist(), [5.0, 1.0, *[0.0] * 6]]
    with pytest.raises(ValueError, match=r"'pose' at \[1\] is no point of .*SE3.*: \[5.0, 0.0, .*'seen'"):
        RejectReadings({"pose": "seen"}, spaces={"pose": space}, on_bad="raise")(td)
    whole = TensorDict({"pose": torch.tensor([[1, 0, 0, 0], [0, 0, 0, 0]])}, [2])  # integers
    assert RejectReadings({"pose": "seen"}, spaces={"pose": SO3()})(whole)["seen"].any(-1).tolist() == [True, False]


@pytest.mark.parametrize("shape", [(3, 1), (3, 4), (3,), (3, 2, 2)])
def test_a_reading_of_another_size_than_its_space_raises(shape):
    td = TensorDict({"pose": torch.ones(shape)}, [3])
    with pytest.raises(ValueError, match=r"'pose' has shape .*; a point of SE2\(\) is \[\*, 3\]"):
        RejectReadings({"pose": "seen"}, spaces={"pose": SE2()})(td)


def test_parts_of_a_product_are_rejected_one_by_one():
    space = Product(Euclidean(2), SO3(), Circle())
    point = torch.tensor([1.0, 2.0, *SO3().exp(torch.tensor([0.1, 0.2, 0.3])), 0.5]).expand(5, 7).clone()
    point[1, 0], point[2, 4], point[3, 6] = NAN, INF, 1e25
    cov = torch.ones(5, 6)
    cov[4, 3] = -1.0  # the last number of the rotation's
    expected = torch.ones(5, 6, dtype=torch.bool)
    expected[1, 0] = expected[3, 5] = False
    expected[2, 2:5] = expected[4, 2:5] = False
    out = RejectReadings({"pose": "seen"}, spaces={"pose": space}, noises={"pose": "noise"})(
        TensorDict({"pose": point, "noise": cov}, [5])
    )
    assert out["seen"].equal(expected)
    assert out["pose"][2].tolist() == [*point[2, :2].tolist(), 1.0, 0.0, 0.0, 0.0, 0.5]
    assert out["pose"][1, 1:].equal(point[1, 1:])
    assert out["noise"].equal(torch.ones(5, 6))
    samples = point.unsqueeze(1).expand(5, 4, 7).clone()
    samples[0, 2, 3] = NAN  # one of the samples of the first reading
    expected[0, 2:5], expected[4] = False, True
    out = RejectReadings({"pose": "seen"}, spaces={"pose": space})(TensorDict({"pose": samples}, [5]))
    assert out["seen"].equal(expected)
    assert out["pose"][0, :, 2:6].tolist() == [[1.0, 0.0, 0.0, 0.0]] * 4


def test_a_noise_that_is_none_is_a_missing_reading():
    noise = torch.tensor([[1.0, 0.0], [NAN, 1.0], [1.0, -1e-3], [INF, 1.0]])
    fine = torch.tensor([[True, True], [False, True], [True, False], [False, True]])
    td = TensorDict({"gps": torch.ones(4, 2), "gps_noise": noise}, [4])
    apart = RejectReadings({"gps": "seen"}, noises={"gps": "gps_noise"}, by_component=["gps"])(td.copy())
    assert apart["seen"].equal(fine)
    assert apart["gps_noise"].equal(torch.where(fine, noise, 1.0))
    whole = RejectReadings({"gps": "seen"}, noises={"gps": "gps_noise"})(td.copy())
    assert whole["seen"].equal(fine.all(-1, keepdim=True))


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_matrix_that_is_no_covariance_is_a_missing_reading(unit, dtype):
    root = torch.tensor([[1.0, 0.0], [1.0, 0.0]], dtype=dtype) * unit  # of rank one
    given = [
        (root @ root.mT, True),
        (torch.zeros(2, 2), True),
        (torch.tensor([[1.0, 2.0], [2.0, 1.0]]) * unit**2, False),  # the eigenvalue -1
        (torch.tensor([[1.0, 0.5], [0.4, 1.0]]) * unit**2, False),  # not symmetric
        (torch.tensor([[1.0, 0.0], [0.0, -1e-3]]) * unit**2, False),
        (torch.tensor([[1.0, NAN], [NAN, 1.0]]), False),
    ]
    noise = torch.stack([matrix.to(dtype) for matrix, _ in given])
    td = TensorDict({"gps": torch.ones(6, 2, dtype=dtype), "gps_noise": noise}, [6])
    out = RejectReadings({"gps": "seen"}, noises={"gps": "gps_noise"}, by_component=["gps"])(td)
    fine = [fine for _, fine in given]
    assert out["seen"].tolist() == [[each, each] for each in fine]
    assert out["gps_noise"][:2].equal(noise[:2])
    assert out["gps_noise"][2:].equal(torch.eye(2, dtype=dtype).expand(4, 2, 2))


# ------------------------------------------------------------------------------------------------------------ filters


def drive(*batch, seed=0):
    """Returns readings with numbers that cannot be true, and what a mask says of them that is made by hand."""
    generator = torch.Generator().manual_seed(seed)
    clean = torch.randn(*batch, 2, generator=generator)
    values = torch.tensor(BAD)[torch.randint(5, clean.shape, generator=generator)]
    bad = torch.rand(clean.shape, generator=generator) < 0.2
    observed = torch.rand(*batch, 1, generator=generator) < 0.8
    frames = TensorDict({"observation": torch.where(bad, values, clean), "observed": observed}, batch)
    return frames, TensorDict({"observation": torch.where(bad, 0.0, clean), "observed": observed & ~bad}, batch)


def test_gradients_of_a_reading_are_finite():
    """That of a reading that is rejected is zero, also behind a mask that hid it already."""
    scaled = torch.tensor([[2.0, INF], [NAN, 3.0], [1.0, 1.0]], requires_grad=True)
    td = TensorDict({"observation": scaled, "observed": torch.tensor([[True], [True], [False]])}, [3])
    out = RejectReadings({"observation": "observed"}, by_component=["observation"])(td)
    linear_kalman(update_at_reset=True).sequence(out)["belief", "mean"].sum().backward()
    assert scaled.grad.isfinite().all()
    assert ((scaled.grad != 0) == torch.tensor([[True, False], [False, True], [False, False]])).all()


@pytest.mark.parametrize("masked", ["each time", "once", "never"])
def test_a_mask_is_that_of_its_reading(masked):
    """In a loop the tensordict keeps what was written: a reading that was rejected hides no later one."""
    reject, seen = RejectReadings({"x": "seen"}), torch.tensor([[True], [False]])
    row, found = TensorDict({"x": torch.tensor([[NAN], [1.0]])}, [2]), []
    if masked != "never":
        row["seen"] = seen
    for value in (1.0, NAN, 2.0):
        found.append(reject(row)["seen"][0].item())
        assert reject(row)["seen"][0].item() == found[-1]  # twice is once
        assert row["seen"][1].item() == (masked == "never")
        row["x"] = torch.tensor([[value], [1.0]])
        if masked == "each time":
            row["seen"] = seen.clone()
    assert found == [False, True, False]


@pytest.mark.parametrize("given", [False, True])
def test_in_a_policy(given):
    frames, masked = drive(2, 6)
    if not given:
        del frames["observed"]
        masked["observed"] = frames["observation"].abs() <= 1e18
    filter, outs = linear_kalman(), []
    for data, modules in (
        (frames, [RejectReadings({"observation": "observed"}, by_component=["observation"])]),
        (masked, []),
    ):
        data["action"], data["is_init"] = torch.zeros(2, 6, 1), torch.zeros(2, 6, 1, dtype=torch.bool)
        policy = TensorDictSequential(*modules, filter, ReplayedFrames(data).player())
        env = TransformedEnv(ReplayedFrames(data), get_env_transforms_from_module(policy))
        outs.append(env.rollout(5, policy))
    for key in filter.belief_keys:
        assert outs[0][key].equal(outs[1][key])
    assert outs[0][COUNT].sum() > 0


def test_compiled_mapped_and_without_values():
    frames, masked = drive(3, 4)
    for on_bad in ("mask", "raise"):
        reject = RejectReadings({"observation": "observed"}, by_component=["observation"], on_bad=on_bad)
        out = torch.compile(lambda td, reject=reject: reject(td), backend="eager", fullgraph=True)(frames.copy())
        assert out["observation"].equal(masked["observation"])
        assert out["observed"].equal(masked["observed"])
        out = torch.vmap(reject)(frames.copy())
        assert out["observed"].equal(masked["observed"])
        out = reject(frames.to("meta"))
        assert out["observed"].shape == (3, 4, 2)
        assert out[COUNT].device.type == "meta"


# ------------------------------------------------------------------------------------------------------- environments


def rejecting_env(filter, *, silent=True, **options):
    """Returns an environment whose missing readings are NaN, and, if ``silent``, have no mask."""
    env = TransformedEnv(base_env(missing=0.4, max_steps=[3, 5], seed=1, batch_size=[2]))
    if silent:
        env.append_transform(ExcludeTransform("observed"))
        env.append_transform(RejectReadings({"observation": "observed"}, **options))
    return env.append_transform(DEnKFTransform(filter))


def from_sensor(**kwargs):
    start = FromSensor([0, 1], [0.0, 0.0], [1.0, 1.0], ensemble_size=6, observation_key="observation")
    return linear_denkf("etkf", initial=start, **kwargs)


@pytest.mark.parametrize("apart", [False, True])
@pytest.mark.parametrize("update_at_reset", [False, True])
@pytest.mark.parametrize("make", [linear_kalman, lambda **kw: linear_denkf("etkf", **kw), from_sensor])
def test_in_an_environment(make, update_at_reset, apart):
    """An environment that says when a reading is missing, and one that does not: the beliefs are the same."""
    filter, rollouts = make(update_at_reset=update_at_reset), []
    for silent in (False, True):
        env = rejecting_env(filter, silent=silent, by_component=["observation"] if apart else [])
        if silent:
            check_env_specs(env)
        env.set_seed(1)
        torch.manual_seed(0)
        rollouts.append(env.rollout(9, break_when_any_done=False))
    said, silent = rollouts
    missing = ~said["next", "observed"]
    assert missing[:, 1:].any()
    for key in filter.belief_keys:
        assert silent[key].equal(said[key])
        assert silent["next", key].equal(said["next", key])
    assert silent["next", "observed"].shape[-1] == 1 + apart
    assert silent["next", *COUNT].equal((1 + apart) * missing.long())


def test_filter_with_another_mask_warns():
    env = TransformedEnv(toy_base_env(), RejectReadings({"observation": "seen"}))
    with pytest.warns(UserWarning, match="RejectReadings marks where 'observation' is missing in 'seen', which no mod"):
        env.append_transform(DEnKFTransform(toy_filter())).rollout(2)


def test_in_a_replay_buffer():
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(4), batch_size=4)
    buffer.append_transform(RejectReadings({"x": "seen"}))
    buffer.extend(of("x", [1.0], [NAN], [2.0], [INF]))
    out = buffer.sample()
    assert out["x"].isfinite().all()
    assert out["seen"].equal(out["x"] > 0)
    assert (~buffer.storage[:]["x"].isfinite()).sum() == 2


# ------------------------------------------------------------------------------------------------------------- errors


@pytest.mark.parametrize(
    ("rows", "others", "message"),
    [
        ([[1.0, 2.0], [3.0, NAN]], {}, "'x' is nan at [1, 1], and a reading must be finite. Set its mask 'seen' to"),
        ([[1.0, 2.0], [-3e20, 1.0]], {}, "'x' is -3e+20 at [1, 0], and a reading must be at most 1e+18 in size"),
        ([[1.0, 2.0]], {"n": [[1.0, -2.0]]}, "'n' is -2 at [0, 1], and a variance must be at least zero"),
        ([[1.0, 2.0]], {"n": [[1.0, INF]]}, "'n' is inf at [0, 1], and a variance must be finite"),
        ([[1.0, 2.0]], {"n": [[[1.0, 2.0], [2.0, 1.0]]]}, "'n' at [0] is no covariance"),
        ([[1.0, NAN]], {"seen": [[False, True]]}, "'x' is nan at [0, 1], and a reading must be finite"),
    ],
)
@pytest.mark.parametrize("apart", [False, True])
def test_bad_readings_raise(rows, others, message, apart):
    td = of("x", *rows, **{key: torch.tensor(value) for key, value in others.items()})
    noises, apart = {"x": "n"} if "n" in others else {}, ["x"] if apart else []
    before = td.copy()
    with pytest.raises(ValueError, match=f'^{re.escape(message)}.*on_bad="mask"'):
        RejectReadings({"x": "seen"}, noises=noises, by_component=apart, on_bad="raise")(td)
    assert all(td[key] is before[key] for key in before.keys())  # noqa: SIM118
    td["seen"] = torch.zeros(len(rows), 1, dtype=torch.bool)
    out = RejectReadings({"x": "seen"}, noises=noises, by_component=apart, on_bad="raise")(td)
    assert all(value.isfinite().all() for value in out.values(True, True) if value.is_floating_point())
    assert out[COUNT].sum() == 0


def test_unmasked_invalid_value_among_masked_ones_raises():
    seen = torch.tensor([[False, True]])
    td = of("x", [NAN, INF], seen=seen)
    with pytest.raises(ValueError, match=r"^'x' is inf at \[0, 1\]"):
        RejectReadings({"x": "seen"}, by_component=["x"], on_bad="raise")(td)
    with pytest.raises(ValueError, match=r"^'x' is nan at \[0, 0\]"):  # a whole reading needs all of its numbers
        RejectReadings({"x": "seen"}, on_bad="raise")(of("x", [NAN, 1.0], seen=seen))
    with pytest.raises(ValueError, match=r"^'pose' is nan at \[0, 1\]"):  # so does a pose
        RejectReadings({"pose": "seen"}, spaces={"pose": SE2()}, on_bad="raise")(
            of("pose", [0.5, NAN, 2.0], seen=torch.tensor([[True, False, True]]))
        )
