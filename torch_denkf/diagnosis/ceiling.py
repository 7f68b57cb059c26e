"""Warns if a variance of the belief has reached the filter's ceiling."""

from __future__ import annotations

from torch_denkf._checks import flag_value
from torch_denkf.beliefs import Belief, Particles
from torch_denkf.diagnosis.once import Once
from torch_denkf.filters.base import Filter
from torch_denkf.filters.finish import Record
from torch_denkf.modules.variance_ceiling import VarianceCeiling

__all__ = ["CeilingReached"]


class CeilingReached(Once):
    """Warns once if a variance is clamped to ``variance_ceiling``, without waiting for a GPU."""

    def __call__(self, filter: Filter, record: Record) -> None:
        """Looks at the variances that a filter wrote."""
        ceiling = filter.structure.posterior[-1][1] if filter.structure.posterior else None
        if self.said or not isinstance(ceiling, VarianceCeiling) or not (ceiling.reached or filter.compiled):
            return
        for kind in filter.structure.kinds:
            value = record.written.get(kind.key("var"))
            if value is None or value.is_cuda:
                continue
            if flag_value((value >= 0.999 * ceiling.ceiling).any()):
                self._say(filter, kind)

    def _say(self, filter: Filter, kind: Belief) -> None:
        why = "nothing observes what grows."
        if isinstance(kind, Particles):
            why = (
                "some particles have run away, or nothing observes what grows. Particles are held near their weighted "
                "median until a reading takes their weight. If the motion throws single particles away, start from a "
                "narrower belief, or bound the motion."
            )
        self.warn(
            "ceiling",
            f"The variance in {kind.key('var')!r} has reached variance_ceiling={filter.variance_ceiling:g} and is held "
            f"there: {why}",
        )
