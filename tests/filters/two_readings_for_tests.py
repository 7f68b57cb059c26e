"""Parts of an ensemble filter that reads the two observations of the linear system one after the other."""

from tests.filters.factories import linear_system
from torch_denkf.modules import ConstantNoise, EnsembleAnalysis, LinearObservation


def parts_of_reading(index, before, after, scheme="etkf", **kwargs):
    """Noise ``r``, observation ``h`` and analysis ``a`` of reading ``y``, 0 or 1, between two prefixes of ensembles."""
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
