"""Scenes with known truth: a ray-cast LiDAR and a rendered RGB-D camera in worlds of rigid, moving parts."""

from lidarflow.synthetic.human_motion import human_motion
from lidarflow.synthetic.kitti import write_kitti
from lidarflow.synthetic.places import one_car, room
from lidarflow.synthetic.raycast import scan_sequence
from lidarflow.synthetic.rgbd import RgbdSensor, rgbd_sequence
from lidarflow.synthetic.rooms import TexturedScene, living_room, passing_wardrobe
from lidarflow.synthetic.scene import Part, Scene
from lidarflow.synthetic.sensor import Sensor, hdl32e, hdl64e
from lidarflow.synthetic.street import street
from lidarflow.synthetic.tum import write_tum

__all__ = ["Part", "RgbdSensor", "Scene", "Sensor", "TexturedScene", "hdl32e", "hdl64e", "human_motion",
           "living_room", "one_car", "passing_wardrobe", "rgbd_sequence", "room", "scan_sequence", "street",
           "write_kitti", "write_tum"]
