"""The mathematics: tensors in, tensors out, no state, any leading batch dimensions."""

from torch_denkf.functional.analysis import analyse
from torch_denkf.functional.angles import wrap_angles
from torch_denkf.functional.gaussian import kalman_predict, kalman_update
from torch_denkf.functional.localisation import letkf, neighbours
from torch_denkf.functional.resampling import soft_resample, systematic_resample
from torch_denkf.functional.scores import crps_ensemble, crps_gaussian
from torch_denkf.functional.transport import transport_resample
from torch_denkf.functional.unscented import sigma_points

__all__ = [
    "analyse",
    "kalman_predict",
    "kalman_update",
    "sigma_points",
    "wrap_angles",
    "crps_ensemble",
    "crps_gaussian",
    "soft_resample",
    "systematic_resample",
    "transport_resample",
    "letkf",
    "neighbours",
]
