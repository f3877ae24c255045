"""A generated drive with labelled boxes, in the layouts of KITTI's tracking benchmark and raw recordings.

A car drives and turns, a van is parked but drawn 6 cm off in every other frame, a cyclist has a box in the
first two frames only. The sensor drives and turns in the plane.
"""

import numpy as np
from cloud_files import write_bin

from lidarflow import pose
from lidarflow.datasets.oxts import EARTH_RADIUS_M

FRAMES = 5
WORLD_FROM_LIDAR = np.stack([pose.from_yaw(0.02 * k, (0.9 * k, 0.01 * k * k, 0.0)) for k in range(FRAMES)])
# Together they only exchange the axes, so that boxes stand upright for the camera too.
RECTIFICATION = pose.exp(np.array([0.01, -0.008, 0.005, 0, 0, 0]))
CAMERA_FROM_LIDAR = pose.inverse(RECTIFICATION) @ pose.from_rotation_translation(
    [[0, -1, 0], [0, 0, -1], [1, 0, 0]], [-0.004, -0.076, -0.272])
RECTIFIED_FROM_LIDAR = RECTIFICATION @ CAMERA_FROM_LIDAR
LIDAR_FROM_IMU = pose.exp(np.array([-0.002, 0.001, 0.015, -0.81, 0.32, -0.8]))
PROJECTION = np.array([[721.5, 0, 609.6, 44.9], [0, 721.5, 172.9, 0.2], [0, 0, 1, 0.003]])

CAR, VAN, CYCLIST = 4, 11, 2
SIZES = {CAR: (4.2, 1.8, 1.5), VAN: (5.0, 2.0, 2.2), CYCLIST: (1.8, 0.6, 1.7)}
KINDS = {CAR: "Car", VAN: "Van", CYCLIST: "Cyclist"}
SEEN = {CAR: range(FRAMES), VAN: range(FRAMES), CYCLIST: range(2)}
# Inside, near a corner, 4 cm over the floor, and 6 cm outside in front.
ON_CAR = np.array([[1.5, 0.5, 0.2], [-1.9, -0.8, 0.6], [0.0, 0.2, -0.71], [2.16, 0.0, 0.0]])
ON_VAN, ON_CYCLIST = np.array([[1.0, 0.5, 0.5], [-2.0, 0, 0]]), np.array([[0.5, 0.2, 0.3]])
BESIDE = np.array([[30.0, 5.0, 1.0], [49.0, 0, 0], [20.0, -7.5, 0.5],
                   [51.0, 0, 0], [2.0, 0, 0], [10.0, 9.0, 0], [-10.0, 0, 0]])
ROWS = {"car": slice(0, 4), "van": slice(4, 6), "beside": slice(6, 13), "cyclist": slice(13, 14)}
UNLABELLED_FRAME, UNLABELLED = 0, (860.0, 140.0, 900.0, 170.0)     # around the third point of BESIDE


def world_from_box(track, frame):
    """Pose of the middle of a box; the ground is at z = -1.73."""
    height_m = -1.73 + SIZES[track][2] / 2
    if track == CAR:
        return pose.from_yaw(0.1 * frame, (12.0 + 1.5 * frame, 2.0, height_m))
    if track == VAN:
        return pose.from_yaw(0.0, (22.0 + 0.06 * (frame % 2), -5.0, height_m))
    return pose.from_yaw(0.0, (9.0 + 0.4 * frame, -2.0, height_m))


def lidar_from_box(track, frame):
    return pose.inverse(WORLD_FROM_LIDAR[frame]) @ world_from_box(track, frame)


def points_at(frame):
    """Points of the frame as files hold them; the cyclist's are last, and there in all frames."""
    parts = [pose.apply(lidar_from_box(CAR, frame), ON_CAR), pose.apply(lidar_from_box(VAN, frame), ON_VAN),
             BESIDE, pose.apply(lidar_from_box(CYCLIST, frame), ON_CYCLIST)]
    return np.vstack(parts).astype(np.float32).astype(np.float64)


def ego_motion(frame):
    return pose.inverse(WORLD_FROM_LIDAR[frame + 1]) @ WORLD_FROM_LIDAR[frame]


def true_flow(frame, track=None):
    """Flow of all points of the frame if they were on a box, or stood still where no track is given."""
    points = points_at(frame)
    motion = ego_motion(frame)
    if track is not None:
        motion = lidar_from_box(track, frame + 1) @ pose.inverse(lidar_from_box(track, frame))
    return pose.apply(motion, points) - points


def text_of(matrix):
    return " ".join(repr(float(value)) for value in np.ravel(matrix))


