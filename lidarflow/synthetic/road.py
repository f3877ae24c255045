"""A gently curved road: where things stand, how high the ground is, and how things move along it.

A place on the road is (s, d): metres along the centre line and metres to its left.
"""

from dataclasses import dataclass

import numpy as np

from lidarflow import pose
from lidarflow.synthetic.scene import Path
from lidarflow.synthetic.shapes import Mesh, sheet

_WAVES = 6


@dataclass(frozen=True, slots=True, eq=False)
class Road:
    """A road on an arc, with camber, kerbs, a level crossing street and uneven ground.

    curvature       float          1 / m, positive to the left
    kerb_d          float          distance of the kerb line from the centre
    kerb_m          float          height of the kerb
    crossing        (first, last)  s between which a street without kerbs crosses
    waves           (W, 3) float   wave numbers along s and d [rad/m] and phase [rad] of the unevenness
    unevenness_m    float          amplitude of one wave
    """

    curvature: float
    kerb_d: float
    kerb_m: float
    crossing: tuple[float, float]
    waves: np.ndarray
    unevenness_m: float = 0.012

    def height(self, s: np.ndarray, d: np.ndarray) -> np.ndarray:
        """Height of the ground (...) at places s, d (...)."""
        s, d = np.asarray(s, float), np.asarray(d, float)
        first, last = self.crossing
        kerb = np.clip(np.maximum(first - s, s - last) / 0.6, 0.0, 1.0) * self.kerb_m
        camber = -0.02 * np.minimum(np.abs(d), self.kerb_d)
        step = np.clip((np.abs(d) - self.kerb_d) / 0.03, 0.0, 1.0) * kerb
        phase = s[..., None] * self.waves[:, 0] + d[..., None] * self.waves[:, 1] + self.waves[:, 2]
        return camber + step + self.unevenness_m * np.sin(phase).sum(axis=-1)

    def positions(self, s: np.ndarray, d: np.ndarray) -> np.ndarray:
        """World points (..., 3) on the ground at places s, d (...)."""
        heading = self.curvature * np.asarray(s, float)
        radius = 1.0 / self.curvature
        x, y = np.sin(heading) * (radius - d), radius - np.cos(heading) * (radius - d)
        return np.stack([x, y, self.height(s, d)], axis=-1)

    def pose_at(self, s: float, d: float, yaw: float = 0.0) -> np.ndarray:
        """world_from_thing (4, 4) of something upright at (s, d), turned by `yaw` from the road's heading."""
        return pose.from_yaw(self.curvature * s + yaw, self.positions(s, d))

    def path(self, start: tuple[float, float], speeds_m_per_s: tuple[float, float]) -> Path:
        """Steady motion from `start` (s, d) with speeds along s and d, looking where it goes."""
        (s, d), (along, across) = start, speeds_m_per_s
        yaw = np.arctan2(across, along)
        return lambda time_s: self.pose_at(s + along * time_s, d + across * time_s, yaw)

    def ground(self, s_range: tuple[float, float], d_max: float) -> Mesh:
        """The surface of road, pavements and land, fine near the road."""
        near = np.arange(0.0, self.kerb_d, 0.5)
        kerb = self.kerb_d + np.array([0.0, 0.03])
        beyond = np.arange(self.kerb_d + 0.5, 20.0, 0.75)
        half = np.concatenate([near, kerb, beyond, np.arange(20.0, d_max, 4.0)])
        d = np.concatenate([-half[:0:-1], half])
        s = np.union1d(np.arange(*s_range, 0.75), np.array(self.crossing).repeat(2) + [-0.6, 0, 0, 0.6])
        return sheet(self.positions(*np.meshgrid(s, d, indexing="ij")))


def winding_road(rng: np.random.Generator) -> Road:
    """A city road with bicycle and parking lanes, bending to either side on a radius of 350 m."""
    waves = np.column_stack([
        rng.uniform(0.15, 0.9, _WAVES), rng.uniform(-0.6, 0.6, _WAVES), rng.uniform(0, 2 * np.pi, _WAVES)])
    curvature = float(rng.choice([-1.0, 1.0])) / 350.0
    return Road(curvature, kerb_d=6.6, kerb_m=0.12, crossing=(16.5, 35.0), waves=waves)
