"""How long the history is kept."""

from pydantic import BaseModel, ConfigDict, Field

__all__ = ["Retention"]


class Retention(BaseModel):
    """How long the history is kept, by the computer's time of recording; alarm events and audit log are kept for ever.

    Readings are reduced to buckets as they come: count, least, mean and largest value, and mean standard error. Buckets
    never go before the readings in them.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    reports_days: float = Field(
        default=14.0, gt=0.0, le=36_500.0, description="how long full reports are kept, in days; about 2 kB each"
    )
    readings_days: float = Field(
        default=90.0, gt=0.0, le=36_500.0, description="how long every single reading is kept, in days"
    )
    bucket_s: int = Field(
        default=600, ge=1, le=86_400, description="length of the stretch that readings are reduced to, in seconds"
    )
    buckets_days: float = Field(
        default=3650.0, gt=0.0, le=36_500.0, description="how long these reduced readings are kept, in days"
    )
