"""Recipes: how a study composes, trains and tunes one kind of filter. The base of both studies' recipes."""

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
    """Recipes by name: a class's own in lower case."""

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
        dims: the dimensions of the state that count, in scores and losses.
        unit: what counts as an error of one in each of them, ``[len(dims)]``.
        encoding: how many features the noise of a reading is learned from.
        observation_key: what is compared with the predicted reading.
    """

    observation_key: NestedKey = ("sensor", "ensemble")
    scaled: ClassVar[tuple[type[nn.Module], ...]] = (ScaledNoise,)  # modules that set_inflation sets
    dims: Sequence[int]
    unit: Tensor
    encoding: int

    def modules(self) -> OrderedDict[str, TensorDictModuleBase]:
        """Everything behind the sensor, by name, in order."""
        raise NotImplementedError

    def readings(self) -> OrderedDict[str, TensorDictModuleBase]:
        """Modules between forecast and reading; none by default."""
        return OrderedDict()

    def noise(self) -> SubModel:
        """R, from what the sensor saw."""
        raise NotImplementedError

    def observation(self) -> SubModel:
        """H."""
        raise NotImplementedError

    def loss(self, model: Filter) -> nn.Module:
        """Returns what the training minimises, on windows with the true state: by default a Gaussian belief's score."""
        return GaussianLoss(model, sensor=0.0, dims=self.dims, state_scale=self.unit)

    def set_inflation(self, model: Filter, factor: float) -> None:
        """Sets the one number that is chosen on the validation data: by default a factor on all noise."""
        for module in model.modules():
            if isinstance(module, self.scaled):
                module.factor = factor

    @property
    def state_scale(self) -> Tensor:
        """Units of an ensemble's loss, ``[S]``: infinite where the state does not count."""
        raise NotImplementedError

    def ensemble_loss(self, model: Filter) -> DEnKFLoss:
        """Returns the fair CRPS of forecast and belief; a score is the mean over what counts."""
        share = self.state_scale.isfinite().float().mean().item()
        return DEnKFLoss(model, state=share, transition=share, sensor=0.0, state_scale=self.state_scale)


class Particles(Recipe):
    """Weighted particles; the likelihood of a reading is a Gaussian or learned, ``learned`` being its bound."""

    particles = 100  # as Jonschkowski et al. and Kloss et al. train with
    resampling, learned = "soft", None
    likelihood_keys: ClassVar[dict[str, NestedKey]] = {}

    def noisy_motion(self) -> SubModel:
        """The motion with its noise."""
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
