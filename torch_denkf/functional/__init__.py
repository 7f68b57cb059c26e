"""The mathematics: tensors in, tensors out, no state, any leading batch dimensions."""

from torch_denkf.functional.analysis import analyse
from torch_denkf.functional.angles import wrap_angles
from torch_denkf.functional.gaussian import kalman_predict, kalman_update
from torch_denkf.functional.localisation import letkf, neighbours
from torch_denkf.functional.moments import ensemble_mean, ensemble_var
from torch_denkf.functional.resampling import soft_resample, systematic_resample
from torch_denkf.functional.scores import crps_ensemble, crps_gaussian, energy_score
from torch_denkf.functional.transport import transport_resample
from torch_denkf.functional.unscented import sigma_points
from torch_denkf.functional.weighted import crps_weighted

__all__ = [
    "analyse",
    "ensemble_mean",
    "ensemble_var",
    "kalman_predict",
    "kalman_update",
    "sigma_points",
    "wrap_angles",
    "crps_ensemble",
    "crps_gaussian",
    "energy_score",
    "soft_resample",
    "systematic_resample",
    "transport_resample",
    "letkf",
    "neighbours",
    "crps_weighted",
]
