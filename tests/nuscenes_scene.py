"""Generated scenes in nuScenes' own tables, v1.0-mini: three sweeps of the LiDAR, 20 Hz."""

import json

import numpy as np
from PIL import Image

SCENES = (61, 553, 655, 757, 796, 1077, 1094, 1100)     # the split of v1.0-mini wants all of them
LOG = "n015-2018-07-24-11-22-45+0800"
TIMES_US = (1_532_402_927_600_000, 1_532_402_927_650_000, 1_532_402_927_700_000)
STEP_M = 0.4       # along x, from sweep to sweep
CLOUDS = [np.random.default_rng(k).normal(size=(40, 3)).astype(np.float32) * 10 for k in range(3)]
_EMPTY = ("category", "attribute", "visibility", "instance", "sample_annotation")
_UPRIGHT = [1.0, 0.0, 0.0, 0.0]


def write_scene(folder):
    """Tables of scenes, of which the first has sweeps; the LiDAR sits 1.8 m above the vehicle's origin."""
    tables = {name: [] for name in _EMPTY}
    tables["sensor"] = [{"token": "lidar", "channel": "LIDAR_TOP", "modality": "lidar"}]
    tables["calibrated_sensor"] = [{"token": "top", "sensor_token": "lidar", "translation": [0.9, 0.0, 1.8],
                                    "rotation": _UPRIGHT, "camera_intrinsic": []}]
    tables["log"] = [{"token": "log", "logfile": LOG, "vehicle": "n015", "location": "singapore-onenorth",
                      "date_captured": "2018-07-24"}]
    tables["map"] = [{"token": "map", "log_tokens": ["log"], "category": "semantic_prior",
                      "filename": "maps/map.png"}]
    tables["scene"] = [{"token": f"scene{number}", "name": f"scene-{number:04d}", "log_token": "log",
                        "nbr_samples": 1, "first_sample_token": f"sample{number}",
                        "last_sample_token": f"sample{number}", "description": "generated"}
                       for number in SCENES]
    tables["sample"] = [{"token": f"sample{number}", "timestamp": TIMES_US[0] - SCENES[0] + number,
                         "scene_token": f"scene{number}", "prev": "", "next": ""} for number in SCENES]
    tables["ego_pose"] = [{"token": f"pose{k}", "timestamp": time_us, "rotation": _UPRIGHT,
                           "translation": [600.0 + STEP_M * k, 1600.0, 0.0]}
                          for k, time_us in enumerate(TIMES_US)]
    names = ["", *(f"sweep{k}" for k in range(3)), ""]
    tables["sample_data"] = [
        {"token": names[k + 1], "sample_token": "sample61", "timestamp": time_us, "fileformat": "pcd",
         "ego_pose_token": f"pose{k}", "calibrated_sensor_token": "top",
         "filename": f"sweeps/LIDAR_TOP/{k}.pcd.bin", "is_key_frame": k == 0, "height": 0,
         "width": 0, "prev": names[k], "next": names[k + 2]}
        for k, time_us in enumerate(TIMES_US)]
    (folder / "v1.0-mini").mkdir(parents=True)
    for name, rows in tables.items():
        (folder / "v1.0-mini" / f"{name}.json").write_text(json.dumps(rows))
    (folder / "maps").mkdir()
    Image.fromarray(np.zeros((4, 4), np.uint8)).save(folder / "maps" / "map.png")
    (folder / "sweeps" / "LIDAR_TOP").mkdir(parents=True)
    for k, cloud in enumerate(CLOUDS):
        rows = np.column_stack([cloud, np.zeros((len(cloud), 2))]).astype(np.float32)
        rows.tofile(folder / "sweeps" / "LIDAR_TOP" / f"{k}.pcd.bin")
    return folder
