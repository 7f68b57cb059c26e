"""Raises for what a compiler gets wrong, and not for what rounding does."""

import re

import pytest
import torch
from functorch.compile import make_boxed_func
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torch._dynamo.backends.common import aot_autograd

from tests.filters.factories import has_compiler, linear_denkf, toy_denkf, toy_frames
from tests.filters.gaussian_for_tests import linear_filter, linear_frames
from tests.filters.test_contract import particles
from torch_denkf.compilation import check_same_numbers, compared
from torch_denkf.filters import EKF, Filter, KalmanFilter
from torch_denkf.modules import ConstantNoise, GaussianPrior, LearnedTransition, MomentPrior, Select
from torch_denkf.running import named_modules_of

needs_compiler = pytest.mark.skipif(not has_compiler(), reason="inductor needs a C++ compiler, g++")


def kalman(prior=1.0, r=1.0):
    """Returns five numbers that walk at random, of which three are read."""
    eye = torch.eye(5)
    return KalmanFilter(eye, eye[:3], process_noise_cov=eye, noise=[r**0.5] * 3, mean=torch.ones(5), cov=prior * eye)


def compiler(run):
    """Returns a backend of torch.compile that runs a graph as ``run(graph, inputs)``, and counts graphs."""

    def compile_graph(graph, example):
        compile_graph.graphs += 1
        return lambda *inputs: run(graph, inputs)

    compile_graph.graphs = 0
    return compile_graph


def right(graph, inputs):
    return graph(*inputs)


def half_blind(graph, inputs):
    """Drops half of the effect of readings ``[2, ..., 3]``, which zeros and missing readings do not reveal."""
    without = graph(*(0 * value if value.shape[:1] == (2,) and value.shape[-1] == 3 else value for value in inputs))
    pairs = zip(graph(*inputs), without, strict=True)
    return [(one + other) / 2 if one.is_floating_point() else one for one, other in pairs]


def rounded(graph, inputs):
    """Changes the last digit of every input, as sums in another order do."""
    eps, generator = torch.finfo(torch.float32).eps, torch.Generator().manual_seed(0)

    def changed(value):
        signs = torch.randint(2, value.shape, generator=generator) * 2 - 1
        return value * (1 + eps * signs) if value.is_floating_point() else value

    return graph(*map(changed, inputs))


# -------------------------------------------------------------------------------------------- errors of inductor


def ekf():
    """Returns four numbers that stand still, of which two are read."""
    return EKF(
        LearnedTransition(torch.nn.Identity(), residual=False),
        None,
        Select([0, 1]),
        ConstantNoise([0.5, 0.5], in_key="observation"),
        process_noise=[0.1] * 4,
        initial=MomentPrior(torch.zeros(4), torch.eye(4)),
        observation_key="observation",
    )


@needs_compiler
@pytest.mark.parametrize(
    "options", [{}, pytest.param({"backend": "inductor"}, marks=pytest.mark.slow)], ids=["passes", "plain"]
)
def test_two_of_four_numbers_are_read(options):
    filter, reading = ekf(), torch.tensor([1.0, -2.0])
    row = filter.initialise(TensorDict({"observation": reading}))
    with torch.no_grad():
        mean = filter.compile(**options).step(row)["belief", "mean"]
    expected = torch.cat([1.01 / (1.01 + 0.25) * reading, torch.zeros(2)])
    torch.testing.assert_close(mean, expected, rtol=1e-6, atol=1e-7)


# -------------------------------------------------------------------------------------------- errors


