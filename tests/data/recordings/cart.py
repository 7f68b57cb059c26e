"""A cart in the plane: its truth, fixes of which some are wrong, and its wheel."""

import numpy as np

OFF, NOISE = 3.0, 0.1  # m: how wrong outliers are, and the standard deviation of all fixes


def cart(seconds, share, seed=2, gaps=()):
    """Returns the truth ``[n, 4]`` at 20 Hz (time, x, y, speed), fixes at 5 Hz, which are outliers, and speeds."""
    rng, dt = np.random.default_rng(seed), 0.05
    time = np.arange(round(seconds / dt)) * dt
    speed, turned = 1 + 0.3 * np.sin(0.3 * time), np.cumsum(0.2 * np.sin(0.17 * time) * dt)
    place = np.cumsum(np.c_[speed * np.cos(turned), speed * np.sin(turned)] * dt, 0)
    fixed = np.arange(len(time)) % 4 == 0
    for begin, end in gaps:
        fixed &= (time < begin) | (time > end)
    wrong, angle = rng.random(fixed.sum()) < share, rng.uniform(0, 2 * np.pi, fixed.sum())
    fixes = place[fixed] + NOISE * rng.normal(size=(fixed.sum(), 2))
    fixes += OFF * wrong[:, None] * np.c_[np.cos(angle), np.sin(angle)]
    wheel = np.c_[time, speed + 0.05 * rng.normal(size=len(time))]
    return np.c_[time, place, speed], np.c_[time[fixed], fixes], wrong, wheel


def write_cart(folder, *cart_of):
    """Writes ``fixes.csv`` and ``wheel.csv``; returns their paths as words and the truth."""
    truth, fixes, _, wheel = cart_of
    np.savetxt(folder / "fixes.csv", fixes, "%.3f", ",", header="t,x [m],y [m]", comments="")
    np.savetxt(folder / "wheel.csv", wheel, "%.3f", ",", header="t,speed [m/s]", comments="")
    return [str(folder / "fixes.csv"), str(folder / "wheel.csv")], truth
