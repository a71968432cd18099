"""Analytic furnished rooms: exact signed distance, depth and color, written as RGB-D sequences."""

from nbtrack.synthetic.keyframes import keyframe_trajectory
from nbtrack.synthetic.make import make_room, room_frames, room_intrinsics, room_of, room_version
from nbtrack.synthetic.motion import handheld_trajectory
from nbtrack.synthetic.render import add_kinect_noise, filter_depth, render_frame
from nbtrack.synthetic.room import REPORTED_ROOMS, ROOMS, Room, build_room
