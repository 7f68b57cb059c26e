"""Attitude by a gyro and an accelerometer in plain numpy: Mahony's filter, and an error-state Kalman filter.

They share nothing with the library, so that it can be compared with them. Quaternions have w first and take the body's
axes to the world's; z points up.

Source: Mahony, Hamel & Pflimlin 2008, IEEE T-AC 53; Solà 2017, arXiv:1711.02508, chapter 7.
"""

from __future__ import annotations

import numpy as np
from numpy import ndarray

from benchmarks.common.quaternions import exp, matrix, product, right_jacobian, skew

__all__ = ["error_state_filter", "integrate", "mahony"]


def integrate(gyro: ndarray, dt: ndarray, start: ndarray) -> ndarray:
    """Returns orientations ``[R, T, 4]`` by the gyro ``[R, T, 3]`` alone; the first row's is ``start`` ``[R, 4]``."""
    found = [start]
    for row in range(1, gyro.shape[1]):
        found.append(product(found[-1], exp(gyro[:, row] * dt[:, row])))
    return np.stack(found, 1)


def mahony(
    gyro: ndarray, force: ndarray, dt: ndarray, start: ndarray, proportional: float = 0.5, integral: float = 0.05
) -> ndarray:
    """Returns orientations ``[R, T, 4]`` by Mahony's filter: the gyro, corrected towards the accelerometer's vertical.

    Args:
        gyro: ``[R, T, 3]`` rad/s.
        force: of the accelerometer, ``[R, T, 3]``, in any unit.
        dt: ``[R, T, 1]`` s.
        start: orientations ``[R, 4]`` of the first row.
        proportional: gain of the correction, 1/s.
        integral: gain of the bias's correction, 1/s^2.
    """
    found, bias = [start], np.zeros((len(start), 3))
    for row in range(1, gyro.shape[1]):
        away = np.cross(_unit(force[:, row]), _up(found[-1]))
        bias = bias - integral * away * dt[:, row]
        found.append(product(found[-1], exp((gyro[:, row] - bias + proportional * away) * dt[:, row])))
    return np.stack(found, 1)


def error_state_filter(
    gyro: ndarray,
    force: ndarray,
    dt: ndarray,
    start: ndarray,
    gyro_noise: float,
    gyro_walk: float,
    up_noise: float,
    start_std: float = 0.05,
    bias_std: float = 0.01,
) -> tuple[ndarray, ndarray, ndarray]:
    """Runs an extended Kalman filter of orientation and gyro bias, with orientation errors in body axes.

    Args:
        gyro: ``[R, T, 3]`` rad/s.
        force: of the accelerometer, ``[R, T, 3]``, in any unit; its direction is the reading.
        dt: ``[R, T, 1]`` s.
        start: orientations ``[R, 4]`` of the first row.
        gyro_noise: density in rad/s/sqrt(Hz).
        gyro_walk: of the bias, in rad/s^2/sqrt(Hz).
        up_noise: standard deviation of that direction in rad, of one reading.
        start_std: of ``start``, in rad.
        bias_std: of the bias, in rad/s.

    Returns:
        Orientations ``[R, T, 4]``, biases ``[R, T, 3]`` and covariances of both errors ``[R, T, 6, 6]``.
    """
    runs = len(start)
    turn, bias = start, np.zeros((runs, 3))
    cov = np.tile(np.diag([start_std**2] * 3 + [bias_std**2] * 3), (runs, 1, 1))
    found = [(turn, bias, cov)]
    for row in range(1, gyro.shape[1]):
        step = dt[:, row]
        angles = (gyro[:, row] - bias) * step
        turn = product(turn, exp(angles))
        move = np.tile(np.eye(6), (runs, 1, 1))
        move[:, :3, :3] = matrix(exp(-angles))
        move[:, :3, 3:] = -step[..., None] * right_jacobian(angles)
        cov = move @ cov @ move.mT
        cov[:, range(6), range(6)] += np.array([gyro_noise**2] * 3 + [gyro_walk**2] * 3) * step
        up = _up(turn)
        reads = np.concatenate([skew(up), np.zeros((runs, 3, 3))], -1)
        gain = cov @ reads.mT @ np.linalg.inv(reads @ cov @ reads.mT + up_noise**2 * np.eye(3))
        change = (gain @ (_unit(force[:, row]) - up)[..., None])[..., 0]
        reset = np.tile(np.eye(6), (runs, 1, 1))
        reset[:, :3, :3] = right_jacobian(change[:, :3])
        cov = reset @ (np.eye(6) - gain @ reads) @ cov @ reset.mT
        cov = 0.5 * (cov + cov.mT)
        turn, bias = product(turn, exp(change[:, :3])), bias + change[:, 3:]
        found.append((turn, bias, cov))
    turns, biases, covs = (np.stack(each, 1) for each in zip(*found, strict=True))
    return turns, biases, covs


def _up(q: ndarray) -> ndarray:
    """Returns the world's z in the body's axes."""
    return matrix(q)[..., 2, :]


def _unit(v: ndarray) -> ndarray:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)
