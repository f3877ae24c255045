"""A small generated log of Argoverse 2 as it lies on disk: sweeps, poses and labelled boxes."""

import numpy as np
import pytest

from lidarflow import pose

TIMES = (315966265259836000, 315966265360032000, 315966265459992000)
CITY_FROM_VEHICLE = np.stack([pose.from_yaw(0.05 * k, (100.0 + k, 200.0, 3.0)) for k in range(3)])
CAR = np.stack([pose.from_yaw(0.1 * k, (10.0 + 0.5 * k, 2.0, 0.5)) for k in range(3)])     # vehicle_from_box
DOG = np.tile(pose.from_translation([5.0, -5.0, 0.0]), (3, 1, 1))
POINTS = np.array([[10.0, 2.0, 0.5], [12.0625, 2.0, 0.0], [10.0, 2.0, 1.53125], [5.0, -5.0, 0.0],
                   [20.0, 20.0, 0.25], [20.0, 20.0, 0.5], [20.0, 20.0, -4.0], [-90.0, 0.0, 0.0]])


def write_log(folder, labelled=((0, 1, 2), (0, 1))):
    """Three sweeps of the same points; a car of 4 x 2 x 2 m and a dog, labelled in the given sweeps."""
    feather, pa = pytest.importorskip("pyarrow.feather"), pytest.importorskip("pyarrow")
    log = folder / "val" / "7fab"
    (log / "sensors" / "lidar").mkdir(parents=True)

    def write(name, columns):
        feather.write_feather(pa.table(columns), str(log / name))

    def placed(motions):
        rows = pose.to_translation_quaternion(motions).T
        return dict(zip(("tx_m", "ty_m", "tz_m", "qx", "qy", "qz", "qw"), rows, strict=True))

    for time_ns in TIMES:
        write(f"sensors/lidar/{time_ns}.feather",
              {axis: POINTS[:, k].astype(np.float16) for k, axis in enumerate("xyz")})
    write("city_SE3_egovehicle.feather", {"timestamp_ns": TIMES, **placed(CITY_FROM_VEHICLE)})
    cars, dogs = labelled
    kinds = ["REGULAR_VEHICLE"] * len(cars) + ["DOG"] * len(dogs)
    is_car = np.array(kinds) == "REGULAR_VEHICLE"
    write("annotations.feather", {
        "timestamp_ns": [TIMES[k] for k in (*cars, *dogs)],
        "track_uuid": [f"uuid of a {kind}" for kind in kinds], "category": kinds,
        "length_m": np.where(is_car, 4.0, 1.0), "width_m": np.where(is_car, 2.0, 0.5),
        "height_m": np.where(is_car, 2.0, 0.5),
        **placed(np.concatenate([CAR[list(cars)], DOG[list(dogs)]]))})
    return log