@pytest.mark.parametrize(
    ("readings", "sequence"),
    [
        ("numbers", False),
        ("hidden and NaN", False),
        ("zero", True),
        *(
            pytest.param(readings, sequence, marks=pytest.mark.slow)
            for readings, sequence in [("zero", False), ("hidden", False)]
            + [(readings, True) for readings in ("numbers", "hidden", "hidden and NaN")]
        ),
    ],
)
def test_a_compiler_that_is_wrong_raises(sequence, readings):
    filter, size = kalman(), [2, 3] if sequence else [2]
    frames = TensorDict({"observation": torch.randn(*size, 3)}, size)
    if readings != "numbers":
        frames["observation"] *= torch.nan if "NaN" in readings else 0
        frames["observed"] = torch.full((*size, 1), "hidden" not in readings)
    frames = frames if sequence else filter.initialise(frames)
    call = filter.sequence if sequence else filter.step
    what = f"compiled {'sequence' if sequence else 'step'} is wrong: .*compile.backend=.aot_eager"
    filter.compile(backend=compiler(half_blind), chunk=2)
    for _ in range(2):  # it does not come to be right because it was said
        with pytest.raises(RuntimeError, match=what):
            call(frames.copy())
    filter.compile(backend=compiler(right), chunk=2)
    found = call(frames.copy())["belief", "mean"]
    torch.testing.assert_close(found, (filter.compile(chunk=0) and call(frames.copy()))["belief", "mean"])


def test_the_error_names_the_entry_and_the_number():
    def one_more(graph, inputs):
        first, *others = graph(*inputs)
        return first + 1, *others

    filter = kalman()
    row = filter.initialise(TensorDict({"observation": torch.ones(3)}))
    first = [*filter.structure.frame_keys, *filter.structure.step_keys][0]
    with pytest.raises(RuntimeError, match=rf"{re.escape(repr(first))} is up to 1 off"):
        filter.compile(backend=compiler(one_more)).step(row)


def test_a_wrong_gradient_raises_where_a_sequence_is_trained():
    """The backward pass alone is wrong. That of a step is not compiled before someone wants it."""

    def doubled(graph, example):
        def run(*inputs):
            return [None if value is None else 2 * value for value in graph(*inputs)]

        return make_boxed_func(run)

    wrong = aot_autograd(fw_compiler=lambda graph, example: make_boxed_func(graph.forward), bw_compiler=doubled)
    filter, frames = linear_filter("BackpropKF", trainable=True), linear_frames(2, 2)
    filter.compile(backend=wrong, chunk=1)
    with pytest.raises(RuntimeError, match="gradient by the parameter"):
        filter.sequence(frames.copy())
    with torch.no_grad():
        out = filter.sequence(frames.copy())
    filter.step(frames[:, 1].update(out[:, 0].select(*filter.carry_keys)))


# -------------------------------------------------------------------------------------------- what is not


def precise():
    """Returns a reading 1e4 times as precise as the belief, of sums that the belief knows well."""
    sums = torch.tensor([[1.0, 1.0, 1.0]])
    cov = 1e4 * torch.ones(3, 3) + torch.diag(torch.tensor([1.0, 2.0, 3.0]))
    filter = KalmanFilter(
        torch.eye(3), sums, process_noise_cov=0 * torch.eye(3), noise=[1e-2], mean=torch.zeros(3), cov=cov
    )
    return filter, filter.initialise(TensorDict({"observation": 100 * torch.randn(2, 1)}, [2]))


def many_particles():
    """Moves one particle across a resampling border, so that another takes its place."""
    filter = particles("systematic")
    filter.initial.module = GaussianPrior([0.5, -0.25], [1.0, 1.0], ensemble_size=3000)
    row = filter.initialise(TensorDict({"observation": torch.randn(60, 2)}, [60]))
    return filter, filter.draw_noise(filter.step(row).exclude("noise"))


@pytest.mark.parametrize("make", [precise, many_particles])
def test_rounding_is_measured(make, monkeypatch):
    torch.manual_seed(0)
    filter, row = make()
    filter.compile(backend=compiler(rounded))
    with torch.no_grad():
        with monkeypatch.context() as patch:
            patch.setattr(compared, "_NUDGES", 0)
            with pytest.raises(RuntimeError, match="rounding explains"):  # it is more than the last digits
                filter.step(row.copy())
        assert filter.step(row.copy())["belief", "mean"].isfinite().all()


