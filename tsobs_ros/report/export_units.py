# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The units of common messages, as REP 103 and the messages' definitions have them.

A unit belongs to a field of a type, and to whatever lies below that field: a Twist's `angular` is
a Vector3 in rad/s. What is not listed here has no unit.
"""

from collections.abc import Mapping

NONE = ""

_POINT = {"x": "m", "y": "m", "z": "m"}

UNITS: Mapping[str, Mapping[str, str]] = {
    "builtin_interfaces/Time": {"sec": "s", "nanosec": "ns"},
    "builtin_interfaces/Duration": {"sec": "s", "nanosec": "ns"},
    "geometry_msgs/Accel": {"linear": "m/s^2", "angular": "rad/s^2"},
    "geometry_msgs/Inertia": {
        "m": "kg",
        "com": "m",
        **dict.fromkeys(("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), "kg m^2"),
    },
    "geometry_msgs/Point": _POINT,
    "geometry_msgs/Point32": _POINT,
    "geometry_msgs/Pose2D": {"x": "m", "y": "m", "theta": "rad"},
    "geometry_msgs/Transform": {"translation": "m", "rotation": NONE},
    "geometry_msgs/Twist": {"linear": "m/s", "angular": "rad/s"},
    "geometry_msgs/Wrench": {"force": "N", "torque": "N m"},
    "nav_msgs/MapMetaData": {"resolution": "m"},
    "sensor_msgs/BatteryState": {
        "voltage": "V",
        "current": "A",
        "charge": "A h",
        "capacity": "A h",
        "design_capacity": "A h",
        "temperature": "degC",
        "cell_voltage": "V",
        "cell_temperature": "degC",
    },
    "sensor_msgs/FluidPressure": {"fluid_pressure": "Pa"},
    "sensor_msgs/Illuminance": {"illuminance": "lx"},
    "sensor_msgs/Imu": {"angular_velocity": "rad/s", "linear_acceleration": "m/s^2"},
    # Of revolute joints; a bag does not tell which joints are prismatic.
    "sensor_msgs/JointState": {"position": "rad", "velocity": "rad/s", "effort": "N m"},
    "sensor_msgs/LaserScan": {
        "angle_min": "rad",
        "angle_max": "rad",
        "angle_increment": "rad",
        "time_increment": "s",
        "scan_time": "s",
        "range_min": "m",
        "range_max": "m",
        "ranges": "m",
    },
    "sensor_msgs/MagneticField": {"magnetic_field": "T"},
    "sensor_msgs/NavSatFix": {"latitude": "deg", "longitude": "deg", "altitude": "m"},
    "sensor_msgs/Range": {
        "field_of_view": "rad",
        "min_range": "m",
        "max_range": "m",
        "range": "m",
    },
    "sensor_msgs/Temperature": {"temperature": "degC"},
    "trajectory_msgs/JointTrajectoryPoint": {
        "positions": "rad",
        "velocities": "rad/s",
        "accelerations": "rad/s^2",
        "effort": "N m",
    },
}
"""By type and field."""


def unit_of(type_: str, field: str, inherited: str) -> str:
    """Return the unit of a type's field, empty for none.

    Args:
        type_: As `package/Type`.
        field: Its name.
        inherited: The unit of what the type is a part of.
    """
    if "covariance" in field:
        return NONE
    return UNITS.get(type_, {}).get(field, inherited)
