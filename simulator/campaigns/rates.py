"""Rates of independent windows, with their intervals."""

import scipy.stats
from pydantic import BaseModel, ConfigDict

__all__ = ["Rate"]


class Rate(BaseModel):
    """A rate with its 95 % Clopper-Pearson interval."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    count: int
    of: int
    rate: float
    low: float
    high: float

    @classmethod
    def of_counts(cls, count: int, of: int) -> "Rate":
        """Rate of `count` in `of` independent windows."""
        low = 0.0 if count == 0 else float(scipy.stats.beta.ppf(0.025, count, of - count + 1))
        high = 1.0 if count == of else float(scipy.stats.beta.ppf(0.975, count + 1, of - count))
        return cls(count=count, of=of, rate=count / of, low=low, high=high)
