"""Scenes with known truth: a ray-cast LiDAR in generated worlds of rigid, moving parts."""

from lidarflow.synthetic.human_motion import human_motion
from lidarflow.synthetic.kitti import write_kitti
from lidarflow.synthetic.places import one_car, room
from lidarflow.synthetic.raycast import scan_sequence
from lidarflow.synthetic.scene import Part, Scene
from lidarflow.synthetic.sensor import Sensor, hdl32e, hdl64e
from lidarflow.synthetic.street import street

__all__ = ["Part", "Scene", "Sensor", "hdl32e", "hdl64e", "human_motion", "one_car", "room", "scan_sequence",
           "street", "write_kitti"]