def test_comparison_runs_once_without_recompilation(monkeypatch):
    """Frames that are zero, expanded, or laid out otherwise: what takes their place is laid out so, too."""
    filter, counting = kalman(), compiler(right)
    filter.compile(backend=counting)
    frames = TensorDict({"observation": torch.zeros(3).expand(2, 3)}, [2])
    frames["observed"] = torch.zeros(3, 2, dtype=torch.bool).mT
    row = filter.initialise(frames)
    with torch.no_grad():
        filter.step(row.copy())
        assert counting.graphs == 1
        monkeypatch.setattr(compared, "_results", None)
        filter.step(row.copy())
    assert counting.graphs == 1


def test_comparison_leaves_the_random_state():
    filter, states = toy_denkf(), []
    row = filter.initialise(toy_frames((2,), masks=0, resets=False))
    for chunk in (0, 1):
        torch.manual_seed(0)
        filter.compile(chunk=chunk, backend="eager").step(row.copy())
        states.append(torch.rand(3))
    assert states[0].equal(states[1])


NAMES = {"names": ["x"], "outputs": ["y"], "frames": [], "what": "thing", "cure": ""}


def test_nan_in_both_is_equal_and_in_one_is_not():
    nan = torch.tensor([1.0, torch.nan, torch.inf])
    check_same_numbers(lambda x: 1 * x, lambda x: x, (nan,), **NAMES)
    with pytest.raises(RuntimeError, match="'y' is up to inf off"):
        check_same_numbers(lambda x: x.nan_to_num(), lambda x: x, (nan,), **NAMES)
    with pytest.raises(RuntimeError, match="'y' is up to 1 off"):  # of marks, too
        check_same_numbers(lambda x: x > 2, lambda x: x > 0, (nan,), **NAMES)


def test_half_precision_inside_rounds_as_such():
    """A compiler keeps more digits between two layers than the eager code, which writes them to memory in bfloat16."""
    x, weight = torch.randn(20, 50), torch.randn(50, 3)

    def half(x):
        return (x.bfloat16() @ weight.bfloat16()).float()

    assert (half(x) - x @ weight).abs().max() > 1e-3 * half(x).abs().max()
    check_same_numbers(lambda x: x @ weight, half, (x,), **NAMES)
    with pytest.raises(RuntimeError, match="'y' is up to"):
        check_same_numbers(half, lambda x: x @ weight, (x,), **NAMES)


def test_numbers_drawn_inside_by_another_generator_are_no_error():
    own = torch.Generator().manual_seed(1)
    x = torch.zeros(100)
    check_same_numbers(lambda x: x + torch.randn(100, generator=own), lambda x: x + torch.randn(100), (x,), **NAMES)
    with pytest.raises(RuntimeError, match="'y' is up to"):
        check_same_numbers(lambda x: x + 50, lambda x: x + torch.randn(100), (x,), **NAMES)


def test_running_means_are_those_of_the_step_alone():
    """The first compiled step also runs eagerly, and on numbers in place of black pictures: that is no training."""
    filter = linear_denkf().float()
    norm = nn.BatchNorm1d(2)
    modules = {"norm": TensorDictModule(norm, ["raw"], ["observation"]), **dict(named_modules_of(filter))}
    filter = Filter(modules, initial=filter.initial).train()
    raw = 3 + torch.randn(6, 2)
    raw[0] = 0.0
    start = filter.initialise(TensorDict({"raw": raw}, [6]))
    found = []
    for backend in (None, "eager"):
        norm.reset_running_stats()
        if backend:
            filter.compile(backend=backend)
        filter.step(start.copy())
        found.append({name: value.clone() for name, value in norm.named_buffers()})
    assert found[0]["num_batches_tracked"] == 1
    torch.testing.assert_close(found[1], found[0])
