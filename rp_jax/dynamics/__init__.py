"""Vehicles and other bodies: how they move, what they can do, and their baseline policies."""

from rp_jax.dynamics.actions import control_table, mirror_images, mirrored_actions
from rp_jax.dynamics.baseline import (
    BaselinePolicy,
    ControlDistribution,
    Plans,
    independent_controls,
    make_plans,
)
from rp_jax.dynamics.body import Body, VehicleModel, delayed, num_threats
from rp_jax.dynamics.geometry import angle_of, rotate, squared_distance, to_body_frame
from rp_jax.dynamics.vehicle import Control, Vehicle, advance, make_vehicle

__all__ = [
    "BaselinePolicy",
    "Body",
    "Control",
    "ControlDistribution",
    "Plans",
    "Vehicle",
    "VehicleModel",
    "advance",
    "angle_of",
    "control_table",
    "delayed",
    "independent_controls",
    "make_plans",
    "make_vehicle",
    "mirror_images",
    "mirrored_actions",
    "num_threats",
    "rotate",
    "squared_distance",
    "to_body_frame",
]
