"""Solid textures: brightness as band-limited noise in the coordinates of the thing that carries it."""

from dataclasses import dataclass

import numpy as np

SHORTEST_M, LONGEST_M = 0.07, 0.9
_WAVES = 40
_CONTRAST = 1.3
_BLOCK = 1 << 14     # points at once: their waves stay in the cache


@dataclass(frozen=True, slots=True, eq=False)
class Texture:
    """A sum of plane waves, turned into shades between two colours; it moves with its object.

    waves       (K, 3) float32   wave vectors, radians per metre
    phases      (K,) float32     radians
    amplitudes  (K,) float32     the sum of their squares is 2, so that the noise has variance 1
    dark, light (3,) float32     RGB in 0..1 of the lowest and highest values
    """

    waves: np.ndarray
    phases: np.ndarray
    amplitudes: np.ndarray
    dark: np.ndarray
    light: np.ndarray

    def colours(self, points: np.ndarray) -> np.ndarray:
        """RGB (N, 3) float32 in 0..1 at points (N, 3), metres in the object's own frame."""
        share = 0.5 + 0.5 * np.tanh(_CONTRAST * self.noise(points))
        return self.dark + share[:, None] * (self.light - self.dark)

    def noise(self, points: np.ndarray) -> np.ndarray:
        """Values (N,) float32 of mean 0 and variance 1 at points (N, 3), metres."""
        points = points.astype(np.float32)
        values = np.empty(len(points), np.float32)
        for begin in range(0, len(points), _BLOCK):
            block = slice(begin, begin + _BLOCK)
            values[block] = np.cos(points[block] @ self.waves.T + self.phases) @ self.amplitudes
        return values


def random_texture(colour: tuple[float, float, float], rng: np.random.Generator) -> Texture:
    """Noise around an RGB `colour` in 0..1, wavelengths from SHORTEST_M to LONGEST_M metres.

    Every octave has the same energy, as in pictures of natural scenes.
    """
    wavelength_m = np.exp(rng.uniform(np.log(SHORTEST_M), np.log(LONGEST_M), _WAVES))
    direction = rng.normal(size=(_WAVES, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    amplitudes = np.full(_WAVES, np.sqrt(2.0 / _WAVES))
    waves = 2.0 * np.pi / wavelength_m[:, None] * direction
    phases = rng.uniform(0.0, 2.0 * np.pi, _WAVES)
    colour = np.array(colour)
    return Texture(waves.astype(np.float32), phases.astype(np.float32), amplitudes.astype(np.float32),
                   (0.38 * colour).astype(np.float32), np.minimum(1.25 * colour, 1.0).astype(np.float32))
