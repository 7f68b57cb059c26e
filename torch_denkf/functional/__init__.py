"""The mathematics: tensors in, tensors out, no state, any leading batch dimensions."""

from torch_denkf.functional.analysis import Analysis, Scheme, Space, analyse
from torch_denkf.functional.angles import align_angles, mean_observation, wrap_angles
from torch_denkf.functional.change_detection import cusum_run_length, cusum_step, cusum_threshold, normal_score
from torch_denkf.functional.chi_square import (
    chi_square_p_value,
    chi_square_quantile,
    detectable_bias,
    noncentral_p_value,
)
from torch_denkf.functional.continuous import discretise
from torch_denkf.functional.dropped_relu import dropped_relu
from torch_denkf.functional.gating import Response, adapt, disbelief, spread_about_mean
from torch_denkf.functional.gaussian import GaussianUpdate, gaussian_log_prob, kalman_predict, kalman_update
from torch_denkf.functional.inflation import inflate, random_rotation, relax_to_prior_spread
from torch_denkf.functional.joint_moments import joint_forecast
from torch_denkf.functional.linalg import (
    cholesky,
    inverse_square_root,
    inverse_square_root_difference,
    semidefinite_root,
    semidefinite_solve,
)
from torch_denkf.functional.localisation import Neighbours, gaspari_cohn, letkf, neighbours, neighbours_of_taper
from torch_denkf.functional.moments import (
    ensemble_anomalies,
    ensemble_cov,
    ensemble_mean,
    ensemble_var,
)
from torch_denkf.functional.monitoring import (
    InnovationTests,
    InnovationWindow,
    innovation_tests,
    interpolate,
    observe,
)
from torch_denkf.functional.random_bits import (
    dropout_factor,
    random_bytes,
    random_keep_mask,
    random_signs,
    representable_rate,
)
from torch_denkf.functional.resampling import effective_sample_size, jitter_copies, soft_resample, systematic_resample
from torch_denkf.functional.scores import crps_ensemble, crps_gaussian, energy_score
from torch_denkf.functional.sharded import analyse_sharded
from torch_denkf.functional.smoothing import rts_smooth, rts_step, smoothing_gain
from torch_denkf.functional.smoothing_ensemble import enrts_smooth, enrts_step
from torch_denkf.functional.smoothing_iterated import iterated_smoothing
from torch_denkf.functional.smoothing_particles import backward_smooth, backward_weights
from torch_denkf.functional.transport import transport_resample
from torch_denkf.functional.unicycle import unicycle_jacobians, unicycle_move
from torch_denkf.functional.unscented import (
    UnscentedWeights,
    sigma_points,
    unscented_cross,
    unscented_moments,
    unscented_update,
    unscented_weights,
)
from torch_denkf.functional.weighted import crps_weighted, weighted_innovation, weighted_mean, weighted_var

__all__ = [
    "Analysis",
    "Scheme",
    "Space",
    "analyse",
    "analyse_sharded",
    "joint_forecast",
    "ensemble_mean",
    "ensemble_anomalies",
    "ensemble_var",
    "ensemble_cov",
    "inflate",
    "relax_to_prior_spread",
    "random_rotation",
    "GaussianUpdate",
    "kalman_predict",
    "kalman_update",
    "gaussian_log_prob",
    "UnscentedWeights",
    "unscented_weights",
    "sigma_points",
    "unscented_moments",
    "unscented_cross",
    "unscented_update",
    "discretise",
    "wrap_angles",
    "align_angles",
    "mean_observation",
    "crps_ensemble",
    "crps_gaussian",
    "energy_score",
    "dropout_factor",
    "dropped_relu",
    "random_bytes",
    "random_keep_mask",
    "random_signs",
    "representable_rate",
    "cholesky",
    "inverse_square_root",
    "inverse_square_root_difference",
    "semidefinite_root",
    "semidefinite_solve",
    "smoothing_gain",
    "rts_step",
    "rts_smooth",
    "enrts_step",
    "enrts_smooth",
    "iterated_smoothing",
    "backward_weights",
    "backward_smooth",
    "effective_sample_size",
    "jitter_copies",
    "soft_resample",
    "systematic_resample",
    "transport_resample",
    "Neighbours",
    "gaspari_cohn",
    "letkf",
    "neighbours",
    "neighbours_of_taper",
    "unicycle_move",
    "unicycle_jacobians",
    "weighted_mean",
    "weighted_var",
    "weighted_innovation",
    "crps_weighted",
    "chi_square_p_value",
    "chi_square_quantile",
    "noncentral_p_value",
    "detectable_bias",
    "normal_score",
    "cusum_step",
    "cusum_run_length",
    "cusum_threshold",
    "InnovationWindow",
    "InnovationTests",
    "observe",
    "innovation_tests",
    "interpolate",
    "Response",
    "disbelief",
    "adapt",
    "spread_about_mean",
]
