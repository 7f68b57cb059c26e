"""The rows of the study: method, tuning, and the error to stay under."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Case:
    """A method on a system.

    Attributes:
        system: a key of ``SYSTEMS``.
        method: ``"EnKS"``, ``"EnRTS"``, ``"IEnKS"`` or ``"particles"``.
        target: the largest mean error over the seeds.
        scored: whose error that is, ``"smoother"`` or ``"filter"``.
        ensemble_size: members or particles.
        lag: cycles; ``None`` for all that come later.
        inflation: factor on the analysis anomalies.
        scheme: of the analysis.
        damping: of EnRTS, in each cycle.
        jitter: of the particles.
        ess_threshold: likewise.
    """

    system: str
    method: str
    target: float
    scored: str = "smoother"
    ensemble_size: int = 100
    lag: int | None = None
    inflation: float = 1.0
    scheme: str = "etkf"
    damping: float = 1.0
    jitter: float = 0.0
    ess_threshold: float | None = None

    def labels(self) -> dict:
        """What tells this case's rows from others'."""
        return {"system": self.system, "method": self.method, **({} if self.lag is None else {"lag": self.lag})}

    @property
    def name(self) -> str:
        """For files."""
        return f"{self.system}-{self.method}-{'all' if self.lag is None else self.lag}"


_L63 = {"system": "lorenz63", "ensemble_size": 100, "inflation": 1.01, "scheme": "perturbed"}
_L96 = {"system": "lorenz96", "ensemble_size": 25, "inflation": 1.08, "scheme": "etkf"}

CASES = [
    Case(method="EnKS", lag=5, target=0.32, **_L63),
    Case(method="EnRTS", target=0.33, **_L63),
    Case("lorenz63", "IEnKS", 0.33, "filter", ensemble_size=10, lag=1, inflation=1.02),
    Case("lorenz63", "particles", 0.28, "filter", ensemble_size=800, lag=0, jitter=0.8, ess_threshold=0.2),
    Case(method="EnKS", lag=4, target=0.235, **_L96),
    Case(method="EnKS", lag=12, target=0.22, **_L96),
    Case(method="EnRTS", target=0.215, damping=0.86, **_L96),
]