def write_tracking(folder, calibration=True, labels=True, poses=None, sequence="0003"):
    """The layout of the tracking benchmark; poses are None, "oxts" or "poses"."""
    part = folder / "training"
    for frame in range(FRAMES):
        write_bin(part / "velodyne" / sequence / f"{frame:06d}.bin", points_at(frame))

    def write(kind, lines):
        (part / kind).mkdir(exist_ok=True)
        (part / kind / f"{sequence}.txt").write_text("\n".join(lines) + "\n")

    if calibration:
        write("calib", [f"P2: {text_of(PROJECTION)}", f"R_rect {text_of(RECTIFICATION[:3, :3])}",
                        f"Tr_velo_cam {text_of(CAMERA_FROM_LIDAR[:3])}",
                        f"Tr_imu_velo {text_of(LIDAR_FROM_IMU[:3])}"])
    if labels:
        write("label_02", tracking_lines())
    if poses == "oxts":
        write("oxts", oxts_lines())
    if poses == "poses":
        cameras = RECTIFIED_FROM_LIDAR @ WORLD_FROM_LIDAR @ pose.inverse(RECTIFIED_FROM_LIDAR)
        write("poses", [text_of(camera[:3]) for camera in cameras])
    return part


def tracking_lines():
    left, top, right, bottom = UNLABELLED
    lines = [f"{UNLABELLED_FRAME} -1 DontCare -1 -1 -10.0 {left} {top} {right} {bottom} "
             "-1000 -1000 -1000 -10 -1 -1 -1"]
    for track, (length, width, height) in SIZES.items():
        for frame in SEEN[track]:
            in_camera = RECTIFIED_FROM_LIDAR @ lidar_from_box(track, frame)
            floor = pose.apply(in_camera, np.array([0.0, 0, -height / 2]))
            along = pose.turn(in_camera, np.array([1.0, 0, 0]))
            turn = -np.arctan2(along[2], along[0])
            lines.append(f"{frame} {track} {KINDS[track]} 0 0 0.5 1 2 3 4 "
                         f"{height} {width} {length} {text_of(floor)} {float(turn)!r}")
    return lines


def oxts_lines(north_deg=49.0):
    scale = np.cos(np.radians(north_deg)) * EARTH_RADIUS_M
    start = scale * np.log(np.tan(np.pi / 4 + np.radians(north_deg) / 2))
    poses, lines = WORLD_FROM_LIDAR @ LIDAR_FROM_IMU, []
    for world_from_imu in poses:
        east, north, up = world_from_imu[:3, 3] - poses[0, :3, 3]
        longitude = 8.4 + np.degrees(east / scale)
        latitude = np.degrees(2 * np.arctan(np.exp((start + north) / scale)) - np.pi / 2)
        turn = world_from_imu[:3, :3]
        roll, pitch = np.arctan2(turn[2, 1], turn[2, 2]), np.arcsin(-turn[2, 0])
        yaw = np.arctan2(turn[1, 0], turn[0, 0])
        lines.append(text_of([latitude, longitude, 112.8 + up, roll, pitch, yaw, *np.zeros(24)]))
    return lines


def write_raw(folder, labels):
    """The layout of a raw recording with navigation; labels are "tracklets" or "table"."""
    drive = folder / "2011_09_26" / "2011_09_26_drive_0099_sync"
    for frame in range(FRAMES):
        write_bin(drive / "velodyne_points" / "data" / f"{frame:010d}.bin", points_at(frame))
    (drive / "oxts" / "data").mkdir(parents=True)
    for frame, line in enumerate(oxts_lines()):
        (drive / "oxts" / "data" / f"{frame:010d}.txt").write_text(line + "\n")
    (drive.parent / "calib_imu_to_velo.txt").write_text(
        f"calib_time: 25-May-2012 16:47:16\nR: {text_of(LIDAR_FROM_IMU[:3, :3])}\n"
        f"T: {text_of(LIDAR_FROM_IMU[:3, 3])}\n")
    if labels == "tracklets":
        (drive / "tracklet_labels.xml").write_text(tracklets())
    else:
        (drive / "boxes.csv").write_text(table())
    return drive


def tracklets():
    items = []
    for track, (length, width, height) in SIZES.items():
        poses = []
        for frame in SEEN[track]:
            motion = lidar_from_box(track, frame)
            x, y, z = motion[:3, 3] - [0, 0, height / 2]
            yaw = np.arctan2(motion[1, 0], motion[0, 0])
            poses.append(f"<item><tx>{x}</tx><ty>{y}</ty><tz>{z}</tz><rx>0</rx><ry>0</ry><rz>{yaw}</rz></item>")
        items.append(f"<item><objectType>{KINDS[track]}</objectType><h>{height}</h><w>{width}</w><l>{length}</l>"
                     f"<first_frame>{SEEN[track][0]}</first_frame><poses><count>{len(poses)}</count>"
                     f"{''.join(poses)}</poses></item>")
    return ("<?xml version='1.0'?><boost_serialization><tracklets><count>3</count>"
            f"{''.join(items)}</tracklets></boost_serialization>")


def table():
    lines = ["frame,track_id,type,x,y,z,length,width,height,yaw"]
    for track, size in SIZES.items():
        for frame in SEEN[track]:
            motion = lidar_from_box(track, frame)
            values = [*motion[:3, 3], *size, np.arctan2(motion[1, 0], motion[0, 0])]
            lines.append(f"{frame},{track},{KINDS[track]}," + ",".join(repr(float(v)) for v in values))
    return "\n".join(lines) + "\n"
