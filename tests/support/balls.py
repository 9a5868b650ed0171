"""A shape whose every answer is known in closed form."""

import numpy as np


class Balls:
    """Balls in any dimension; every answer in closed form."""

    def __init__(self, *balls: tuple[tuple[float, ...], float], nesting: tuple[tuple[int, int], ...] = ()) -> None:
        self.centers, self.radii = np.array([c for c, _ in balls]), np.array([r for _, r in balls])
        self.count, self.nesting = len(balls), nesting

    def boxes(self) -> np.ndarray:
        return np.stack([self.centers - self.radii[:, None], self.centers + self.radii[:, None]], axis=1)

    def radius(self, index: int, points: np.ndarray) -> np.ndarray:
        return np.linalg.norm(points - self.centers[index], axis=1)

    def inside(self, index: int, points: np.ndarray) -> np.ndarray:
        return self.radius(index, points) < self.radii[index]

    def label(self, points: np.ndarray) -> np.ndarray:
        labels = np.zeros(len(points), dtype=np.uint8)
        for index in reversed(range(self.count)):
            labels[self.inside(index, points)] = index + 1
        return labels

    def segment_distance(self, index: int, points: np.ndarray) -> np.ndarray:
        return np.abs(self.radius(index, points) - self.radii[index])
