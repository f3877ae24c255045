"""Two RGB-D frames in, odometry and scene flow out: the method from start to end (Jaimez et al. 2017)."""

import numpy as np

from lidarflow import first_use
from lidarflow.config import given
from lidarflow.kernels import cluster_images
from lidarflow.rgbd import clusters as geometric
from lidarflow.rgbd import exposure, odometry, propagation, pyramid, refinement, segmentation
from lidarflow.rgbd_config import RgbdConfig
from lidarflow.rgbd_types import Camera, RgbdFrame, RgbdPair, RgbdResult, check_is
from lidarflow.stopwatch import Stopwatch


def estimate_flow(
    pair: RgbdPair, config: RgbdConfig | None = None, previous: RgbdResult | None = None
) -> RgbdResult:
    """Odometry, segmentation and scene flow of a pair.

    Raises DataError for frames without depth, or with too little of it in common.
    `previous` is the result of the pair that ended with this pair's source, if there is one.
    """
    check_is("pair", pair, RgbdPair)
    config = given(config, RgbdConfig)
    first_use.announce()
    timed = Stopwatch()
    with timed("pyramid"):
        source, target = (pyramid.build(frame, pair.camera, config.images)
                          for frame in (pair.source, pair.target))
    return _estimate(source, target, previous, config, timed)


class RgbdEstimator:
    """Scene flow along a sequence: pyramids and the segmentation are carried from pair to pair."""

    tracks: None = None     # no object has a number

    def __init__(self, camera: Camera, config: RgbdConfig | None = None):
        check_is("camera", camera, Camera)
        self.camera = camera
        self.config = given(config, RgbdConfig)
        self.reset()

    def reset(self) -> None:
        """Begin anew with the next frame."""
        self._levels: tuple[pyramid.Level, ...] | None = None
        self._previous: RgbdResult | None = None

    def follow(self, frame: RgbdFrame, known: RgbdResult, tracks: None = None) -> None:
        """As `step` where its answer is known: the next step is the same."""
        self._levels, self._previous = pyramid.build(frame, self.camera, self.config.images), known

    def step(self, frame: RgbdFrame) -> RgbdResult | None:
        """Result of the pair of the last frame and this one; None for the first. Raises as estimate_flow."""
        first_use.announce()
        timed = Stopwatch()
        # Forgotten first: after a frame that cannot be used, the next pair must not inherit an older one's.
        source, self._levels = self._levels, None
        previous, self._previous = self._previous, None
        with timed("pyramid"):
            self._levels = pyramid.build(frame, self.camera, self.config.images)
        if source is None:
            return None
        self._previous = _estimate(source, self._levels, previous, self.config, timed)
        return self._previous


def _estimate(
    source: tuple[pyramid.Level, ...], target: tuple[pyramid.Level, ...], previous: RgbdResult | None,
    config: RgbdConfig, timed: Stopwatch,
) -> RgbdResult:
    """Odometry, segmentation and scene flow between two pyramids, finest level first; the method's main line.

    Odometry for most of the image tells which clusters move; without them it is found again, and what moves
    now is told anew, until the same clusters do. `previous` is the result of the pair before, `timed` adds up
    the seconds of each stage. Raises DataError where the pyramids have too little in common.
    """
    with timed("clusters"):
        clusters = geometric.find(source, config.clusters)
        b_before = None if previous is None else propagation.carried(previous, source[0], clusters)
    nothing_moves = np.zeros(len(clusters.centres))
    images = source, target
    with timed("exposure"):     # where pixels are large, the motion between two frames is small
        source, target, undone = exposure.matched(*images, np.eye(4), config, min(2, len(source) - 1))
    with timed("robust odometry"):
        static = robust = odometry.robust(
            source, target, clusters, nothing_moves if b_before is None else b_before, config)
    if source is not images[0]:
        with timed("exposure"):
            source, target, undone = exposure.matched(*images, robust, config)
    b, motions = nothing_moves, np.tile(static, (len(nothing_moves), 1, 1))
    if config.segmentation.enabled:
        with timed("segmentation"):
            b = segmentation.segment(source[0], target[0], clusters, static, b_before, config)
        for _ in range(config.refinement.max_rounds):
            had_own_motion = segmentation.has_own_motion(b, config.segmentation)
            with timed("refinement"):
                static, motions = refinement.refine(source, target, clusters, b, robust, config)
            with timed("segmentation"):
                b = segmentation.segment(source[0], target[0], clusters, static, b_before, config)
            if (segmentation.has_own_motion(b, config.segmentation) == had_own_motion).all():
                break
    odometry.require_overlap(source[0], target[0], static)
    with timed("scene flow"):
        label = clusters.labels[0]
        flow = cluster_images.blended_flow(
            source[0].points, label, clusters.centres, clusters.touch,
            np.float32(config.clusters.blending_per_m2), odometry.rows34(motions))
        odometry.require_likeness(source[0], target[0], flow)
        is_dynamic = np.append(b > config.segmentation.moving_above, False)[label]
    return RgbdResult(
        flow, source[0].points, label >= 0, label, b, motions, static, is_dynamic, source[0].camera,
        clusters.centres, timed.seconds, undone)
