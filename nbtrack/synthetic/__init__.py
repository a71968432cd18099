"""Analytic furnished rooms: exact signed distance, depth and color, written as RGB-D sequences."""

from nbtrack.synthetic.generate import (
    Frame,
    make_room,
    room_frames,
    room_intrinsics,
    room_of,
)
from nbtrack.synthetic.motion import MotionStatistics, handheld_trajectory, motion_statistics
from nbtrack.synthetic.render import render_frame
from nbtrack.synthetic.room import Room, true_surface_points
from nbtrack.synthetic.rooms import REPORTED_ROOMS, ROOMS, build_room
from nbtrack.synthetic.sensor import add_kinect_noise, filter_depth

__all__ = [
    "REPORTED_ROOMS",
    "ROOMS",
    "Frame",
    "MotionStatistics",
    "Room",
    "add_kinect_noise",
    "build_room",
    "filter_depth",
    "handheld_trajectory",
    "make_room",
    "motion_statistics",
    "render_frame",
    "room_frames",
    "room_intrinsics",
    "room_of",
    "true_surface_points",
]
