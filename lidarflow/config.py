"""Every algorithm setting of the LiDAR side, frozen, with its unit and effect.

Order of precedence: the defaults here, then a TOML file, then `section.name=value` overrides. Viewer options
and paths are not settings.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, overload

from lidarflow.errors import ConfigError
from lidarflow.settings import Settings, check_together, parse_override, read_toml, setting, to_dict, updated


@dataclass(frozen=True, slots=True)
class PreparationConfig:
    kitti_correction: str = setting(
        "auto", "raise KITTI points by the 0.205 deg that their calibration lacks; auto = for KITTI data",
        choices=("auto", "on", "off"))
    min_range_m: float = setting(1.5, "nearer returns are the ego vehicle and are masked", low=0,
                                 below="max_range_m")
    max_range_m: float = setting(80.0, "farther returns are masked", low=1)


@dataclass(frozen=True, slots=True)
class GroundConfig:
    sensor_height_m: float = setting(0.0, "height of the sensor over ground; 0 = estimated per scan", low=0)
    max_height_m: float = setting(
        0.25, "points higher than this over the low ground of their cell of 2 m, plus a slope of one in ten, "
        "are not ground", low=0.02)
    fill_height_m: float = setting(
        0.12, "points within this height of the ground around them are ground as well", low=0)


@dataclass(frozen=True, slots=True)
class NormalsConfig:
    radius_m: float = setting(0.6, "radius of the neighbourhood that a plane is fitted to", low=0.01)


@dataclass(frozen=True, slots=True)
class MeshConfig:
    method: str = setting("auto", "scan grid for spinning sensors, tangent planes for other clouds",
                          choices=("auto", "grid", "tangent"))
    max_edge_m: float = setting(
        0.395, "longest edge; see max_edge_rings for what is far from a spinning sensor", low=0.01)
    max_edge_rings: float = setting(
        1.25, "longest edge in spacings of a spinning sensor's rings, where those are farther apart than "
        "max_edge_m; 0 = max_edge_m everywhere", low=0)
    max_depth_jump_m: float = setting(0.36, "largest change of range along an edge", low=0.01)
    min_grazing_deg: float = setting(
        4.0, "an edge closer than this to the line of sight is a jump between surfaces", low=0, high=60)


@dataclass(frozen=True, slots=True)
class ShotConfig:
    radius_m: float = setting(1.4, "radius of the neighbourhood that a descriptor sees", low=0.05)
    surface_voxel_m: float = setting(0.12, "the surface is thinned to one point per voxel; 0 = all", low=0)
    min_neighbours: int = setting(10, "points with fewer neighbours get no descriptor", low=5)


@dataclass(frozen=True, slots=True)
class MatchingConfig:
    keypoint_voxel_m: float = setting(0.15, "one keypoint per voxel", low=0.02)
    max_speed_m_per_s: float = setting(
        25.0, "largest plausible speed relative to the start value; sets the gate", low=0.1)
    mutual_radius_m: float = setting(
        0.35, "a match is mutual when matching back ends this close to where it began", low=0)
    max_ratio: float = setting(
        0.9, "best over second best descriptor distance, the second elsewhere", low=0.1, high=1)
    rival_radius_m: float = setting(0.6, "rivals of the best match are farther from it than this", low=0)


@dataclass(frozen=True, slots=True)
class GraphConfig:
    start: str = setting(
        "previous", "start value, with objects of the search for matches alone: the previous pair's motions, "
        "or only the ego-motion", choices=("previous", "ego"))
    thinning_m: float = setting(0.0, "one variable per voxel and component instead of one per point; "
                                "0 = every point", low=0)
    min_matches: int = setting(3, "components with fewer matches keep their start value", low=1)


@dataclass(frozen=True, slots=True)
class SolverConfig:
    method: str = setting(
        "fast", "what solves the graph: multigrid in compiled kernels, or gtsam, the reference",
        choices=("fast", "gtsam"))
    truncation_m: float = setting(
        0.05**0.5, "c: residuals beyond it count as outliers (c² = 0.05 m²)", low=1e-3)
    smoothness_frame: str = setting(
        "point", "twist between neighbours seen at the point or at the sensor (the paper's)",
        choices=("point", "sensor"))
    data_weight: float = setting(1.0, "weight of a squared match residual in m²", low=1e-6)
    smoothness_weight: float = setting(10.0, "weight of a squared twist between neighbours", low=1e-6)
    tie_weight: float = setting(
        100.0, "weight of a squared twist between a point and its object's, or the world's, motion", low=1e-6)
    tie_truncation: float = setting(
        0.15, "such a twist (metres and radians) beyond this lets the point go", low=1e-3)
    plain_first: bool = setting(True, "solve without truncation first; false = with it from the start")
    max_iterations: int = setting(50, "Levenberg-Marquardt iterations per step and component", low=1)
    relative_tolerance: float = setting(1e-4, "stop when an iteration gains less than this share", low=0)


@dataclass(frozen=True, slots=True)
class RefineConfig:
    rounds: int = setting(
        2, "how often near, small things are drawn to the next scan's surface; 0 = never", low=0)
    max_size_m: float = setting(
        2.5, "things larger than this, in any direction, have no limbs and stay as they are", low=0)
    max_range_m: float = setting(
        12.0, "things farther than this stay as they are: scan lines miss their limbs", low=0)
    reach_m: float = setting(0.3, "a surface farther than this from a point does not draw it", low=0.01)
    data_weight: float = setting(3.0, "weight of a squared distance to the surface in m²", low=1e-6)
    tie_weight: float = setting(
        1.0, "weight of a squared twist between a point and its object's, or the world's, motion", low=1e-6)
    tie_truncation: float = setting(
        0.03, "such a twist (metres and radians) beyond this lets the point go: limbs leave their body",
        low=1e-3)


@dataclass(frozen=True, slots=True)
class EgoConfig:
    method: str = setting(
        "registration", "what registration begins with in a sequence: the last pair's motion, or KISS-ICP's",
        choices=("registration", "kiss_icp"))
    refine: bool = setting(True, "false = kiss_icp (method) as it is, without registration")
    voxel_m: float = setting(
        0.2, "clouds are thinned to this before registration, finer in small places", low=0.02)


@dataclass(frozen=True, slots=True)
class DynamicConfig:
    """What moves where no objects are looked for (objects.enabled = false)."""

    min_speed_m_per_s: float = setting(0.5, "slower residual motion counts as static", low=0)
    smoothing_rounds: int = setting(10, "how often residual motion is averaged over the mesh", low=0)
    min_gain_m: float = setting(
        0.04, "how much nearer to the next scan its own motion must bring a moving point than ego-motion "
        "does, averaged over the mesh", low=0)


@dataclass(frozen=True, slots=True)
class ObjectsConfig:
    enabled: bool = setting(True, "look for moving objects; the rest of the world follows the ego-motion")
    near_m: float = setting(0.06, "a point this near to the next scan is explained", low=1e-3)
    near_share: float = setting(0.006, "and this share of its range more", low=0)
    min_points: int = setting(8, "smaller objects are not looked for", low=4)
    min_speed_m_per_s: float = setting(0.5, "slower objects count as static", low=0)
    min_matches: int = setting(5, "descriptor matches that an object must have", low=0)
    min_shift_m: float = setting(
        0.05, "a surface whose plane distances tell a smaller shift is taken as still", low=0)
    along_ground: float = setting(
        1.0, "how strongly objects move along the ground, as a multiple of all their points; 0 = not at all",
        low=0)
    max_clearance_m: float = setting(
        1.5, "what moves stands on the ground: its lowest point is no higher over it", low=0)
    min_unexplained: float = setting(
        0.2, "share of the points that an object's motion should leave unexplained by ego-motion that must "
        "be so, in either scan", low=0, high=1)
    min_observability: float = setting(
        0.05, "mean squared cosine that an object's normals must have with its motion, unless it clearly "
        "goes on as before; 0 lets walls slide", low=0, high=1)
    max_shape_ratio: float = setting(
        0.4, "an object's own motion must bring its mean squared plane distance down to this share",
        low=0, high=1)
    max_match_deviation: float = setting(
        0.6, "how far the median match on an object may be from its motion, as a share of the motion and at "
        "most 0.3 m", low=0, high=2)


@dataclass(frozen=True, slots=True)
class CrispnessConfig:
    sigma_m: float = setting(0.2, "σ of eq. 15: how far off still counts as aligned", low=1e-3)


@dataclass(frozen=True, slots=True)
class Config:
    """All settings of the LiDAR pipeline."""

    preparation: PreparationConfig = field(default_factory=PreparationConfig)
    ground: GroundConfig = field(default_factory=GroundConfig)
    normals: NormalsConfig = field(default_factory=NormalsConfig)
    mesh: MeshConfig = field(default_factory=MeshConfig)
    shot: ShotConfig = field(default_factory=ShotConfig)
    matching: MatchingConfig = field(default_factory=MatchingConfig)
    graph: GraphConfig = field(default_factory=GraphConfig)
    solver: SolverConfig = field(default_factory=SolverConfig)
    refine: RefineConfig = field(default_factory=RefineConfig)
    ego: EgoConfig = field(default_factory=EgoConfig)
    dynamic: DynamicConfig = field(default_factory=DynamicConfig)
    objects: ObjectsConfig = field(default_factory=ObjectsConfig)
    crispness: CrispnessConfig = field(default_factory=CrispnessConfig)


@overload
def load(file: Path | str | None = None, overrides: tuple[str, ...] = ()) -> Config: ...


@overload
def load(file: Path | str | None, overrides: tuple[str, ...], kind: type[Settings]) -> Settings: ...


def load(file: Path | str | None = None, overrides: tuple[str, ...] = (), kind: Any = Config) -> Any:
    """Defaults of a `kind` of settings, then a TOML file, then overrides such as "mesh.max_edge_m=0.5".

    Raises ConfigError for a file that cannot be read, an unknown key, a value out of range, or values that
    contradict each other.
    """
    if isinstance(overrides, str):
        raise ConfigError(f"overrides: the text {overrides!r}; expected several, as in ({overrides!r},)")
    config = kind()
    if file is not None:
        config = updated(config, read_toml(Path(file)), str(file))
    for override in overrides:
        config = updated(config, parse_override(override), "--set")
    check_together(config)
    return config


def given(config: Any, kind: type[Settings]) -> Settings:
    """Settings of a `kind`, each of them checked, its defaults for None; ConfigError for anything else."""
    if config is None:
        return kind()
    if isinstance(config, kind):
        config = updated(config, to_dict(config))
        check_together(config)
        return config
    found, file = f"of type {type(config).__name__}", "file"
    if isinstance(config, str | Path):
        found = file = repr(str(config))
    how = f"lidarflow.load({file})" if kind is Config else f"lidarflow.load({file}, (), {kind.__name__})"
    raise ConfigError(f"settings: {found}; expected a {kind.__name__}, such as {how}")
