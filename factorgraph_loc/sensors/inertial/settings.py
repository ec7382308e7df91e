"""Rig settings of an inertial unit."""

from typing import Annotated

from pydantic import Field

from factorgraph_loc.files.models import InUnit
from factorgraph_loc.model.settings import Angle, Offset, SensorSettings


class InertialSettings(SensorSettings):
    """An inertial unit. Its biases are estimated: each begins near zero and changes at random."""

    x: Offset = 0.0
    """position on the robot, forward"""
    y: Offset = 0.0
    """position on the robot, to the left"""
    z: Offset = 0.0
    """height"""
    roll: Angle = 0.0
    """rotation about the robot's x axis, first"""
    pitch: Angle = 0.0
    """rotation about the robot's y axis, then; down is positive"""
    yaw: Angle = 0.0
    """rotation about the robot's z axis, last; left is positive"""
    force_noise: Annotated[float, Field(ge=1e-6, le=10.0), InUnit("m/s^2 per sqrt(Hz)")]
    """noise density of the specific force"""
    turn_noise: Annotated[float, Field(ge=1e-7, le=1.0), InUnit("rad/s per sqrt(Hz)")]
    """noise density of the turn rate"""
    force_walk: Annotated[float, Field(ge=1e-8, le=1.0), InUnit("m/s^2 per sqrt(s)")]
    """random walk of the biases of the specific force"""
    turn_walk: Annotated[float, Field(ge=1e-9, le=0.1), InUnit("rad/s per sqrt(s)")]
    """random walk of the biases of the turn rate"""
    force_bias: Annotated[float, Field(ge=1e-6, le=10.0), InUnit("m/s^2")] = 0.2
    """standard deviation of the biases of the specific force at the start"""
    turn_bias: Annotated[float, Field(ge=1e-7, le=1.0), InUnit("rad/s")] = 0.05
    """standard deviation of the biases of the turn rate at the start"""
    gravity: Annotated[float, Field(ge=1.0, le=30.0), InUnit("m/s^2")] = 9.81
    """standard gravity at the place; z of the world points up"""
