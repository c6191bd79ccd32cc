"""Passivity-preserving neural control barrier functions for torque-controlled robot arms.

The names below are the public interface for control loops and scripts; everything else may change between versions.
"""

from ppcbf_robots.artefact import StoredBarrier, load_barrier
from ppcbf_robots.errors import CheckFailed, InputError, PPCBFError
from ppcbf_robots.filters import FilterConfig, Status
from ppcbf_robots.problem import Problem, Robot, load_problem, load_robot
from ppcbf_robots.robot import Dynamics, RobotModel
from ppcbf_robots.rollout import Trajectory, simulate
from ppcbf_robots.safety import SafetyFunction
from ppcbf_robots.safety_filter import SafetyFilter, StepResult
from ppcbf_robots.shapes import Motion

__version__ = "0.2.0"

__all__ = [
    "CheckFailed",
    "Dynamics",
    "FilterConfig",
    "InputError",
    "Motion",
    "PPCBFError",
    "Problem",
    "Robot",
    "RobotModel",
    "SafetyFilter",
    "SafetyFunction",
    "Status",
    "StepResult",
    "StoredBarrier",
    "Trajectory",
    "load_barrier",
    "load_problem",
    "load_robot",
    "simulate",
]
