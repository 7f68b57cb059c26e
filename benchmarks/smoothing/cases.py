"""The rows of the study: methods and their tuning."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Case:
    """A method on a system.

    Attributes:
        system: a key of ``SYSTEMS``.
        method: ``"EnKS"``, ``"EnRTS"``, ``"IEnKS"`` or ``"particles"``.
        ensemble_size: members or particles.
        lag: cycles; ``None`` for all later ones.
        inflation: factor on the analysis anomalies.
        scheme: of the analysis.
        damping: of EnRTS, in each cycle.
        jitter: of the particle filter.
        ess_threshold: of the particle filter.
    """

    system: str
    method: str
    ensemble_size: int = 100
    lag: int | None = None
    inflation: float = 1.0
    scheme: str = "etkf"
    damping: float = 1.0
    jitter: float = 0.0
    ess_threshold: float | None = None

    def labels(self) -> dict:
        """Returns the labels of the case's rows."""
        return {"system": self.system, "method": self.method, **({} if self.lag is None else {"lag": self.lag})}

    @property
    def name(self) -> str:
        """Returns a name for files."""
        return f"{self.system}-{self.method}-{'all' if self.lag is None else self.lag}"


_L63 = {"system": "lorenz63", "ensemble_size": 100, "inflation": 1.01, "scheme": "perturbed"}
_L96 = {"system": "lorenz96", "ensemble_size": 25, "inflation": 1.08, "scheme": "etkf"}

CASES = [
    Case(method="EnKS", lag=5, **_L63),
    Case(method="EnRTS", **_L63),
    Case("lorenz63", "IEnKS", ensemble_size=10, lag=1, inflation=1.02),
    Case("lorenz63", "particles", ensemble_size=800, lag=0, jitter=0.8, ess_threshold=0.2),
    Case(method="EnKS", lag=4, **_L96),
    Case(method="EnKS", lag=12, **_L96),
    Case(method="EnRTS", damping=0.86, **_L96),
]
