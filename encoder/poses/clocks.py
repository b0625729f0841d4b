"""Clocks of cameras: how the time of a file is the time of the clip."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Clock:
    """The clock of a camera: time of the clip = offset_s + rate * time of its file.

    Attributes:
        offset_s: seconds.
        rate: 1 without drift.
        method: "audio", "motion", "given", "reference" or "none".
        confidence: 0 to 1, the share of the sound that agrees, or how likely the offset is right to half a frame by
            what moves; NaN if nothing was measured.
    """

    offset_s: float
    rate: float
    method: str
    confidence: float


UNKNOWN = Clock(0.0, 1.0, "none", float("nan"))
