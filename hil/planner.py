"""From a request to a reference the loop can index, checked over its whole length.

A plan is C2 from the present reference to its end, and ends at rest, so that it can be held:
approach, trajectory, and a braking where the trajectory ends moving.
"""

from dataclasses import dataclass
from functools import singledispatch
from math import ceil, isfinite

import numpy as np

from controller import trajectory
from controller.errors import LimitError, TrajectoryError
from controller.reference import MotionLimits, MotionState, Reference, Violation, concatenate, distinct
from hil.errors import HilError
from hil.messages import (
    ExponentialSineRequest,
    KellyRequest,
    MoveRequest,
    Reply,
    SamplesRequest,
    SinusoidRequest,
    TrajectoryRequest,
    WaypointsRequest,
)

__all__ = ["MotionLimits", "MotionState", "Refusal", "plan"]
