"""Recipes, which compose, train and tune one kind of filter in a study, and the base classes of all recipes."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from importlib import import_module
from pkgutil import iter_modules
from typing import ClassVar, TypeVar

from tensordict import NestedKey
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from torch_denkf.filters import Filter
from torch_denkf.modules import GaussianLikelihood, LearnedLikelihood, ScaledNoise, SubModel
from torch_denkf.modules.particles import ParticleAnalysis, ResampledTransition
from torch_denkf.objectives import DEnKFLoss, GaussianLoss, MixtureLoss

R = TypeVar("R", bound=type)


class Registry(dict[str, type]):
    """Recipes by the name of their class in lower case."""

    def register(self, recipe: R) -> R:
        """Makes a filter available to all commands of the study; use it as a decorator."""
        self[recipe.__name__.lower()] = recipe
        return recipe

    @staticmethod
    def import_all(package: str, path: Sequence[str]) -> None:
        """Imports every file of a folder of recipes, so that they register themselves."""
        for module in iter_modules(path):
            import_module(f"{package}.{module.name}")


class Recipe:
    """Composes, trains and tunes one filter. All filters of a study read the same sensor.

    Attributes:
        dims: dimensions of the state in scores and losses.
        unit: of the error in each of them, ``[len(dims)]``.
        encoding: number of features that the noise of a reading is learned from.
        observation_key: the reading to compare with the predicted one.
    """

    observation_key: NestedKey = ("sensor", "ensemble")
    scaled: ClassVar[tuple[type[nn.Module], ...]] = (ScaledNoise,)  # modules that set_inflation sets
    dims: Sequence[int]
    unit: Tensor
    encoding: int

    def modules(self) -> OrderedDict[str, TensorDictModuleBase]:
        """Returns all modules except the sensor by name, in order."""
        raise NotImplementedError

    def readings(self) -> OrderedDict[str, TensorDictModuleBase]:
        """Returns modules between transition and observation; none by default."""
        return OrderedDict()

    def noise(self) -> SubModel:
        """Returns the measurement noise R, from the sensor's encoding."""
        raise NotImplementedError

    def observation(self) -> SubModel:
        """Returns the measurement model."""
        raise NotImplementedError

    def loss(self, model: Filter) -> nn.Module:
        """Returns the training loss on windows with the true state: by default the score of a Gaussian belief."""
        return GaussianLoss(model, sensor=0.0, dims=self.dims, state_scale=self.unit)

    def set_inflation(self, model: Filter, factor: float) -> None:
        """Sets the inflation, which is chosen on validation data: by default a factor on all noise."""
        for module in model.modules():
            if isinstance(module, self.scaled):
                module.factor = factor

    @property
    def state_scale(self) -> Tensor:
        """Returns the units of an ensemble's loss, ``[S]``: infinite for components without a weight in it."""
        raise NotImplementedError

    def ensemble_loss(self, model: Filter) -> DEnKFLoss:
        """Returns the fair CRPS of forecast and belief, averaged over the components with finite units."""
        share = self.state_scale.isfinite().float().mean().item()
        return DEnKFLoss(model, state=share, transition=share, sensor=0.0, state_scale=self.state_scale)


class Particles(Recipe):
    """Particle filters; the likelihood of a reading is Gaussian, or learned with the bound ``learned``."""

    particles = 100  # as Jonschkowski et al. and Kloss et al. train with
    resampling, learned = "soft", None
    likelihood_keys: ClassVar[dict[str, NestedKey]] = {}

    def noisy_motion(self) -> SubModel:
        """Returns the motion with its noise."""
        raise NotImplementedError

    def modules(self):
        motion, modules = self.noisy_motion(), OrderedDict()
        if not self.learned:
            modules["noise"] = self.noise()
        modules |= {"transition": ResampledTransition(motion, self.resampling), **self.readings()}
        likelihood = GaussianLikelihood(observation_key=self.observation_key, **self.likelihood_keys)
        if self.learned:
            keys = {"observation_key": self.observation_key, **self.likelihood_keys}
            likelihood = LearnedLikelihood(self.encoding, len(self.unit), bound=self.learned, scale=self.unit, **keys)
        observation = self.observation()
        return modules | {"observation": observation, "likelihood": likelihood, "analysis": ParticleAnalysis()}

    def loss(self, model):
        return MixtureLoss(model, sensor=0.0, dims=self.dims, state_scale=self.unit)

    def set_inflation(self, model, factor):
        model["analysis"].tempering = factor**-2
