"""The classes of labelled data sets as the classes of the bucketed metric: the only place that maps them."""

import numpy as np

from lidarflow.types import Category

ARGOVERSE2 = (
    "ANIMAL", "ARTICULATED_BUS", "BICYCLE", "BICYCLIST", "BOLLARD", "BOX_TRUCK", "BUS", "CONSTRUCTION_BARREL",
    "CONSTRUCTION_CONE", "DOG", "LARGE_VEHICLE", "MESSAGE_BOARD_TRAILER", "MOBILE_PEDESTRIAN_CROSSING_SIGN",
    "MOTORCYCLE", "MOTORCYCLIST", "OFFICIAL_SIGNALER", "PEDESTRIAN", "RAILED_VEHICLE", "REGULAR_VEHICLE",
    "SCHOOL_BUS", "SIGN", "STOP_SIGN", "STROLLER", "TRAFFIC_LIGHT_TRAILER", "TRUCK", "TRUCK_CAB",
    "VEHICULAR_TRAILER", "WHEELCHAIR", "WHEELED_DEVICE", "WHEELED_RIDER",
)
"""Class names of Argoverse 2; its label files number them from 1 on, 0 is the background."""

_NAMES = {
    Category.BACKGROUND: ("NONE", "BACKGROUND"),
    # Argoverse 2 counts passenger vans among its regular vehicles.
    Category.CAR: ("REGULAR_VEHICLE", "CAR", "VAN"),
    Category.OTHER_VEHICLES: (
        "ARTICULATED_BUS", "BOX_TRUCK", "BUS", "LARGE_VEHICLE", "RAILED_VEHICLE", "SCHOOL_BUS", "TRUCK",
        "TRUCK_CAB", "VEHICULAR_TRAILER", "TRAM"),
    Category.PEDESTRIAN: (
        "OFFICIAL_SIGNALER", "PEDESTRIAN", "STROLLER", "WHEELCHAIR", "PERSON", "PERSON_SITTING"),
    Category.WHEELED_VRU: (
        "BICYCLE", "BICYCLIST", "MOTORCYCLE", "MOTORCYCLIST", "WHEELED_DEVICE", "WHEELED_RIDER", "CYCLIST"),
}
_CATEGORY = {name: category for category, names in _NAMES.items() for name in names}


def category_of(name: str) -> Category:
    """The Category of a class name of Argoverse 2 or KITTI, in any spelling of case, space or hyphen.

    OTHER for a name that is in none of them, such as animals, signs and KITTI's Misc.
    """
    return _CATEGORY.get(name.strip().upper().replace(" ", "_").replace("-", "_"), Category.OTHER)


def categories_of_argoverse2(classes: np.ndarray) -> np.ndarray:
    """Categories (N,) int8 of the class numbers (N,) of Argoverse 2's labels, 0 = background."""
    table = np.array([Category.BACKGROUND, *map(category_of, ARGOVERSE2)], np.int8)
    return table[classes]
